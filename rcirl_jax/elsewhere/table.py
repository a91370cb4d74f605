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

from rcirl_jax.elsewhere.measures import Drive, measure
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
    "at_fault": "crash, own fault",
    "collisions": "crash",
    "red_lights": "red light run",
    "a_station": "|a| < 4 held",
    "j_station": "|jerk| < 6 held",
    "nuplan_comfort": "nuPlan comfort",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Entry:
    """One driver's episodes; arrays [N]."""

    name: str
    means: dict[str, np.ndarray]
    rates: dict[str, np.ndarray]  # bool


def entry_of(name: str, drives: Sequence[Drive]) -> Entry:
    """The numbers of a driver."""
    found = measure(drives)
    holds = dict(zip(COLUMNS, found.holds.T, strict=True))
    rates = {
        "at_fault": found.at_fault > 0,
        "collisions": found.collisions > 0,
        "red_lights": found.red_lights > 0,
        "a_station": holds["a_station"],
        "j_station": holds["j_station"],
        "nuplan_comfort": found.comfort > 0.0,
    }
    means = {key: np.asarray(getattr(found, key), float) for key in MEANS}
    return Entry(name=name, means=means, rates=rates)


def driven_before(file: Path, episodes: Sequence[str]) -> dict[str, Entry]:
    """The entries of an `episodes.csv` over the same episodes, by name.

    Raises:
      InputError: it is none, or of other episodes.
    """
    with file.open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    found: dict[str, list[dict]] = {}
    for row in rows:
        found.setdefault(row.get("driver", ""), []).append(row)
    entries = {}
    for name, drives in found.items():
        if [drive.get("episode") for drive in drives] != list(episodes):
            raise InputError(
                f"--also: {file}: {name}: other episodes: expected those of --episodes "
                "and --seed"
            )
        try:
            numbers = {
                key: np.array([float(drive[key]) for drive in drives])
                for key in (*MEANS, *RATES)
            }
        except (KeyError, ValueError) as error:
            raise InputError(
                f"--also: {file}: {name}: {error}: expected an episodes.csv"
            ) from None
        means = {key: numbers[key] for key in MEANS}
        rates = {key: numbers[key] > 0.0 for key in RATES}
        entries[name] = Entry(name=name, means=means, rates=rates)
    return entries


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

    def csv(self) -> str:
        """One line a driver and episode."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["driver", "episode", *MEANS, *RATES])
        for entry in self.entries:
            for n, episode in enumerate(self.episodes):
                means = [f"{values[n]:.6g}" for values in entry.means.values()]
                rates = [int(values[n]) for values in entry.rates.values()]
                writer.writerow([entry.name, episode, *means, *rates])
        return text.getvalue()

    def write(self, folder: Path, made_by: Mapping) -> str:
        """table.txt, episodes.csv and elsewhere.json; returns the table."""
        body = self.as_dict()
        text = self.text(body)
        write_whole(folder / "table.txt", text)
        write_whole(folder / "episodes.csv", self.csv())
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
