"""The learned reward: Flax module, normaliser, losses, hand-set costs."""

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
    LossConfig,
    LossInputs,
    LossSums,
    loss_sums,
)
from rcirl_jax.reward.network import (
    RewardConfig,
    RewardModel,
    effective_model,
    effective_params,
    init_params,
    value,
)
from rcirl_jax.reward.normaliser import (
    fit_normaliser,
    identity_normaliser,
    normalise,
    seen_range,
)
from rcirl_jax.reward.speed_dp import SPEED_DP_ROW, SpeedDpCost, speed_dp_cost
from rcirl_jax.types import CandidateInfo, Normaliser, RewardParams

__all__ = [
    "LONG_ROW",
    "LOSSES",
    "SPEED_DP_ROW",
    "TUNABLE",
    "TUNED_ROW",
    "CandidateInfo",
    "LatticeCost",
    "LossConfig",
    "LossInputs",
    "LossSums",
    "Normaliser",
    "RewardConfig",
    "RewardModel",
    "RewardParams",
    "SpeedDpCost",
    "effective_model",
    "effective_params",
    "fit_normaliser",
    "identity_normaliser",
    "init_params",
    "lattice_cost",
    "lattice_costs",
    "lattice_terms",
    "loss_sums",
    "normalise",
    "seen_range",
    "speed_dp_cost",
    "tuned",
    "value",
    "weighted_cost",
]
