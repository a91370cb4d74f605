"""Distance of a driver to the human, in closed loop on held-out recordings.

Every row drives the same D short cases (`simulation.recorded`) from the human's
own state along the human's own path. The number that the gate reads is

    distance = mean over the recorded 10 Hz times of |s_row(t) - s_human(t)|    [m]

per drive: it has the unit of the ranking tables, needs no choice of features, and a
drive that crashes stays where it crashed, so no drive is dropped. Beside it, in the
spirit of the Waymo sim-agents challenge (Montali et al. 2023, arXiv 2305.12032), how
unlike the human's the distributions of acceleration, jerk, headway and time to
collision are: the Jensen-Shannon distance of histograms over all drives, 0 to 1. The
gate also reads how safe the drives are (`TRAFFIC`). Host numpy, float64.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np
import tqdm
from scipy.spatial.distance import jensenshannon

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.runs import (
    check_array,
    names_of_rows,
    read_npz,
    write_npz,
)
from rcirl_jax.evaluation.closed_loop.summary import text_table
from rcirl_jax.evaluation.gate.types import Likeness
from rcirl_jax.evaluation.statistics import (
    ClusterBootstrap,
    combine_seeds,
    over_clusters,
)
from rcirl_jax.planner.mobil import MOBIL_ROW
from rcirl_jax.planner.program import name_cases
from rcirl_jax.runtime.executors import two_at_a_time
from rcirl_jax.simulation.cases import STEP_S, Record
from rcirl_jax.simulation.metrics import MetricsConfig
from rcirl_jax.simulation.recorded import STEPS, HeldOut
from rcirl_jax.simulation.rollout import LANES, drive_cases
from rcirl_jax.simulation.rows import RECORDED_HUMAN, Row, firsts_first, human_row
from rcirl_jax.simulation.suite import rollout_config
from rcirl_jax.units import HORIZON_S

TIMES_SHOWN_S = (1.0, 3.0, 5.0, 8.0)  # s at which distances are printed
# what is compared as a distribution: lowest, highest, bins
HISTOGRAMS: dict[str, tuple[float, float, int]] = {
    "acceleration": (-6.0, 4.0, 40),  # m/s^2
    "jerk": (-8.0, 8.0, 40),  # m/s^3
    "headway": (0.0, 8.0, 32),  # s; nobody ahead counts in the last bin
    "time_to_collision": (0.0, 20.0, 40),  # s; likewise
}
# safety among recorded traffic, by drive: field of `Driven` -> head of its column
TRAFFIC = {
    "collision": "at fault",  # drives with an at-fault collision
    "ttc": f"TTC<{MetricsConfig.nuplan_ttc:g} s",  # drives with less to a collision
    "braking": "others brake",  # drives in which the ego makes somebody brake hard
    "headway": "headway<1 s",  # share of time
}
BRAKING_MPS2 = 4.0  # m/s^2, hard braking of others
HEADWAY_S = 1.0  # s, short headway
MOVING_MPS = 1.0  # m/s below which a headway says nothing
CHUNK = 10 * LANES  # drives in memory at a time
REFERENCES = ("hand-set", "IDM", "IDM, tuned", MOBIL_ROW, "+velocity", "constant V")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Driven:
    """Distances and distributions of one row over the D drives."""

    distance: np.ndarray  # [D] m, see above
    at: np.ndarray  # [D, len(TIMES_SHOWN_S)] m; NaN where the record is shorter
    mean_speed: np.ndarray  # [D] m/s, over the same time as the human's
    traffic: Mapping[str, np.ndarray]  # of TRAFFIC, [D] each: 0, 1 or a share
    samples: Mapping[str, np.ndarray]  # of HISTOGRAMS, all drives' in one
    not_driven: int = 0  # drives in which a program gave no plan: it stands there


@dataclasses.dataclass(frozen=True, kw_only=True)
class LikenessReport:
    """All rows on the same held-out drives."""

    rows: Mapping[str, Driven]  # the recorded human first
    ids: tuple[str, ...]
    clusters: np.ndarray  # [D] int, the ego's vehicle
    recordings: int
    available: int  # held-out drives that there are
    references: tuple[str, ...] = REFERENCES  # rows that the others are compared with

    @property
    def distance(self) -> dict[str, np.ndarray]:
        """[D] m of every row but the human's."""
        named = self.rows.items()
        return {n: row.distance for n, row in named if n != RECORDED_HUMAN}

    @property
    def likeness(self) -> Likeness:
        """The distances in the form that the gate reads."""
        return Likeness(
            distance=self.distance,
            clusters=self.clusters,
            available=self.available,
            traffic={name: row.traffic for name, row in self.rows.items()},
        )

    @functools.cached_property
    def facts(self) -> dict:
        """All numbers, for a JSON file.

        A row's `minus` are its differences to the references, clustered by vehicle as
        the gate's are (`over_clusters`); below 0 is nearer. `unlikeness` is the
        Jensen-Shannon distance to the human's distributions of `HISTOGRAMS`.
        """
        bootstrap, found = ClusterBootstrap(self.clusters), self.distance
        human, body = self.rows[RECORDED_HUMAN], {}
        for name, row in self.rows.items():
            mean = combine_seeds(row.distance[None], bootstrap)
            others = [n for n in self.references if n in found and n != name]
            body[name] = {
                "distance_m": {"mean": mean.value, "low": mean.low, "high": mean.high},
                "at_m": {
                    f"{t:g}": float(np.nanmean(row.at[:, i]))
                    for i, t in enumerate(TIMES_SHOWN_S)
                    if not np.isnan(row.at[:, i]).all()
                },
                "unlikeness": {
                    key: jensen_shannon(row.samples[key], human.samples[key], key)
                    for key in HISTOGRAMS
                },
                "speed_share": float(np.mean(row.mean_speed) / human.mean_speed.mean()),
                "traffic": {key: float(np.sum(x)) for key, x in row.traffic.items()},
                "not_driven": row.not_driven,
                "minus": {
                    other: dataclasses.asdict(
                        over_clusters(row.distance, found[other], bootstrap)
                    )
                    for other in others
                    if name != RECORDED_HUMAN
                },
            }
        return {
            "drives": len(self.ids),
            "available": self.available,
            "vehicles": int(np.unique(self.clusters).size),
            "recordings": self.recordings,
            "rows": body,
            "ids": list(self.ids),
        }

    def text(self) -> str:
        """Formats the table, nearest row first, and the differences."""
        facts, times = self.facts, [f"{t:g}" for t in TIMES_SHOWN_S]
        known = [name for name in self.references if name in self.rows]
        cell = "{mean:.2f} [{low:.2f}, {high:.2f}]".format_map
        apart = "{mean:+.2f} [{low:+.2f}, {high:+.2f}]".format_map
        rows = [
            [
                name,
                cell(row["distance_m"]),
                *(f"{row['at_m'][t]:.2f}" if t in row["at_m"] else "" for t in times),
                f"{100 * row['speed_share']:.0f} %",
                *(f"{x:.2f}" for x in row["unlikeness"].values()),
            ]
            for name, row in sorted(
                facts["rows"].items(), key=lambda x: x[1]["distance_m"]["mean"]
            )
        ]
        head = ["row", "distance m", *(f"{t} s" for t in times), "speed", "a", "jerk"]
        head += ["headway", "TTC"]
        safe = [
            [
                name,
                *(f"{row['traffic'][key]:.0f}" for key in TRAFFIC if key != "headway"),
                f"{100.0 * row['traffic']['headway'] / facts['drives']:.1f} %",
            ]
            for name, row in facts["rows"].items()
        ]
        lines = [
            f"Distance to the human, held out: {facts['drives']} drives of "
            f"{facts['vehicles']} vehicles in {facts['recordings']} recordings",
            *text_table(head, rows),
            "distance: mean of |s - s_human|, and at 1 to 8 s; speed: share of the "
            "human's; a to TTC: how unlike the human's distribution, 0 to 1",
            *(
                f"{name}: {row.not_driven} drives not driven: it stands there"
                for name, row in self.rows.items()
                if row.not_driven
            ),
            "",
            f"Safety among recorded traffic: of {facts['drives']} drives, or of time",
            *text_table(["row", *TRAFFIC.values()], safe),
            f"others brake: by more than {BRAKING_MPS2:g} m/s2, because of the ego",
            "",
        ]
        if known:
            minus = {name: facts["rows"][name]["minus"] for name in self.distance}
            rows = [
                [name, *(apart(found[n]) if n in found else "-" for n in known)]
                for name, found in minus.items()
            ]
            lines += [
                "distance minus that of, m [95 % over vehicles]; below 0 is nearer",
                *text_table(["row minus", *known], rows),
            ]
        return "\n".join(lines) + "\n"


