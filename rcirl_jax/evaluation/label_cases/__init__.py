"""Planned drives with known decisions: `draw(name, rng)` for a name of `FAMILIES`."""

from rcirl_jax.evaluation.label_cases import beside, lines, traffic
from rcirl_jax.evaluation.label_cases.plans import FAMILIES, draw
from rcirl_jax.evaluation.label_cases.scenes import (
    HISTORY_S,
    NOISES,
    RATE_HZ,
    Case,
    Mover,
    at,
    clear,
    position_errors,
    to_recording,
)

__all__ = [
    "FAMILIES",
    "HISTORY_S",
    "NOISES",
    "RATE_HZ",
    "Case",
    "Mover",
    "at",
    "beside",
    "clear",
    "draw",
    "lines",
    "position_errors",
    "to_recording",
    "traffic",
]
