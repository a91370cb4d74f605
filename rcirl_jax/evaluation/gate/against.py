"""The best arguments against shipping, each with its number; also where all passes.

A verdict says what was shown. This says what a reader who distrusts it would ask about:
the family that loses most, drivers that are as near to people, baselines that score
more, and how many more faults the cases do not exclude.
"""

from collections.abc import Iterator, Sequence

import jax.numpy as jnp
import numpy as np

from rcirl_jax.evaluation.gate.types import (
    CANDIDATE,
    INCUMBENT,
    Check,
    Pair,
)
from rcirl_jax.evaluation.gate.words import WORDS, family_of, name_of
from rcirl_jax.evaluation.statistics import (
    ClusterBootstrap,
    Difference,
    family_clusters,
    over_clusters,
)
from rcirl_jax.simulation.families import family_title
from rcirl_jax.simulation.metrics import nuplan_score

MOST = 3  # arguments that are told


def against(pair: Pair, checks: Sequence[Check]) -> tuple[str, ...]:
    """Returns the best arguments against the candidate, at most `MOST` sentences.

    Args:
      pair: the drives.
      checks: all that were made of them.
    """
    found = (
        *_worst_family(pair, checks),
        *_nearer_driver(pair),
        *_higher_score(pair),
        *_not_excluded(checks, len(pair.runs.ids)),
    )
    return found[:MOST]


def _worst_family(pair: Pair, checks: Sequence[Check]) -> Iterator[str]:
    """The largest loss in a family, in units of its margin; none without a loss."""
    losses = [c for c in checks if c.kind == "families" and c.difference < 0.0]
    if not losses:
        return
    one = min(losses, key=lambda c: c.difference / (c.margin or 1.0))
    low, high = (-100.0 * x for x in (one.high, one.low))
    what = "less progress" if one.lost is None else "fewer clean drives"
    yield (
        f'It loses most in "{family_title(family_of(one))}": '
        f"{-100.0 * one.difference:.1f} % {what} than {name_of(pair)} "
        f"[{low:.1f}, {high:.1f}]"
    )


def _nearer_driver(pair: Pair) -> Iterator[str]:
    """The driver nearest to people among those that the candidate is not ahead of."""
    known = pair.likeness
    if known is None or np.unique(known.clusters).size < 2:
        return
    clusters, mine = ClusterBootstrap(known.clusters), known.distance[CANDIDATE]
    apart = {
        name: over_clusters(mine, other, clusters)
        for name, other in known.distance.items()
        if name != CANDIDATE
    }
    behind = {name: d for name, d in apart.items() if d.high >= 0.0}
    if not behind:
        return
    name, d = max(behind.items(), key=lambda item: item[1].mean)
    says = "farther from" if d.low > 0.0 else "not shown to be nearer to"
    yield (
        f"On held-out recordings it is {says} people than {name_of(pair, name)}: its "
        f"distance minus that one's {_numbers(d, 1.0, 2)} m"
    )


def _higher_score(pair: Pair) -> Iterator[str]:
    """The driver of the highest nuPlan score, if that is not the candidate."""
    runs, clusters = pair.runs, family_clusters(pair.runs.groups)
    way = jnp.asarray(runs.way)
    scores = {
        name: np.asarray(nuplan_score(row, way)[0], np.float64)
        for name, row in runs.rows.items()
    }
    best = max(scores, key=lambda name: scores[name].mean())
    if scores[best].mean() <= scores[pair.mine].mean() or np.unique(clusters).size < 2:
        return
    d = over_clusters(scores[best], scores[pair.mine], ClusterBootstrap(clusters))
    who = "The incumbent" if best == INCUMBENT else best
    yield f"{who} has more of nuPlan's points: by {_numbers(d, 100.0, 1)}"


def _not_excluded(checks: Sequence[Check], cases: int) -> Iterator[str]:
    """The most cases with more of a fault that the suite leaves possible."""
    known = [c for c in checks if c.kind == "safety" and c.measured]
    for one in sorted(known, key=lambda c: c.low)[:1]:
        title = WORDS[one.name.partition(", ")[0]].title
        yield (
            f"Of {cases:,} cases up to {-one.low * cases:.0f} more with {title} are not"
            f" excluded; counted were {one.lost} more, {one.gained} fewer"
        )


def _numbers(d: Difference, scale: float, digits: int) -> str:
    """Returns a difference with its interval."""
    mean, low, high = (f"{scale * x:.{digits}f}" for x in (d.mean, d.low, d.high))
    return f"{mean} [{low}, {high}]"
