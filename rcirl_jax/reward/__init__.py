"""The learned reward: network, normaliser, losses, and the hand-set rivals."""

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
from rcirl_jax.reward.network import (
    RewardConfig,
    init_reward,
    pinned,
    scenes_value,
    value,
)
from rcirl_jax.reward.normaliser import fit_normaliser, normalise, seen_range
from rcirl_jax.reward.speed_dp import SPEED_DP_ROW, SpeedDpCost, speed_dp_cost
from rcirl_jax.types import Normaliser, RewardParams

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
    "RewardConfig",
    "RewardParams",
    "SpeedDpCost",
    "fit_normaliser",
    "init_reward",
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
