"""Human-likeness in the gate: how near to held-out recorded drives.

Distances are paired by drive and clustered by vehicle. Differences are shares of the
other row's mean distance, positive where the candidate is nearer. Host numpy. `D`
recorded drives.
"""

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.gate.stats import MIN_CLUSTERS, over_clusters
from rcirl_jax.evaluation.gate.types import (
    CANDIDATE,
    Check,
    GateConfig,
    Kind,
    Likeness,
    Outcome,
    Pair,
    check_of,
    unmeasured,
)
from rcirl_jax.evaluation.gate.words import name_of
from rcirl_jax.evaluation.statistics import ClusterBootstrap, Difference

# what to do where nothing was measured
TO_MEASURE = "measure human-likeness on held-out recordings (docs/gate.md)"


def against_trivial(pair: Pair, config: GateConfig) -> list[Check]:
    """Nearer to the human than each trivial baseline passes, farther fails."""
    return [
        _check(
            pair, "trivial baselines", f"likeness, {name}",
            f"nearer to the human than {name}", name,
        )
        for name in config.trivial_baselines
    ]  # fmt: skip


def against_incumbent(pair: Pair) -> list[Check]:
    """Not farther from the human than the incumbent, outside the interval: fail."""
    title = f"not farther from the human than {name_of(pair)}"
    return [_check(pair, "likeness", "likeness", title, pair.name)]


def gain(pair: Pair) -> Difference | None:
    """Candidate nearer than the incumbent; None: not measured, or too few drives."""
    known = pair.likeness
    if known is None or _few(known):
        return None
    return _nearer(known, pair.name)


def _check(pair: Pair, kind: Kind, name: str, title: str, other: str) -> Check:
    """The candidate against one row."""
    if pair.likeness is None:
        return unmeasured(kind, name, title, TO_MEASURE)
    if few := _few(pair.likeness):
        return unmeasured(kind, name, title, few)
    found = _nearer(pair.likeness, other)
    outcome: Outcome = "open" if kind == "trivial baselines" else "pass"
    if found.high < 0.0:
        outcome = "fail"
    elif found.low > 0.0:
        outcome = "pass"
    return check_of(kind, name, title, outcome, found, p=found.p)


def _few(known: Likeness) -> str:
    """Why there is no interval; "" if there is one."""
    clusters = len(np.unique(known.clusters))
    if clusters >= MIN_CLUSTERS:
        return ""
    return (
        f"{clusters} vehicles are too few for an interval over them:"
        f" measure at least {MIN_CLUSTERS}"
    )


def _nearer(known: Likeness, other: str) -> Difference:
    """Mean of (other's - candidate's distance), as a share of the other's mean.

    Raises:
      InputError: no distances of one of the two.
    """
    for name in (CANDIDATE, other):
        if name not in known.distance:
            some = ", ".join(known.distance)
            raise InputError(f"likeness: {name}: expected a row of {some}")
    mine, theirs = (
        np.asarray(known.distance[name], np.float64) for name in (CANDIDATE, other)
    )
    scale = max(float(theirs.mean()), 1e-9)
    return over_clusters(
        theirs / scale, mine / scale, ClusterBootstrap(np.asarray(known.clusters))
    )
