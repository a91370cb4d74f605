"""The choice of lane on held-out scenes, where paths are planned.

Two groups of scenes count: those in which the human crosses a line of its lane and ends
beyond it, and those in which it crosses none. Of the candidate that a scorer values
most, one number per scene says whether it ends on the human's side, when it crosses the
line, and how far aside it ends. Host numpy, float64. Axes: `R` runs, `S` scenes, `K`
candidates, `T` times.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.evaluation.ranking.metrics import Metric, bounded, chosen_of, pick
from rcirl_jax.evaluation.statistics import (
    ClusterBootstrap,
    Difference,
    Estimate,
    combine_seeds,
    paired_difference,
)
from rcirl_jax.planner.mobil import MOBIL_ROW
from rcirl_jax.types import Path
from rcirl_jax.units import DT_S, TIMES_S

IN_TIME_S = 2.0  # s by which the line may be crossed earlier or later
LANE_METRICS: dict[str, Metric] = {
    "right_side": Metric("right side", "%", True),
    "in_time": Metric(f"and within {IN_TIME_S:g} s", "%", True),
    "crossing_error": Metric("crosses off by", "s", False),
    "lateral_fde": Metric("lateral FDE", "m", False),
    "keeps": Metric("keeps the lane too", "%", True),  # of scenes without a change
}


class Lanes(NamedTuple):
    """The lanes in which trajectories are at the horizon; of candidates [S, K]."""

    l: np.ndarray | jax.Array  # m, offset at the horizon
    side: np.ndarray | jax.Array  # 1 left of the lane of t = 0, -1 right of it, 0 in it
    crossed_s: np.ndarray | jax.Array  # s, first time beyond it; the horizon if never


class LaneOutcomes(NamedTuple):
    """Lanes of all candidates [S, K] and of the humans [S]."""

    candidates: Lanes
    human: Lanes
    horizon_s: float

    @property
    def changes(self) -> np.ndarray:
        """[S] bool: the human crosses a line before the horizon and ends beyond it."""
        _, side, crossed = self.human
        return np.asarray((side != 0) & (crossed > 0.0) & (crossed < self.horizon_s))

    @property
    def stays(self) -> np.ndarray:
        """[S] bool: the human crosses none."""
        _, side, crossed = self.human
        return np.asarray((side == 0) & (crossed >= self.horizon_s))


def lanes_of(l: jax.Array, end: jax.Array, path: Path, horizon_s: float) -> Lanes:
    """Returns the lanes of trajectories of one scene, leaves [K].

    Args:
      l: [K, T] m, offsets.
      end: [K] m, those at the horizon.
      path: of the scene; its lane at t = 0 counts.
      horizon_s: s.
    """
    middle = 0.5 * (path.lane_left[0] + path.lane_right[0])
    half = 0.5 * (path.lane_left[0] - path.lane_right[0])
    off, times = jnp.abs(l - middle), jnp.asarray(TIMES_S)
    beyond = (off >= half) & (times < horizon_s)
    first = jnp.argmax(beyond, axis=1)[:, None]
    now, before = (
        jnp.take_along_axis(off, at, axis=1)[:, 0]
        for at in (first, jnp.maximum(first - 1, 0))
    )
    back = jnp.where(first[:, 0] > 0, now - half, 0.0) / jnp.maximum(now - before, 1e-6)
    crossed = times[first[:, 0]] - DT_S * jnp.clip(back, 0.0, 1.0)
    return Lanes(
        l=end,
        side=jnp.where(jnp.abs(end - middle) >= half, jnp.sign(end - middle), 0.0),
        crossed_s=jnp.where(jnp.any(beyond, axis=1), crossed, horizon_s),
    )


def lane_metrics(
    values: np.ndarray, feasible: np.ndarray, lanes: LaneOutcomes
) -> dict[str, np.ndarray]:
    """Returns LANE_METRICS of one scorer, [S] each.

    Who never crosses, or ends on another side, is charged as if it crossed at the
    horizon.

    Args:
      values: [S, K] of the candidates.
      feasible: [S, K] bool.
      lanes: of the same scenes.
    """
    chosen = chosen_of(values, feasible)
    l, side, crossed = (pick(np.asarray(x), chosen) for x in lanes.candidates)
    right = side == lanes.human.side
    crossed = np.where(right, crossed, lanes.horizon_s)
    off = np.abs(crossed - lanes.human.crossed_s)
    found = {
        "right_side": right,
        "in_time": right & (off <= IN_TIME_S),
        "crossing_error": off,
        "lateral_fde": np.abs(l - lanes.human.l),
        "keeps": right,
    }
    return {name: np.asarray(x, np.float64) for name, x in found.items()}


@dataclasses.dataclass(frozen=True, kw_only=True)
class LaneReport:
    """The choice of lane of every row."""

    changes: int  # scenes in which the human changes lane
    vehicles: int  # of them
    stays: int  # scenes in which the human keeps its lane
    rows: dict[str, dict[str, Estimate]]  # row -> of LANE_METRICS
    # row -> share on the right side in time, minus MOBIL's
    minus_mobil: dict[str, Difference]


def lane_report(
    table: Mapping[str, Sequence[Mapping[str, np.ndarray]]],
    lanes: LaneOutcomes,
    cluster: np.ndarray,
) -> LaneReport | None:
    """Estimates LANE_METRICS of every row, with intervals over vehicles and runs.

    Args:
      table: row -> `lane_metrics` of each run, among others.
      lanes: of all scenes.
      cluster: [S] int, the vehicle of each scene.

    Returns:
      None where a group of scenes has fewer than two vehicles.
    """
    groups = {"changes": lanes.changes, "stays": lanes.stays}
    if any(np.unique(cluster[some]).size < 2 for some in groups.values()):
        return None
    drawn = {name: ClusterBootstrap(cluster[some]) for name, some in groups.items()}

    def of(runs: Sequence[Mapping[str, np.ndarray]], metric: str) -> tuple:
        group = "stays" if metric == "keeps" else "changes"
        return np.stack([run[metric][groups[group]] for run in runs]), drawn[group]

    def estimate(runs: Sequence[Mapping[str, np.ndarray]], metric: str) -> Estimate:
        values, bootstrap = of(runs, metric)
        found = combine_seeds(values, bootstrap)
        unit, vehicles = LANE_METRICS[metric].unit, bootstrap.num_clusters
        return bounded(found, values, unit, vehicles)

    minus = {}
    for row in table if MOBIL_ROW in table else ():
        (own, bootstrap), (theirs, _) = (
            of(table[name], "in_time") for name in (row, MOBIL_ROW)
        )
        if row != MOBIL_ROW:
            minus[row] = paired_difference(own, theirs, bootstrap)
    return LaneReport(
        changes=int(lanes.changes.sum()),
        vehicles=drawn["changes"].num_clusters,
        stays=int(lanes.stays.sum()),
        rows={
            row: {metric: estimate(runs, metric) for metric in LANE_METRICS}
            for row, runs in table.items()
        },
        minus_mobil=minus,
    )
