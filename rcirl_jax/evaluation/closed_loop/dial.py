"""The dial: one number that multiplies the gain of a learned value on its own cost.

    V_total = V_own + dial gain V

At 0 the own cost drives alone, at 1 the weights file as it is. Every setting drives the
same cases and held-out drives, so differences to setting 0 are paired: by family of the
cases, and by vehicle of the held-out drives.
"""

import dataclasses
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from rcirl_jax.evaluation.closed_loop.summary import rate
from rcirl_jax.evaluation.statistics import (
    ClusterBootstrap,
    combine_seeds,
    family_clusters,
    over_clusters,
)
from rcirl_jax.simulation.metrics import CaseMetrics, nuplan_score

SETTINGS, CASES = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0), 10  # and cases of each family
FEW_SETTINGS, FEW_CASES = (0.0, 0.5, 1.0, 2.0), 2  # of a run that drives little


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measure:
    """One number of a setting."""

    title: str
    unit: str
    digits: int
    better: str  # higher or lower
    is_rate: bool  # share of cases, with its exact interval


MEASURES = {
    name: Measure(title=title, unit=unit, digits=digits, better=better, is_rate=is_rate)
    for name, title, unit, digits, better, is_rate in (
        ("nuplan", "nuPlan", "points", 1, "higher", False),
        ("progress", "progress", "% of the own cost's", 1, "higher", False),
        ("no_fault", "no at-fault collision", "% of cases", 1, "higher", True),
        ("rms_acceleration", "RMS acceleration", "m/s²", 2, "lower", False),
        ("rms_jerk", "RMS jerk", "m/s³", 2, "lower", False),
        ("distance", "distance to the human", "m", 2, "lower", False),
    )
}


def compare_settings(
    rows: Mapping[float, CaseMetrics],
    families: np.ndarray,
    way: np.ndarray,
    distance: Mapping[float, np.ndarray],
    vehicles: np.ndarray,
) -> dict[float, dict[str, dict]]:
    """Returns every measure of every setting, and its difference to setting 0.

    Amounts have intervals over families or vehicles (`combine_seeds`), rates exact
    ones (`rate`); differences, and progress, have the wider of two (`over_clusters`).

    Args:
      rows: metrics by setting, leaves [C, ...]; 0 is among them.
      families: [C] names.
      way: [C] m, how far the reference of the suite got.
      distance: [D] m to the human by setting, on the same held-out drives.
      vehicles: [D] int, the ego's vehicle in each of them.

    Returns:
      Setting -> name in MEASURES -> value, low, high, and "minus_own" with mean, low,
      high and p.
    """
    cases = ClusterBootstrap(family_clusters(families))
    drives = ClusterBootstrap(vehicles)
    own = np.mean(np.asarray(rows[0.0].progress, np.float64))
    found = {
        dial: {
            "nuplan": 100.0 * np.asarray(nuplan_score(m, jnp.asarray(way))[0]),
            "progress": 100.0 * np.asarray(m.progress) / max(own, 1e-9),
            "no_fault": 100.0 * (np.asarray(m.at_fault) == 0),
            "rms_acceleration": np.asarray(m.rms_a),
            "rms_jerk": np.asarray(m.rms_j),
            "distance": distance[dial],
        }
        for dial, m in rows.items()
    }

    def measured(dial: float, name: str) -> dict:
        values = np.asarray(found[dial][name], np.float64)
        clusters = drives if name == "distance" else cases
        others = np.asarray(found[0.0][name], np.float64)
        apart = dataclasses.asdict(over_clusters(values, others, clusters))
        if name == "progress":  # a share of setting 0: its interval is a difference's
            ends = {key: 100.0 + apart[key] for key in ("low", "high")}
            ends["value"] = 100.0 + apart["mean"]
        elif MEASURES[name].is_rate:
            exact = rate(int(np.sum(values > 0.0)), values.size)
            ends = {key: 100.0 * getattr(exact, key) for key in ("rate", "low", "high")}
            ends["value"] = ends.pop("rate")
        else:
            mean = combine_seeds(values, clusters)
            ends = {key: getattr(mean, key) for key in ("value", "low", "high")}
        return {
            **ends,
            "minus_own": {k: apart[k] for k in ("mean", "low", "high", "p")},
        }

    return {dial: {name: measured(dial, name) for name in MEASURES} for dial in rows}
