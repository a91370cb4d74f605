"""Weights files and names -> the rows of a closed-loop table."""

from collections.abc import Sequence

import jax.numpy as jnp

from rcirl_jax.errors import InputError
from rcirl_jax.export.loading import (
    familiarity_of,
    open_reward,
    reward_params,
    row_names,
)
from rcirl_jax.export.reader import Reward
from rcirl_jax.features import feature_map
from rcirl_jax.planner.baselines import TUNED_IDM_ROW, Idm
from rcirl_jax.planner.dp import dp_policy
from rcirl_jax.planner.grid import DpConfig
from rcirl_jax.planner.prior_cost import WithPriorCost, prior_cost_score
from rcirl_jax.planner.rank import (
    Params,
    RankConfig,
    Score,
    hand_score,
    idm_policy,
    learned_score,
    rank_policy,
)
from rcirl_jax.planner.safety import SafetyConfig
from rcirl_jax.simulation.rows import (
    Row,
    baseline_row,
)

DP_EVERY = 10  # steps between two plans of the DP row: it costs 1,000 rankings


def score_of(reward: Reward) -> tuple[Score, Params]:
    """What a weights file drives by: V, or its prior cost and V."""
    features, params = feature_map(str(reward.preset)), reward_params(reward)
    prior_cost = reward.prior_cost
    if prior_cost is None:
        return learned_score(features, reward.activation), params
    known = {"hand-set": hand_score}
    if prior_cost.incumbent not in known:
        raise InputError(
            f"{reward.file}: prior_cost.incumbent: {prior_cost.incumbent}: expected "
            f"one of {', '.join(known)}, whose cost is known here"
        )
    score = prior_cost_score(features, reward.activation, known[prior_cost.incumbent])
    effective, normaliser = params
    return score, WithPriorCost(
        reward=effective,
        normaliser=normaliser,
        familiarity=familiarity_of(prior_cost),
        low=jnp.asarray(prior_cost.low, jnp.float32),
        high=jnp.asarray(prior_cost.high, jnp.float32),
        own=None,
    )


def incumbent_score(name: str) -> tuple[Score, Params]:
    """The score of "hand-set" or of a weights file, and its weights.

    Raises:
      InputError: neither.
    """
    return (hand_score, None) if name == "hand-set" else score_of(open_reward(name))


def table_rows(
    weights: Sequence[str],
    baselines: Sequence[str],
    plan_every: int = 1,
    *,
    dp: bool = False,
    tuned_idm: Idm | None = None,
    names: Sequence[str] = (),
    track: str = "full",
) -> list[Row]:
    """Learned rows first, in the order of the files, then the baselines.

    Rows are named as by `row_names`, or bear `names`, one per file. The first drives
    again by `dp`. A tuned IDM comes last. `track` is the safety filter's
    (`SafetyConfig`).

    Raises:
      InputError: no file, an unreadable one, one twice without `names`, path_speed
        weights, or an unknown baseline.
    """
    if not weights:
        raise InputError("--weights: none: expected at least one file")
    config = RankConfig(safety=SafetyConfig(track=track))
    rewards = [open_reward(path) for path in weights]
    rows = _learned_rows(rewards, names, config)
    first = rewards[0]
    preset, params = str(first.preset), reward_params(first)
    if dp and first.prior_cost is not None:
        raise InputError(
            f"--dp: {first.file}: expected a reward without a prior cost: the own cost "
            "is no sum over points"
        )
    if dp:
        policy = dp_policy(feature_map(preset), first.activation, config, DpConfig())
        every, name = max(plan_every, DP_EVERY), f"{rows[0].name} DP"
        row = Row(name=name, policy=policy, params=params, plan_every=every)
        rows.insert(1, row)
    rows += [baseline_row(name, preset, params[1], config) for name in baselines]
    if tuned_idm is not None:
        rows.append(Row(name=TUNED_IDM_ROW, policy=idm_policy(tuned_idm)))
    return rows


def _learned_rows(
    rewards: Sequence[Reward], names: Sequence[str], config: RankConfig
) -> list[Row]:
    """One row a file, under distinct names."""
    rows: list[Row] = []
    for reward, name in zip(rewards, names or row_names(rewards), strict=True):
        mode = str(reward.provenance.get("mode", "speed"))
        if mode != "speed":
            raise InputError(
                f"{reward.file}: mode: {mode}: the closed loop plans speed"
            )
        seed = int(reward.provenance.get("seed") or 0)
        score, params = score_of(reward)
        policy = rank_policy(score, config)
        rows.append(Row(name=name, policy=policy, params=params, seed=seed))
    return rows
