"""Drives of several drivers over the same episodes: the table and its files.

Episodes differ by their traffic and their road, so each is a cluster of its own:
intervals resample episodes, differences are of the same episodes.
"""

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.summary import text_table
from rcirl_jax.evaluation.statistics import (
    ClusterBootstrap,
    clopper_pearson,
    combine_seeds,
    mcnemar_exact,
    paired_difference,
)
from rcirl_jax.runtime.atomic_files import write_json, write_whole
from rcirl_jax.simulation.metrics import COLUMNS
from rcirl_jax.simulators.measures import EpisodeLog, measure

# number of an episode: its heading in the table
MEANS = {
    "mean_speed": "speed m/s",
    "progress": "progress m",
    "rms_a": "rms a m/s2",
    "rms_j": "rms jerk m/s3",
    "min_a": "min a m/s2",
    "standing_share": "standing",
    "fallback_share": "fallback",
    "lane_changes": "lane changes",
}
# yes or no of an episode
RATES = {
    "at_fault": "at-fault collision",
    "collisions": "any collision",
    "red_lights": "red light run",
    "a_station": "|a| < 4 held",
    "j_station": "|jerk| < 6 held",
    "nuplan_comfort": "nuPlan comfort",
}

Numbers = dict[str, float]  # of one drive, keys of MEANS and RATES
Results = dict[str, dict[str, Numbers]]  # by driver and episode


def numbers_of(logs: Mapping[str, EpisodeLog]) -> dict[str, Numbers]:
    """Return the numbers of drives, by episode; one that has no step has none."""
    logs = {name: log for name, log in logs.items() if log}
    if not logs:
        return {}
    found = measure(list(logs.values()))
    holds = dict(zip(COLUMNS, found.holds.T, strict=True))
    changes = [np.sum(log["changes_lane"]) for log in logs.values()]
    columns = {key: getattr(found, key) for key in MEANS if key != "lane_changes"} | {
        "lane_changes": changes,
        "at_fault": found.at_fault > 0,
        "collisions": found.collisions > 0,
        "red_lights": found.red_lights > 0,
        "a_station": holds["a_station"],
        "j_station": holds["j_station"],
        "nuplan_comfort": found.comfort > 0.0,
    }
    return {
        name: {key: float(values[n]) for key, values in columns.items()}
        for n, name in enumerate(logs)
    }