def write_arrays(path: Path, known: Likeness) -> None:
    """Writes the distances as an npz file, whole or not at all."""
    table = np.array(list(known.distance.values()), np.float64)
    names = np.array(list(known.distance))
    arrays = {"names": names, "distance": table, "clusters": known.clusters}
    drivers = list(known.traffic)
    arrays |= {
        key: np.array([known.traffic[name][key] for name in drivers], np.float64)
        for key in TRAFFIC
    }
    arrays["drivers"] = np.array(drivers)
    write_npz(path, {**arrays, "available": np.array(known.available)})


def read_arrays(path: Path) -> Likeness:
    """Reads distances written by `write_arrays`.

    Raises:
      InputError: no such file, damaged, or not as written.
    """
    with read_npz(path, "distances as written") as arrays:
        names = names_of_rows(arrays["names"])
        count = arrays["clusters"].size
        check_array(arrays, "clusters", "iu", (count,))
        check_array(arrays, "available", "iu", ())
        check_array(arrays, "distance", "f", (len(names), count))
        if not np.all((arrays["distance"] >= 0.0) & (arrays["distance"] < np.inf)):
            raise ValueError("distance: below 0, NaN or infinity")
        distance = dict(zip(names, arrays["distance"], strict=True))
        drivers = names_of_rows(arrays["drivers"])
        for key in TRAFFIC:
            check_array(arrays, key, "f", (len(drivers), count))
            if not np.all((arrays[key] >= 0.0) & (arrays[key] <= 1.0)):
                raise ValueError(f"{key}: not from 0 to 1")
        return Likeness(
            distance=distance,
            clusters=arrays["clusters"],
            available=int(arrays["available"]),
            traffic={
                name: {key: arrays[key][i] for key in TRAFFIC}
                for i, name in enumerate(drivers)
            },
        )


