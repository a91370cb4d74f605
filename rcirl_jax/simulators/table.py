"""Drives of several drivers over the same episodes: the table and its files.

Episodes differ by their traffic and their road, so each is a cluster of its own:
intervals resample episodes, differences are of the same episodes.
"""

import csv
import dataclasses
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.output import text_table
from rcirl_jax.evaluation.exact import clopper_pearson, mcnemar_exact
from rcirl_jax.evaluation.statistics import (
    ClusterBootstrap,
    Difference,
    combine_seeds,
    paired_difference,
)
from rcirl_jax.runtime.atomic_files import write_json, write_whole
from rcirl_jax.simulation.metrics import COLUMNS
from rcirl_jax.simulators.measures import Drive, measure

# number of an episode: its heading in the table
MEANS = {
    "mean_speed": "speed m/s",
    "progress": "progress m",
    "rms_a": "rms a m/s2",
    "rms_j": "rms jerk m/s3",
    "min_a": "min a m/s2",
    "standing_share": "standing",
    "fallback_share": "fallback",
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


def numbers_of(drives: Sequence[Drive]) -> dict[str, Numbers]:
    """The numbers of drives, by episode; one that has no step has none."""
    drives = [drive for drive in drives if drive.v.size]
    if not drives:
        return {}
    found = measure(drives)
    holds = dict(zip(COLUMNS, found.holds.T, strict=True))
    columns = {key: getattr(found, key) for key in MEANS} | {
        "at_fault": found.at_fault > 0,
        "collisions": found.collisions > 0,
        "red_lights": found.red_lights > 0,
        "a_station": holds["a_station"],
        "j_station": holds["j_station"],
        "nuplan_comfort": found.comfort > 0.0,
    }
    return {
        drive.episode: {key: float(values[n]) for key, values in columns.items()}
        for n, drive in enumerate(drives)
    }


def write_results(file: Path, results: Results) -> None:
    """One line a driver and episode."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["driver", "episode", *MEANS, *RATES])
    for name, drives in results.items():
        for episode, numbers in drives.items():
            cells = [f"{numbers[key]:.6g}" for key in (*MEANS, *RATES)]
            writer.writerow([name, episode, *cells])
    write_whole(file, text.getvalue())


def read_results(file: Path) -> Results:
    """What `write_results` wrote.

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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Entry:
    """One driver's episodes; arrays [N]."""

    name: str
    means: dict[str, np.ndarray]
    rates: dict[str, np.ndarray]  # bool


def table_of(simulator: str, results: Results, against: Sequence[str]) -> "Table":
    """The table over the episodes that every driver has driven, a step at least."""
    first, *others = results.values()
    episodes = [name for name in first if all(name in other for other in others)]
    entries = []
    for name, drives in results.items():
        column = lambda key, of=drives: np.array([of[e][key] for e in episodes])  # noqa: E731
        means = {key: column(key) for key in MEANS}
        rates = {key: column(key) > 0.0 for key in RATES}
        entries.append(Entry(name=name, means=means, rates=rates))
    known = [name for name in against if name in results]
    return Table(simulator=simulator, episodes=episodes, entries=entries, against=known)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Table:
    """Entries over the same episodes; differences are to the `against` ones."""

    simulator: str
    episodes: Sequence[str]
    entries: Sequence[Entry]
    against: Sequence[str]

    def __post_init__(self) -> None:
        """One episode says nothing about others."""
        if len(self.episodes) < 2:
            raise InputError(
                f"--episodes: {len(self.episodes)}: expected at least 2, for intervals"
            )

    def groups(self) -> dict[str, np.ndarray]:
        """Which episodes are of a kind [N] bool; all of them first."""
        kinds = np.array([name.split("/")[0] for name in self.episodes])
        every = {"all": np.ones(kinds.size, bool)}
        found = {kind: kinds == kind for kind in dict.fromkeys(kinds.tolist())}
        return every | {kind: which for kind, which in found.items() if which.sum() > 1}

    def as_dict(self) -> dict:
        """Everything, as JSON."""
        return {
            "simulator": self.simulator,
            "episodes": len(self.episodes),
            "groups": {
                group: self._group(which) for group, which in self.groups().items()
            },
        }

    def _group(self, which: np.ndarray) -> dict:
        bootstrap = ClusterBootstrap(np.arange(which.sum()))
        return {
            "episodes": int(which.sum()),
            "rows": {e.name: _numbers(e, which, bootstrap) for e in self.entries},
            "differences": {
                f"{entry.name} - {other.name}": _apart(entry, other, which, bootstrap)
                for entry in self.entries
                for other in self.entries
                if other.name in self.against and entry is not other
            },
        }

    def text(self, body: Mapping) -> str:
        """Of `as_dict`: rates and means of each kind, then the differences over all."""
        lines = [f"{self.simulator}: {len(self.episodes)} episodes, 95 % intervals"]
        for group, found in body["groups"].items():
            rows = found["rows"]
            lines += ["", f"{group}, {found['episodes']} episodes: % of them with"]
            lines += _table(RATES, rows, lambda x: _cell(x["value"], x, 100.0, 1))
            lines += ["", f"{group}: mean of the episodes"]
            lines += _table(MEANS, rows, _mean)
        for other in self.against:
            pairs = body["groups"]["all"]["differences"]
            rows = {
                pair.removesuffix(f" - {other}"): numbers
                for pair, numbers in pairs.items()
                if pair.endswith(f" - {other}")
            }
            lines += ["", f"Less {other}, the same episodes; * leaves out 0"]
            lines += _table(RATES, rows, _less(100.0, 1), "points of %")
            lines += ["", *_table(MEANS, rows, _less(1.0, 2))]
        return "\n".join(lines) + "\n"

    def write(self, folder: Path, made_by: Mapping) -> str:
        """table.txt and elsewhere.json; returns the table."""
        body = self.as_dict()
        text = self.text(body)
        write_whole(folder / "table.txt", text)
        write_json(folder / "elsewhere.json", {**body, "made_by": dict(made_by)})
        return text


def _numbers(entry: Entry, which: np.ndarray, bootstrap: ClusterBootstrap) -> dict:
    """Each number of one driver: value, low and high."""
    found = {}
    for key, yes in entry.rates.items():
        count, total = int(yes[which].sum()), int(which.sum())
        low, high = clopper_pearson(count, total)
        found[key] = {"value": count / total, "low": low, "high": high, "count": count}
    for key, values in entry.means.items():
        mean = combine_seeds(values[which], bootstrap)
        found[key] = {"value": mean.value, "low": mean.low, "high": mean.high}
    return found


def _apart(
    entry: Entry, other: Entry, which: np.ndarray, bootstrap: ClusterBootstrap
) -> dict:
    """Each difference of two drivers over the same episodes."""
    found = {}
    for key in (*entry.rates, *entry.means):
        values = entry.rates | entry.means, other.rates | other.means
        a, b = (np.asarray(v[key][which], float) for v in values)
        apart: Difference = paired_difference(a, b, bootstrap)
        found[key] = {"mean": apart.mean, "low": apart.low, "high": apart.high}
        found[key]["p"] = apart.p
        if key in entry.rates:
            only = int(np.sum(a > b)), int(np.sum(b > a))
            found[key] |= {"only_first": only[0], "only_second": only[1]}
            found[key]["p"] = mcnemar_exact(*only)
    return found


def _table(
    columns: Mapping[str, str],
    rows: Mapping[str, Mapping],
    cell: Callable[[Mapping], str],
    corner: str = "",
) -> list[str]:
    """Lines: a driver each, a column for each of its numbers."""
    cells = [
        [name, *(cell(found[key]) for key in columns)] for name, found in rows.items()
    ]
    return text_table([corner, *columns.values()], cells)


def _cell(value: float, ends: Mapping, scale: float, digits: int) -> str:
    low, high = (f"{scale * ends[end]:.{digits}f}" for end in ("low", "high"))
    return f"{scale * value:.{digits}f} [{low},{high}]"


def _mean(x: Mapping) -> str:
    return _cell(x["value"], x, 1.0, 2)


def _less(scale: float, digits: int) -> Callable[[Mapping], str]:
    """Cells of differences."""

    def cell(x: Mapping) -> str:
        star = " " if x["low"] <= 0.0 <= x["high"] else "*"
        return _cell(x["mean"], x, scale, digits) + star

    return cell
