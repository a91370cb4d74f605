"""The exported reward: one file of weights, its writer and its reader."""

from rcirl_jax.export.guard import Guard, GuardResult, Limits
from rcirl_jax.export.reader import (
    PriorCost,
    Reward,
    WeightsError,
    decode_weights,
    load_weights,
)
from rcirl_jax.export.weights import (
    PROVENANCE_KEYS,
    pack,
    save,
    to_json,
)

__all__ = [
    "PROVENANCE_KEYS",
    "Guard",
    "GuardResult",
    "Limits",
    "PriorCost",
    "Reward",
    "WeightsError",
    "decode_weights",
    "load_weights",
    "pack",
    "save",
    "to_json",
]
