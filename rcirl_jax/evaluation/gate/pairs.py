"""Pairs of drivers whose truth is known: equal, worse or better by construction.

`CONSTRUCTED` names what is driven; `swapped` and `redrawn` make equal pairs of any two.
How often the gate is wrong about them is counted in `gate_errors`. Host numpy, but for
the drivers.
"""

import dataclasses
import functools
from collections.abc import Sequence

import jax
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.files import SuiteRuns
from rcirl_jax.evaluation.gate.runs import pair_of
from rcirl_jax.evaluation.gate.stats import MIN_CLUSTERS
from rcirl_jax.evaluation.gate.types import CANDIDATE, Likeness, Pair
from rcirl_jax.planner.baselines import Idm
from rcirl_jax.planner.plan import Plan
from rcirl_jax.planner.rank import (
    Params,
    Policy,
    RankConfig,
    hand_score,
    idm_policy,
    rank_policy,
)
from rcirl_jax.reward.hand import LatticeCost
from rcirl_jax.simulation.metrics import CaseMetrics
from rcirl_jax.simulation.rows import Row, tuned_row
from rcirl_jax.types import Scene

COINS = 7919  # of the coins' random stream, which nothing else may share

MIXES = 7927  # of the mixes' random stream

OTHER_STREAM = 1  # fold_in number of the other candidates' keys

# rows that constructed pairs are made of
HAND_SET, IDM = "hand-set", "IDM"

OTHER, SLOWER, SLOWEST = (
    f"{HAND_SET}, {what}" for what in ("other candidates", "5 % slower", "20 % slower")
)

SPEED_SHARES = {SLOWER: 0.95, SLOWEST: 0.8}  # 1, wanted speed as a share of the limit


@dataclasses.dataclass(frozen=True, kw_only=True)
class Constructed:
    """A driver against hand-set, of which it is made."""

    name: str
    truth: str  # "equal", "better" or "worse", of the candidate
    candidate: str = HAND_SET  # a row
    # a row that drives a share of the candidate's cases, or of those with its own fault
    mixed_in: str = ""
    share: float = 0.0
    faulty: bool = False
    # candidate and incumbent exchanged at last
    reverse: bool = False


CONSTRUCTED = (
    Constructed(name=OTHER, truth="equal", candidate=OTHER),
    Constructed(name=SLOWER, truth="worse", candidate=SLOWER),
    Constructed(name=SLOWEST, truth="worse", candidate=SLOWEST),
    Constructed(
        name=f"{HAND_SET}, {IDM} in 5 % of the cases",
        truth="worse",
        mixed_in=IDM,
        share=0.05,
    ),
    Constructed(
        name=f"{HAND_SET}, {IDM} where it is at fault",
        truth="worse",
        mixed_in=IDM,
        share=1.0,
        faulty=True,
    ),
    Constructed(
        name=f"{HAND_SET} for 5 % slower",
        truth="better",
        candidate=SLOWER,
        reverse=True,
    ),
    Constructed(
        name=f"{HAND_SET} for it with {IDM} where it is at fault",
        truth="better",
        mixed_in=IDM,
        share=1.0,
        faulty=True,
        reverse=True,
    ),
)


def swapped(pair: Pair, rng: np.random.Generator, *, by_family: bool = False) -> Pair:
    """The pair with candidate and incumbent exchanged in about half of the cases."""
    if by_family:
        _, family = np.unique(pair.families, return_inverse=True)
        coin = (rng.random(family.max() + 1) < 0.5)[family]
    else:
        coin = rng.random(len(pair.ids)) < 0.5

    return dataclasses.replace(
        pair,
        candidate=_chosen(coin, pair.incumbent, pair.candidate),
        incumbent=_chosen(coin, pair.candidate, pair.incumbent),
    )