def write_results(file: Path, results: Results) -> None:
    """Write one line a driver and episode."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["driver", "episode", *MEANS, *RATES])
    for name, drives in results.items():
        for episode, numbers in drives.items():
            cells = [f"{numbers[key]:.6g}" for key in (*MEANS, *RATES)]
            writer.writerow([name, episode, *cells])
    write_whole(file, text.getvalue())


def read_results(file: Path) -> Results:
    """Read what `write_results` wrote.

    Raises:
      InputError: it did not.
    """
    found: Results = {}
    with file.open(newline="") as lines:
        for n, row in enumerate(csv.DictReader(lines)):
            try:
                numbers = {key: float(row[key]) for key in (*MEANS, *RATES)}
                found.setdefault(row["driver"], {})[row["episode"]] = numbers
            except (KeyError, TypeError, ValueError) as error:
                raise InputError(
                    f"{file}: row {n + 1}: {error}: expected an episodes.csv"
                ) from None
    return found


def table_of(simulator: str, results: Results, against: Sequence[str]) -> dict:
    """Return the table over the episodes that every driver has driven, as JSON.

    Args:
      simulator: its name.
      results: of every driver.
      against: drivers that the others are compared with, where they drove.

    Raises:
      InputError: fewer than two such episodes.
    """
    first, *others = results.values()
    names = [name for name in first if all(name in other for other in others)]
    if len(names) < 2:
        raise InputError(f"episodes: {len(names)}: expected at least 2, for intervals")
    kinds = np.array([name.split("/")[0] for name in names])
    groups = {"all": np.ones(kinds.size, bool)}
    groups |= {kind: kinds == kind for kind in dict.fromkeys(kinds.tolist())}
    values = {
        driver: {
            key: np.array([drives[name][key] for name in names])
            for key in (*MEANS, *RATES)
        }
        for driver, drives in results.items()
    }
    against = [driver for driver in against if driver in results]
    return {
        "simulator": simulator,
        "episodes": len(names),
        "against": against,
        "groups": {
            group: _group(values, which, against)
            for group, which in groups.items()
            if group == "all" or which.sum() > 1
        },
    }


def _group(
    values: Mapping[str, Mapping[str, np.ndarray]],
    which: np.ndarray,
    against: Sequence[str],
) -> dict:
    """Return the rows of a group of episodes and their differences to `against`."""
    bootstrap = ClusterBootstrap(np.arange(which.sum()))
    here = {
        driver: {key: column[which] for key, column in columns.items()}
        for driver, columns in values.items()
    }
    return {
        "episodes": int(which.sum()),
        "rows": {driver: _numbers(x, bootstrap) for driver, x in here.items()},
        "differences": {
            f"{driver} - {other}": _differences(here[driver], here[other], bootstrap)
            for driver in here
            for other in here
            if other in against and driver != other
        },
    }


def _numbers(values: Mapping[str, np.ndarray], bootstrap: ClusterBootstrap) -> dict:
    """Return each number of one driver: value, low and high."""
    found = {}
    for key in RATES:
        count, total = int(np.sum(values[key] > 0.0)), values[key].size
        low, high = clopper_pearson(count, total)
        found[key] = {"value": count / total, "low": low, "high": high, "count": count}
    for key in MEANS:
        mean = combine_seeds(values[key], bootstrap)
        found[key] = {"value": mean.value, "low": mean.low, "high": mean.high}
    return found


def _differences(
    first: Mapping[str, np.ndarray],
    second: Mapping[str, np.ndarray],
    bootstrap: ClusterBootstrap,
) -> dict:
    """Return each difference of two drivers over the same episodes."""
    found = {}
    for key in (*RATES, *MEANS):
        a, b = first[key], second[key]
        if key in RATES:
            a, b = (a > 0.0).astype(float), (b > 0.0).astype(float)
        apart = paired_difference(a, b, bootstrap)
        found[key] = {
            "mean": apart.mean,
            "low": apart.low,
            "high": apart.high,
            "p": apart.p,
        }
        if key in RATES:
            only = int(np.sum(a > b)), int(np.sum(b > a))
            found[key] |= {"only_first": only[0], "only_second": only[1]}
            found[key]["p"] = mcnemar_exact(*only)
    return found


def text_of(body: Mapping) -> str:
    """Return `table_of` as text: rates and means of each kind, then differences."""
    lines = [f"{body['simulator']}: {body['episodes']} episodes, 95 % intervals"]
    for group, found in body["groups"].items():
        rows = found["rows"]
        lines += ["", f"{group}, {found['episodes']} episodes: % of them with"]
        lines += _table(RATES, rows, _interval("value", 100.0, 1))
        lines += ["", f"{group}: mean of the episodes"]
        lines += _table(MEANS, rows, _interval("value", 1.0, 2))
    pairs = body["groups"]["all"]["differences"]
    for other in body["against"]:
        end = f" - {other}"
        rows = {
            pair.removesuffix(end): x for pair, x in pairs.items() if pair.endswith(end)
        }
        lines += ["", f"Less {other}, the same episodes; * leaves out 0"]
        less = _interval("mean", 100.0, 1, star=True)
        lines += _table(RATES, rows, less, "points of %")
        lines += ["", *_table(MEANS, rows, _interval("mean", 1.0, 2, star=True))]
    return "\n".join(lines) + "\n"


def write_table(folder: Path, body: Mapping, made_by: Mapping) -> str:
    """Write table.txt and elsewhere.json; return the text."""
    text = text_of(body)
    write_whole(folder / "table.txt", text)
    write_json(folder / "elsewhere.json", {**body, "made_by": dict(made_by)})
    return text


def _table(
    columns: Mapping[str, str],
    rows: Mapping[str, Mapping],
    cell: Callable[[Mapping], str],
    corner: str = "",
) -> list[str]:
    """Return lines: a driver each, a column for each of its numbers."""
    cells = [[name, *(cell(x[key]) for key in columns)] for name, x in rows.items()]
    return text_table([corner, *columns.values()], cells)


def _interval(
    of: str, scale: float, digits: int, *, star: bool = False
) -> Callable[[Mapping], str]:
    """Return the form of a cell: value [low,high], * where that leaves out 0."""

    def cell(x: Mapping) -> str:
        value, low, high = (
            f"{scale * x[end]:.{digits}f}" for end in (of, "low", "high")
        )
        mark = (" " if x["low"] <= 0.0 <= x["high"] else "*") if star else ""
        return f"{value} [{low},{high}]{mark}"

    return cell
