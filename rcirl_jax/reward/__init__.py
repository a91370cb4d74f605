"""The learned reward: network, normaliser, losses, and the hand-set baselines."""

from rcirl_jax.reward.config import RewardConfig
from rcirl_jax.reward.constraints import pinned
from rcirl_jax.reward.fast import scenes_value
from rcirl_jax.reward.hand import (
    LONG_ROW,
    TUNABLE,
    TUNED_ROW,
    LatticeCost,
    lattice_cost,
    lattice_costs,
    lattice_terms,
    tuned,
    weighted_cost,
)
from rcirl_jax.reward.losses import (
    LOSSES,
    Compared,
    LossConfig,
    LossSums,
    loss_sums,
)
from rcirl_jax.reward.module import PointReward, ValueNetwork
from rcirl_jax.reward.network import (
    effective_network,
    init_reward,
    init_tree,
    value,
)
from rcirl_jax.reward.normaliser import fit_normaliser, normalise, seen_range
from rcirl_jax.reward.speed_dp import SPEED_DP_ROW, SpeedDpCost, speed_dp_cost
from rcirl_jax.types import Normaliser, Parameters, RewardParams

__all__ = [
    "LONG_ROW",
    "LOSSES",
    "SPEED_DP_ROW",
    "TUNABLE",
    "TUNED_ROW",
    "Compared",
    "LatticeCost",
    "LossConfig",
    "LossSums",
    "Normaliser",
    "Parameters",
    "PointReward",
    "RewardConfig",
    "RewardParams",
    "SpeedDpCost",
    "ValueNetwork",
    "effective_network",
    "fit_normaliser",
    "init_reward",
    "init_tree",
    "lattice_cost",
    "lattice_costs",
    "lattice_terms",
    "loss_sums",
    "normalise",
    "pinned",
    "scenes_value",
    "seen_range",
    "speed_dp_cost",
    "tuned",
    "value",
    "weighted_cost",
]
