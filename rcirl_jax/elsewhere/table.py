"""Drives of several drivers over the same episodes: the table and its files.

Episodes differ by their traffic and their road, so each is a cluster of its own:
intervals resample episodes, differences are of the same episodes.
"""

import csv
import dataclasses
import io
from collections.abc import Mapping, Sequence
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

# number of an episode: its heading in the table, unit, decimals
MEANS = {
    "mean_speed": ("speed", "m/s", 2),
    "progress": ("progress", "m", 1),
    "rms_a": ("rms a", "m/s2", 2),
    "rms_j": ("rms jerk", "m/s3", 2),
    "min_a": ("min a", "m/s2", 2),
    "standing_share": ("standing", "1", 3),
    "fallback_share": ("fallback", "1", 4),
}
# yes or no of an episode
RATES = {
    "at_fault": "crash of own fault",
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
        get = lambda key, of=drives: np.array([float(x[key]) for x in of])  # noqa: E731
        means = {key: get(key) for key in MEANS}
        rates = {key: get(key) > 0.0 for key in RATES}
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
        """Of `as_dict`: a table for each kind, then the differences over all."""
        lines = [f"{self.simulator}: {len(self.episodes)} episodes"]
        for group, found in body["groups"].items():
            lines += ["", f"{group}: {found['episodes']} episodes, 95 % intervals"]
            lines += _rows(found["rows"])
        for other in self.against:
            lines += ["", f"Difference to {other}, the same episodes, all kinds"]
            lines += _differences(body["groups"]["all"]["differences"], other)
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


def _rows(rows: Mapping) -> list[str]:
    """Lines of the table of one kind."""
    header = [
        "",
        *RATES.values(),
        *(f"{name}, {unit}" for name, unit, _ in MEANS.values()),
    ]
    lines = []
    for name, found in rows.items():
        cells = [
            f"{100 * x['value']:.1f} [{100 * x['low']:.1f},{100 * x['high']:.1f}]"
            for x in (found[key] for key in RATES)
        ]
        for key, (_, _, digits) in MEANS.items():
            x = found[key]
            low, high = f"{x['low']:.{digits}f}", f"{x['high']:.{digits}f}"
            cells.append(f"{x['value']:.{digits}f} [{low},{high}]")
        lines.append([name, *cells])
    return text_table(header, lines)


def _differences(found: Mapping, other: str) -> list[str]:
    """Lines of the differences to one driver; a star: the interval leaves out 0."""
    header = ["", *RATES.values(), *(name for name, _, _ in MEANS.values())]
    lines = []
    for pair, numbers in found.items():
        name, _, to = pair.rpartition(" - ")
        if to != other:
            continue
        cells = []
        for key in (*RATES, *MEANS):
            scale, digits = (100, 1) if key in RATES else (1, MEANS[key][2])
            x = numbers[key]
            star = "" if x["low"] <= 0.0 <= x["high"] else "*"
            cells.append(
                f"{scale * x['mean']:+.{digits}f} [{scale * x['low']:+.{digits}f},"
                f"{scale * x['high']:+.{digits}f}]{star}"
            )
        lines.append([name, *cells])
    return text_table(header, lines)
