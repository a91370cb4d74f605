"""The learned reward: network, normaliser, losses, and the hand-set rival."""

from rcirl_jax.reward.hand import LatticeCost, lattice_cost
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
    value,
)
from rcirl_jax.reward.normaliser import fit_normaliser, normalise
from rcirl_jax.types import Normaliser, RewardParams

__all__ = [
    "LOSSES",
    "Compared",
    "LatticeCost",
    "LossConfig",
    "LossSums",
    "Normaliser",
    "RewardConfig",
    "RewardParams",
    "fit_normaliser",
    "init_reward",
    "lattice_cost",
    "loss_sums",
    "normalise",
    "pinned",
    "value",
]