def jensen_shannon(a: np.ndarray, b: np.ndarray, name: str) -> float:
    """Returns the Jensen-Shannon distance of two histograms, 0 (equal) to 1.

    Logarithms are of base 2. Two samples without a value are equal.

    Args:
      a: [n].
      b: [m].
      name: of HISTOGRAMS; values beyond its ends count in the first and last bin.
    """
    low, high, bins = HISTOGRAMS[name]
    p, q = (
        np.histogram(np.clip(values, low, high), bins, (low, high))[0]
        for values in (a, b)
    )
    if not p.any() or not q.any():  # no shares of nothing
        return float(p.any() != q.any())
    # rounding may put the square of a distance of nearly equal ones below 0
    with np.errstate(invalid="ignore"):
        return float(np.nan_to_num(jensenshannon(p, q, base=2)))


def held_out_likeness(
    drives: HeldOut,
    rows: Sequence[Row],
    plan_every: int = 1,
    incumbent: str = REFERENCES[0],
) -> LikenessReport:
    """Drives every row, and the recorded human, over the held-out drives.

    Args:
      drives: of `simulation.recorded.held_out`.
      rows: learned rows, baselines; names are distinct.
      plan_every: steps of 0.1 s between two plans.
      incumbent: a row that the others are compared with, besides `REFERENCES`.

    Raises:
      InputError: a name twice, drives of one vehicle, or a drive with no number.
    """
    name_cases(drives.names)
    ClusterBootstrap(drives.vehicle)  # refuses one vehicle before hours of driving
    names = [row.name for row in rows]
    if len(set(names)) < len(names):
        raise InputError(f"held-out drives: rows {names}: expected distinct names")
    others = [row for row in rows if row.name != RECORDED_HUMAN]
    every = [human_row(), *others]
    with tqdm.tqdm(total=len(every), desc="held-out drives", unit="row") as bar:

        def driven(row: Row) -> Driven:
            found = _driven(row, drives, plan_every)
            bar.update()
            return found

        order = firsts_first(every)
        made = two_at_a_time(driven, order)
    found = dict(zip([row.name for row in order], made, strict=True))
    return LikenessReport(
        rows={row.name: found[row.name] for row in every},
        ids=drives.ids,
        clusters=np.unique(drives.vehicle, return_inverse=True)[1],
        recordings=int(np.unique(drives.recording).size),
        available=drives.available,
        references=tuple(dict.fromkeys((incumbent, *REFERENCES))),
    )