def _chosen(
    where: np.ndarray, there: CaseMetrics, elsewhere: CaseMetrics
) -> CaseMetrics:
    """The drives of `there` in the cases `where` [C], of `elsewhere` in the others."""

    def pick(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        a, b = np.asarray(a), np.asarray(b)
        return np.where(where.reshape(-1, *[1] * (a.ndim - 1)), a, b)

    return jax.tree.map(pick, there, elsewhere)


def mixed(
    drives: CaseMetrics,
    others: CaseMetrics,
    among: np.ndarray,
    share: float,
    rng: np.random.Generator,
) -> CaseMetrics:
    """Some drives exchanged for another driver's of the same cases.

    Args:
      drives: leaves [C, ...].
      others: likewise.
      among: [C] bool, the n cases of which some are drawn.
      share: of them that are drawn, within (0, 1].
      rng: draws which.

    Returns:
      Leaves [C, ...]: those of `others` in round(share n) cases, else of `drives`.
    """
    places = np.flatnonzero(among)
    where = np.zeros(len(among), bool)
    where[rng.choice(places, round(share * places.size), replace=False)] = True
    return _chosen(where, others, drives)


def redrawn(first: Pair, second: Pair) -> Pair:
    """The incumbent's drives in `first` against its drives in `second`.

    Raises:
      InputError: the two do not have as many cases of the same families.
    """
    if list(first.families) != list(second.families):
        raise InputError("gate_errors: expected two suites of the same families")
    return dataclasses.replace(second, candidate=first.incumbent)


def pair_between(runs: SuiteRuns, candidate: str, incumbent: str) -> Pair:
    """Two rows of a driven suite, equally near to the human; without nulls.

    Raises:
      InputError: the suite has no such rows.
    """
    alike = Likeness(
        distance=dict.fromkeys((CANDIDATE, incumbent), np.ones(MIN_CLUSTERS)),
        clusters=np.arange(MIN_CLUSTERS),
    )
    return pair_of(runs, incumbent, (), alike, candidate=candidate)


def joined(pairs: Sequence[Pair]) -> Pair:
    """The cases of several suites, all different, as one suite."""
    return dataclasses.replace(
        pairs[0],
        candidate=stacked([pair.candidate for pair in pairs]),
        incumbent=stacked([pair.incumbent for pair in pairs]),
        families=[name for pair in pairs for name in pair.families],
        ids=[name for pair in pairs for name in pair.ids],
        reference=np.concatenate([pair.reference for pair in pairs]),
        preventable=np.concatenate([pair.preventable for pair in pairs]),
    )


def stacked(drives: Sequence[CaseMetrics]) -> CaseMetrics:
    """The drives of several suites one after another."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *drives)


@functools.lru_cache(maxsize=4)
def other_candidates(policy: Policy, stream: int) -> Policy:
    """The same planner with other random candidates: `stream` folded into its key."""

    def other(
        params: Params, scene: Scene, key: jax.Array, before: Plan | None = None
    ) -> Plan:
        return policy(params, scene, jax.random.fold_in(key, stream), before)

    return other


def constructed_rows() -> list[Row]:
    """The rows that `CONSTRUCTED` names: three of hand-set's making, it, and IDM."""
    config = RankConfig()
    policy = rank_policy(hand_score, config)
    slower = [
        dataclasses.replace(tuned_row(LatticeCost(speed_share=x), config), name=name)
        for name, x in SPEED_SHARES.items()
    ]
    return [
        Row(name=HAND_SET, policy=policy),
        Row(name=OTHER, policy=other_candidates(policy, OTHER_STREAM)),
        *slower,
        Row(name=IDM, policy=idm_policy(Idm())),
    ]


def constructed_pair(
    made: Constructed, runs: SuiteRuns, rng: np.random.Generator
) -> Pair:
    """The pair of one of `CONSTRUCTED` on a suite; `rng` draws the mixed cases."""
    pair = pair_between(runs, made.candidate, HAND_SET)
    if made.mixed_in:
        others = runs.rows[made.mixed_in]
        faults = np.asarray(others.at_fault) > 0
        among = faults if made.faulty else np.ones_like(faults)
        drives = mixed(pair.candidate, others, among, made.share, rng)
        pair = dataclasses.replace(pair, candidate=drives)
    if made.reverse:
        both = {"candidate": pair.incumbent, "incumbent": pair.candidate}
        pair = dataclasses.replace(pair, **both)
    return pair
