"""The rows of a closed-loop table: a name, a policy, its weights, how it drives.

Every row drives the same cases behind the same safety filter (where it has
candidates at all), so that rows differ by what chooses and nothing else. What differs
is data: all that rank by one shape of network, and all driver models, are one program.

A case is preventable unless both careful drivers (`planner.baselines`) have an at-fault
collision. Olleja et al. (2024) show that either alone misjudges cut-ins; as a bracket
they serve.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.features import feature_map
from rcirl_jax.planner.baselines import (
    BRAKING_JERK,
    CAREFUL,
    REACTION_S,
    RULES,
    USUAL,
    Yielding,
    rule,
    rule_policy,
)
from rcirl_jax.planner.mobil import MOBIL_ROW, Mobil, mobil_policy
from rcirl_jax.planner.program import Program, ProgramPolicy
from rcirl_jax.planner.rank import (
    Params,
    Policy,
    RankConfig,
    ranking,
    ranking_policy,
)
from rcirl_jax.reward import (
    RewardConfig,
    effective_params,
    identity_normaliser,
    init_params,
)
from rcirl_jax.reward.speed_dp import SPEED_DP_ROW
from rcirl_jax.simulation.cases import STEP_S
from rcirl_jax.simulation.metrics import CaseMetrics
from rcirl_jax.types import Normaliser, RewardParams

RECORDED_HUMAN = "recorded human"
TRIVIAL_BASELINES = ("constant V", "+velocity")  # rewards that know nothing
BASELINES = (
    *("hand-set", SPEED_DP_ROW, "IDM", "IDM yielding"),
    *("constant speed", "random weights", *TRIVIAL_BASELINES),
)
KNOWN_BASELINES = (*BASELINES, MOBIL_ROW)  # the last one changes lanes


def baselines_of(mode: str) -> tuple[str, ...]:
    """Returns the baselines that stand beside planners of a mode of the sampler."""
    return KNOWN_BASELINES if mode == "path_speed" else BASELINES


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One driver of a table."""

    name: str
    policy: Policy
    params: Params = None
    # the ego is the recorded human; only for cases with a replay
    follow_log: bool = False
    # the driver's reaction time, in steps, and its braking build-up, m/s^3
    command_delay: int = 0
    braking_jerk: float | None = None
    # seed of the training run, where rows of one name differ by it
    seed: int = 0

    @property
    def steers(self) -> bool:
        """True if it plans paths too, not speed along the given one."""
        return getattr(self.policy, "steers", False)

    @property
    def program(self) -> Program | None:
        """The user's program that plans, where one does."""
        return getattr(self.policy, "program", None)


def learned_row(
    name: str,
    weights: tuple[RewardParams, Normaliser],
    preset: str,
    activation: str,
    config: RankConfig,
) -> Row:
    """A learned reward, ranking; weights are effective (pinned) parameters."""
    policy = ranking_policy(feature_map(preset), activation, config)
    return Row(name=name, policy=policy, params=ranking(weights))


def rule_row(
    name: str,
    of: str,
    driver: Yielding = USUAL,
    **how: Any,  # noqa: ANN401
) -> Row:
    """A driver model of `RULES`, with its constants; `how` are fields of `Row`."""
    return Row(name=name, policy=rule_policy, params=rule(of, driver), **how)


def mobil_row() -> Row:
    """The driver that changes lanes by MOBIL."""
    numbers = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), Mobil())
    return Row(name=MOBIL_ROW, policy=mobil_policy, params=numbers)


def program_row(one: Program, name: str = "") -> Row:
    """A planner that is a program, under its own name or another."""
    return Row(name=name or one.name, policy=ProgramPolicy(one))


def human_row() -> Row:
    """The recorded human; only for cases with a replay. Its policy never acts."""
    return rule_row(RECORDED_HUMAN, "constant speed", follow_log=True)


def drawn_weights(
    preset: str, shape: RewardConfig | None = None
) -> tuple[RewardParams, Normaliser]:
    """Effective parameters of a reward that knows nothing, and features as they are.

    Args:
      preset: of the features.
      shape: of the network; None: the usual one.
    """
    shape, count = shape or RewardConfig(), feature_map(preset).num_features
    drawn = effective_params(init_params(jax.random.key(0), count, shape), shape)
    return drawn, identity_normaliser(count)


def baseline_row(
    name: str,
    preset: str,
    weights: tuple[RewardParams, Normaliser],
    config: RankConfig,
    activation: str = RewardConfig().activation,
) -> Row:
    """A baseline by its name in `KNOWN_BASELINES`.

    Args:
      name: which one; or that of the user's own cost, `config.own`.
      preset: feature preset of the random weights.
      weights: of the learned reward, in whose program a baseline is ranked; random
        weights see its normalised inputs.
      config: of the ranking planner.
      activation: of the learned reward.
    """
    known = [*KNOWN_BASELINES, *([config.own.name] if config.own else [])]
    if name not in known:
        raise InputError(f"baselines: {name}: expected some of {', '.join(known)}")
    if name in RULES:
        return rule_row(name, name)
    if name == MOBIL_ROW:
        return mobil_row()
    if name == "random weights":
        drawn, _ = drawn_weights(preset)
        usual = RewardConfig().activation
        return learned_row(name, (drawn, weights[1]), preset, usual, config)
    row = learned_row(name, weights, preset, activation, config)
    return dataclasses.replace(row, params=ranking(weights, name, 0.0))


def judges() -> tuple[Row, Row, Row, Row]:
    """The rows that classify cases: CC, FSM, IDM and constant speed."""
    late = round(REACTION_S / STEP_S)
    careful = {"driver": CAREFUL, "braking_jerk": BRAKING_JERK}
    return (
        rule_row("CC", "CC", command_delay=late, **careful),
        # its reaction time is inside its distances
        rule_row("FSM", "FSM", **careful),
        rule_row("IDM", "IDM"),
        rule_row("constant speed", "constant speed"),
    )


def firsts_first(rows: Sequence[Row]) -> list[Row]:
    """The rows, those ahead that compile: of two at a time each then has a program."""
    first = {row.policy: row for row in reversed(rows)}
    return sorted(rows, key=lambda row: first[row.policy] is not row)


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
