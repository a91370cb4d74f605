"""Weights files and names -> the rows of a closed-loop table."""

from collections.abc import Sequence

import jax.numpy as jnp

from rcirl_jax.errors import InputError
from rcirl_jax.export.guard import Limits, bounds
from rcirl_jax.export.loading import open_reward, reward_params, row_name
from rcirl_jax.export.reader import Reward
from rcirl_jax.features import feature_map
from rcirl_jax.planner.anchor import Anchored, anchored_score
from rcirl_jax.planner.baselines import TUNED_IDM_ROW, Idm
from rcirl_jax.planner.grid import DpConfig
from rcirl_jax.planner.guard import Guarded, Ranges
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
from rcirl_jax.reward import LatticeCost
from rcirl_jax.simulation.rows import (
    Row,
    baseline_row,
    dp_row,
    guarded_row,
    learned_row,
    tuned_row,
)

DP_EVERY = 10  # steps between two plans of the DP row: it costs 1,000 rankings


def incumbent_score(name: str) -> tuple[Score, Params]:
    """The score of "hand-set" or of a weights file, and its weights.

    Raises:
      InputError: neither.
    """
    if name == "hand-set":
        return hand_score, None
    other = open_reward(name)
    score = learned_score(feature_map(str(other.preset)), other.activation)
    return score, reward_params(other)


def _ranges(reward: Reward) -> Ranges:
    low, high = bounds(reward, Limits())
    return Ranges(low=jnp.asarray(low), high=jnp.asarray(high))


def _guarded(name: str, reward: Reward, incumbent: str, config: RankConfig) -> Row:
    """A row behind the guard; the incumbent drives what is out of distribution."""
    score, weights = incumbent_score(incumbent)
    effective, normaliser = reward_params(reward)
    params = Guarded(
        reward=effective,
        normaliser=normaliser,
        ranges=_ranges(reward),
        share=jnp.asarray(Limits().share, jnp.float32),
        incumbent=weights,
    )
    return guarded_row(
        f"{name} guarded", params, str(reward.preset), reward.activation, config, score
    )


def anchored_row(
    name: str,
    reward: Reward,
    incumbent: str,
    gain: float,
    config: RankConfig | None = None,
) -> Row:
    """A row that drives by V_incumbent + gain support V (`planner.anchor`).

    Args:
      name: of the row.
      reward: V.
      incumbent: "hand-set" or a weights file.
      gain: of V.
      config: of the ranking planner; None: its defaults.
    """
    score, weights = incumbent_score(incumbent)
    effective, normaliser = reward_params(reward)
    params = Anchored(
        reward=effective,
        normaliser=normaliser,
        ranges=_ranges(reward),
        gain=jnp.asarray(gain, jnp.float32),
        incumbent=weights,
    )
    both = anchored_score(feature_map(str(reward.preset)), reward.activation, score)
    return Row(
        name=name, policy=rank_policy(both, config or RankConfig()), params=params
    )


def table_rows(
    weights: Sequence[str],
    baselines: Sequence[str],
    plan_every: int = 1,
    *,
    dp: bool = False,
    hand_set: LatticeCost | None = None,
    tuned_idm: Idm | None = None,
    names: Sequence[str] = (),
    guard: str | None = None,
    anchor: tuple[str, float] | None = None,
    track: str = "full",
) -> list[Row]:
    """Learned rows first, in the order of the files, then the baselines.

    Files of one loss and shape are told apart by their seed, then by their path, or
    rows bear `names`, one per file. The first drives again by `dp`, behind a `guard`
    that names its incumbent ("hand-set" or a weights file), and on top of an `anchor`
    (incumbent, gain). Tuned rivals come
    last. `track` is the safety filter's (`SafetyConfig`).

    Raises:
      InputError: no file, an unreadable one, path_speed weights, or an unknown
        baseline.
    """
    if not weights:
        raise InputError("--weights: none: expected at least one file")
    config = RankConfig(safety=SafetyConfig(track=track))
    rewards = [open_reward(path) for path in weights]
    rows = _learned_rows(rewards, names, config)
    first = rewards[0]
    preset, params = str(first.preset), reward_params(first)
    if dp:
        slow = max(plan_every, DP_EVERY)
        of = (params, preset, first.activation, config, DpConfig(), slow)
        rows.insert(1, dp_row(f"{rows[0].name} DP", *of))
    if guard:
        rows.insert(1, _guarded(rows[0].name, first, guard, config))
    if anchor:
        rows.insert(1, anchored_row(f"{rows[0].name} anchored", first, *anchor, config))
    rows += [baseline_row(name, preset, params[1], config) for name in baselines]
    if hand_set is not None:
        rows.append(tuned_row(hand_set, config))
    if tuned_idm is not None:
        rows.append(Row(name=TUNED_IDM_ROW, policy=idm_policy(tuned_idm)))
    return rows


def _learned_rows(
    rewards: Sequence[Reward], names: Sequence[str], config: RankConfig
) -> list[Row]:
    """One row a file, under distinct names."""
    rows: list[Row] = []
    for number, reward in enumerate(rewards):
        mode = str(reward.provenance.get("mode", "speed"))
        if mode != "speed":
            raise InputError(
                f"{reward.file}: mode: {mode}: the closed loop plans speed"
            )
        seed = int(reward.provenance.get("seed") or 0)
        name = names[number] if names else row_name(reward)
        taken = {row.name for row in rows}
        if name in taken:
            name = f"{name} (seed {seed})"
        if name in taken:
            name = f"{row_name(reward)} ({reward.file})"
        if name in taken:
            raise InputError(
                f"--weights: {reward.file}: met twice: expected distinct files"
            )
        made = reward_params(reward), str(reward.preset), reward.activation
        rows.append(learned_row(name, *made, config, seed))
    return rows
