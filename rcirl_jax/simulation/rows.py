"""The rows of a closed-loop table: a name, a policy, its weights, how it drives.

Every row drives the same cases behind the same safety filter (where it has
candidates at all), so that rows differ by what chooses and nothing else.

Two drivers say who could have avoided a collision.

CC, the competent and careful human driver of UN R157: perceives a risk when a
body is in its path, or enters it, with a time to collision of at most 2 s;
0.75 s later it brakes, building up 12.65 m/s^3 to 0.774 g. FSM, the fuzzy
safety model of the JRC: brakes by how far the gap lies between a safe and an
unsafe distance, before the conflict (PFS) and in it (CFS). Both otherwise
drive like `yielding_policy` with wide margins.

A case is preventable unless both have an at-fault collision. Olleja
et al. (2024) show that either alone misjudges cut-ins; as a bracket they serve.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.features import feature_map
from rcirl_jax.planner.baselines import (
    Idm,
    Yielding,
    acceleration,
    bodies_in_path,
    yielding_policy,
)
from rcirl_jax.planner.plan import Plan, held
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
from rcirl_jax.reward import RewardConfig, effective_params, init_params
from rcirl_jax.reward.speed_dp import SPEED_DP_ROW
from rcirl_jax.simulation.metrics import CaseMetrics
from rcirl_jax.types import Normaliser, RewardParams, Scene

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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Careful:
    """Constants of both models (UN R157 annex 3, JRC FSM)."""

    # the driving between risks: wide margins, early yielding
    driver: Yielding = dataclasses.field(
        default_factory=lambda: Yielding(
            idm=Idm(headway=1.8, acceleration=1.2, braking=1.6, standstill_gap=3.0),
            limit_share=0.92,
            time_gap=1.8,
            distance_gap=3.0,
            margin=0.5,
            entering=4.0,
        )
    )
    risk_ttc: float = 2.0  # s
    reaction: float = 0.75  # s
    braking: float = 7.59  # m/s^2, 0.774 g
    braking_jerk: float = 12.65  # m/s^3
    b_min: float = 4.0  # m/s^2, FSM: comfortable
    b_max: float = 6.0  # m/s^2, FSM: hard
    b_leader: float = 7.0  # m/s^2, FSM: assumed of the leader
    standing_gap: float = 2.0  # m, FSM


def cc_braking(
    gap: jax.Array, v: jax.Array, v_lead: jax.Array, config: Careful
) -> jax.Array:
    """Braking m/s^2 >= 0 of the CC driver: full at a risk, otherwise 0."""
    closing = jnp.maximum(v - v_lead, 1e-3)
    return jnp.where(gap / closing <= config.risk_ttc, config.braking, 0.0)


def fsm_braking(
    gap: jax.Array, v: jax.Array, a: jax.Array, v_lead: jax.Array, config: Careful
) -> jax.Array:
    """Braking m/s^2 >= 0 of the fuzzy safety model.

    PFS: d_safe = v tau + v^2 / 2 b_min - v_l^2 / 2 b_l + 2, d_unsafe with b_max
         PFS = clip((d - 2 - d_safe) / (d_unsafe - d_safe), 0, 1)
    CFS: d_safe = (v + a tau / 2 - v_l) tau + (v + a tau - v_l)^2 / 2 b_min
    brake = CFS (b_max - b_min) + b_min where CFS > 0, else PFS b_min
    """
    tau, distance = config.reaction, gap
    lead = v_lead**2 / (2.0 * config.b_leader)

    def proactive(b: float) -> jax.Array:
        return v * tau + v**2 / (2.0 * b) - lead + config.standing_gap

    def critical(b: float) -> jax.Array:
        slow = jnp.maximum(a, -config.b_min)
        later = jnp.maximum(v + slow * tau, 0.0)
        way = (v + 0.5 * slow * tau - v_lead) * tau
        return way + jnp.maximum(later - v_lead, 0.0) ** 2 / (2.0 * b)

    def share(d: jax.Array, safe: jax.Array, unsafe: jax.Array) -> jax.Array:
        width = jnp.minimum(unsafe - safe, -1e-3)
        return jnp.clip((d - safe) / width, 0.0, 1.0)

    pfs = share(
        distance - config.standing_gap, proactive(config.b_min), proactive(config.b_max)
    )
    cfs = share(distance, critical(config.b_min), critical(config.b_max))
    cfs = jnp.where(v > v_lead, cfs, 0.0)
    hard = cfs * (config.b_max - config.b_min) + config.b_min
    return jnp.where(cfs > 0.0, hard, pfs * config.b_min)


@functools.lru_cache(maxsize=8)
def cc_policy(config: Careful) -> Callable[..., Plan]:
    """The CC driver; its reaction time is the rollout's `command_delay`."""

    def policy(
        params: None, scene: Scene, key: jax.Array, before: Plan | None = None
    ) -> Plan:
        del params, key, before
        gap, lead = bodies_in_path(scene, config.driver)
        brake = jnp.max(
            jax.vmap(cc_braking, (0, None, 0, None))(gap, scene.ego.v, lead, config)
        )
        a = acceleration(scene, config.driver)
        return held(scene.ego.v, jnp.minimum(a, jnp.where(brake > 0.0, -brake, a)))

    return policy


@functools.lru_cache(maxsize=8)
def fsm_policy(config: Careful) -> Callable[..., Plan]:
    """The FSM driver; its reaction time is inside its distances."""

    def policy(
        params: None, scene: Scene, key: jax.Array, before: Plan | None = None
    ) -> Plan:
        del params, key, before
        gap, lead = bodies_in_path(scene, config.driver)
        brake = jnp.max(
            jax.vmap(fsm_braking, (0, None, None, 0, None))(
                gap, scene.ego.v, scene.ego.a, lead, config
            )
        )
        a = acceleration(scene, config.driver)
        return held(scene.ego.v, jnp.minimum(a, jnp.where(brake > 0.0, -brake, a)))

    return policy


def judges(config: Careful = Careful()) -> tuple[Row, Row, Row, Row]:
    """The rows that classify: CC, FSM, IDM and nobody."""
    return (
        Row(
            name="CC",
            policy=cc_policy(config),
            command_delay=round(config.reaction / 0.1),
            braking_jerk=config.braking_jerk,
        ),
        Row(name="FSM", policy=fsm_policy(config), braking_jerk=config.braking_jerk),
        Row(name="IDM", policy=idm_policy(Idm())),
        Row(name="constant speed", policy=constant_speed_policy),
    )


def preventable(careful: Sequence[CaseMetrics]) -> np.ndarray:
    """[C] bool: at least one careful driver has no at-fault collision."""
    crashed = [np.asarray(metrics.at_fault) > 0 for metrics in careful]
    return ~np.logical_and.reduce(crashed)


def trivial(idle: Sequence[CaseMetrics], min_ttc: float = 1.5) -> np.ndarray:
    """[C] bool: neither IDM nor constant speed ever came near anything."""
    calm = [
        (np.asarray(m.collisions) == 0) & (np.asarray(m.min_ttc) > min_ttc)
        for m in idle
    ]
    return np.logical_and.reduce(calm)
