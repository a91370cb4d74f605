"""The rows of a closed-loop table: a name, a policy, its weights, how it drives.

Every row drives the same cases behind the same safety filter (where it has
candidates at all), so that rows differ by what chooses and nothing else.
"""

import dataclasses

import jax

from rcirl_jax.errors import InputError
from rcirl_jax.features import feature_map
from rcirl_jax.planner.baselines import Idm
from rcirl_jax.planner.rank import (
    Params,
    Policy,
    RankConfig,
    constant_score,
    constant_speed_policy,
    hand_score,
    idm_policy,
    learned_score,
    rank_policy,
    speed_dp_score,
    velocity_score,
)
from rcirl_jax.planner.yielding import Yielding, yielding_policy
from rcirl_jax.reward import RewardConfig, effective_params, init_params
from rcirl_jax.reward.speed_dp import SPEED_DP_ROW
from rcirl_jax.types import Normaliser, RewardParams

RECORDED_HUMAN = "recorded human"
TRIVIAL_BASELINES = ("constant V", "+velocity")  # rewards that know nothing
BASELINES = (
    *("hand-set", SPEED_DP_ROW, "IDM", "IDM yielding"),
    *("constant speed", "random weights", *TRIVIAL_BASELINES),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One driver of a table."""

    name: str
    policy: Policy
    params: Params = None
    # the ego is the recorded human; only for cases with a replay
    follow_log: bool = False
    # steps between two plans, where a row needs its own (DP); None: the run's
    plan_every: int | None = None
    # the driver's reaction time, in steps, and its braking build-up, m/s^3
    command_delay: int = 0
    braking_jerk: float | None = None
    # seed of the training run, where rows of one name differ by it
    seed: int = 0


def learned_row(
    name: str,
    weights: tuple[RewardParams, Normaliser],
    preset: str,
    activation: str,
    config: RankConfig,
) -> Row:
    """A learned reward, ranking; weights are effective (pinned) parameters."""
    score = learned_score(feature_map(preset), activation)
    return Row(name=name, policy=rank_policy(score, config), params=weights)


def human_row() -> Row:
    """The recorded human; only for cases with a replay. Its policy never acts."""
    return Row(name=RECORDED_HUMAN, policy=constant_speed_policy, follow_log=True)


def baseline_row(
    name: str, preset: str, normaliser: Normaliser, config: RankConfig
) -> Row:
    """A baseline by its name in `BASELINES`.

    Args:
      name: which one.
      preset: feature preset of the random weights.
      normaliser: of the learned reward; random weights see the same inputs.
      config: of the ranking planner.
    """
    if name == "hand-set":
        return Row(name=name, policy=rank_policy(hand_score, config))
    if name == SPEED_DP_ROW:
        return Row(name=name, policy=rank_policy(speed_dp_score, config))
    if name in TRIVIAL_BASELINES:
        trivial = constant_score if name == "constant V" else velocity_score
        return Row(name=name, policy=rank_policy(trivial, config))
    if name == "IDM":
        return Row(name=name, policy=idm_policy(Idm()))
    if name == "IDM yielding":
        return Row(name=name, policy=yielding_policy(Yielding()))
    if name == "constant speed":
        return Row(name=name, policy=constant_speed_policy)
    if name == "random weights":
        shape = RewardConfig()
        count = feature_map(preset).num_features
        params = init_params(jax.random.key(0), count, shape)
        weights = (effective_params(params, shape), normaliser)
        return learned_row(name, weights, preset, shape.activation, config)
    raise InputError(f"baselines: {name}: expected some of {', '.join(BASELINES)}")
