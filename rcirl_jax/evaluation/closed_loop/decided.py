"""The share of the learned part: plans that differ from the own cost's choice.

Every four seconds of its drives the candidate and its own cost alone choose in the same
scene, among the same candidates and with the same plan in force
(`rollout.plans_along`). A plan differs if the ego would be more than `SAME_M` elsewhere
at any planned time. Where the safety filter leaves one plan, both take it: such moments
count too.
"""

import concurrent.futures
import dataclasses
import os
from collections.abc import Sequence

import jax
import numpy as np

from rcirl_jax.evaluation.statistics import clopper_pearson, combine_seeds
from rcirl_jax.simulation.cases import STEP_S, Case
from rcirl_jax.simulation.rollout import LANES, plans_along
from rcirl_jax.simulation.rows import Row
from rcirl_jax.simulation.suite import rollout_config
from rcirl_jax.units import TIMES_S

EVERY_S = 4.0  # s between two moments
SAME_M = 0.1  # m within which two plans are one
FEW = 5  # clusters below which no interval over them is made
SHOWN_S = 5.0  # s at which it is said how far apart plans are


def decided(
    row: Row,
    own: Row,
    cases: Case,
    groups: Sequence[str],
    clusters: np.ndarray,
    duration_s: float,
    plan_every: int = 1,
) -> dict[str, dict]:
    """Returns by group how often a row plans otherwise than its own cost would.

    Args:
      row: the candidate, which drives.
      own: its own cost, ranked by the same program.
      cases: leaves [C, ...].
      groups: [C] names: families, or sites.
      clusters: [C] int, what is independent: cases, or vehicles.
      duration_s: of a case.
      plan_every: steps of 0.1 s between two plans.

    Returns:
      Group, or "all" -> "moments"; "share" of them in which the plan differs, with
      "low" and "high" over clusters (None where these are fewer than `FEW`); and
      "apart_m", how far apart the two plans are after `SHOWN_S` where they differ, on
      average.
    """
    config = rollout_config(row, duration_s, plan_every)
    every = round(EVERY_S / STEP_S / config.span) * config.span
    config = dataclasses.replace(config, frames_every=max(every, config.span))
    count = len(groups)

    def group(first: int) -> tuple[np.ndarray, np.ndarray]:
        # groups of one size are driven by the programs that there are
        at = np.minimum(np.arange(first, first + LANES), count - 1)
        some = jax.tree.map(lambda x: np.asarray(x)[at], cases)
        plans, fine = plans_along(row.policy, (row.params, own.params), some, config)
        apart = np.hypot(*np.moveaxis(plans[0] - plans[1], 2, 0))
        return apart[: count - first], fine[: count - first]

    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        made = list(pool.map(group, range(0, count, LANES)))
    gap, valid = (np.concatenate(x) for x in zip(*made, strict=True))
    differ = (gap.max(axis=-1) > SAME_M) & valid
    gap, names = gap[..., np.searchsorted(TIMES_S, SHOWN_S)], np.asarray(groups)

    def of(at: np.ndarray) -> dict:
        moments, many = valid[at].sum(axis=1), differ[at].sum(axis=1)
        ends: dict[str, float | None] = {"low": None, "high": None}
        if (count := np.unique(clusters[at]).size) >= FEW:
            share = many / np.maximum(moments, 1)
            found = combine_seeds(share, clusters[at], weight=moments.astype(float))
            ends = {"low": max(found.low, 0.0), "high": min(found.high, 1.0)}
            if not many.any():
                ends["high"] = clopper_pearson(0, count)[1]
        return {
            "moments": int(moments.sum()),
            "share": float(many.sum() / max(moments.sum(), 1)),
            **ends,
            "apart_m": float(gap[at][differ[at]].mean()) if many.any() else 0.0,
        }

    found = {name: of(np.flatnonzero(names == name)) for name in dict.fromkeys(groups)}
    return {"all": of(np.arange(count)), **found}