def _driven(row: Row, drives: HeldOut, plan_every: int = 1) -> Driven:
    """Drives one row and measures it against the humans of the cases."""
    count = len(drives.ids)
    parts = [
        _measured(row, drives, np.arange(first, min(first + CHUNK, count)), plan_every)
        for first in range(0, count, CHUNK)
    ]
    lost = sum(x.not_driven for x in parts)
    arrays = [{**vars(x), "not_driven": np.zeros(1)} for x in parts]
    joined = jax.tree.map(lambda *x: np.concatenate(x), *arrays)
    return Driven(**{**joined, "not_driven": lost})


def _measured(row: Row, drives: HeldOut, at: np.ndarray, plan_every: int) -> Driven:
    """Drives a row over the drives `at` [n] as `_driven` does."""
    count = at.size
    fill = np.minimum(np.arange(-(-count // LANES) * LANES), count - 1)
    cases = jax.tree.map(lambda x: np.asarray(x)[at[fill]], drives.cases)
    config = rollout_config(row, HORIZON_S, plan_every)
    logs = drive_cases(row.policy, row.params, cases, config)
    # where plans are rarer, the last may end after the horizon
    record: Record = jax.tree.map(lambda x: np.asarray(x)[:count, :STEPS], logs[0])
    assert drives.cases.replay is not None
    human = np.asarray(drives.cases.replay.ego_s, np.float64)[at, 1:]
    lost = 0
    if row.program is not None:
        lost = int(np.sum(~np.isfinite(record.s).all(axis=1)))
        record = jax.tree.map(np.nan_to_num, record)
    steps = np.asarray(drives.cases.steps)[at]
    lasts = np.arange(STEPS)[None] < steps[:, None]  # [n, S], crash or not
    apart = np.abs(np.asarray(record.s, np.float64) - human)
    if not np.isfinite(apart[lasts]).all():
        bad = drives.ids[at[int(np.argmax(~np.isfinite(apart).all(axis=1)))]]
        raise InputError(
            f"held-out drives: {row.name}: {bad}: station: expected a finite number"
        )
    places = [
        np.where(steps >= round(t / STEP_S), apart[:, round(t / STEP_S) - 1], np.nan)
        for t in TIMES_SHOWN_S
    ]
    mean = lambda x: np.sum(np.where(lasts, x, 0.0), axis=1) / lasts.sum(axis=1)  # noqa: E731
    a = np.asarray(record.a, np.float64)
    moves = lasts[:, 1:]
    return Driven(
        distance=mean(apart),
        at=np.stack(places, axis=1),
        mean_speed=mean(np.asarray(record.v, np.float64)),
        traffic=traffic_of(record, lasts),
        samples={
            "acceleration": a[lasts],
            "jerk": (np.diff(a, axis=1) / STEP_S)[moves],
            "headway": np.asarray(record.headway)[lasts],
            "time_to_collision": np.asarray(record.ttc)[lasts],
        },
        not_driven=lost,
    )


def traffic_of(record: Record, lasts: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the safety of drives, [n] by the names of TRAFFIC.

    Only what happens before an ending crash counts; the shares of time are of all of
    the drive.

    Args:
      record: leaves [n, S], numpy.
      lasts: [n, S] bool, the recorded time.
    """
    valid = lasts & np.asarray(record.valid)
    happens = {
        "collision": record.at_fault > 0,
        "ttc": record.ttc < MetricsConfig.nuplan_ttc,
        "braking": record.induced_braking > BRAKING_MPS2,
    }
    close = (record.headway < HEADWAY_S) & (record.v > MOVING_MPS) & valid
    found = {key: np.any(x & valid, axis=1) for key, x in happens.items()}
    found["headway"] = close.sum(axis=1) / lasts.sum(axis=1)
    return {key: np.asarray(x, np.float64) for key, x in found.items()}
