"""Planned drives with known decisions: `draw(name, rng)` for a name of `FAMILIES`."""

from rcirl_jax.evaluation.labels.cases import beside, lines, traffic
from rcirl_jax.evaluation.labels.cases.noise import (
    NOISES,
    check_noise,
    position_errors,
)
from rcirl_jax.evaluation.labels.cases.plans import FAMILIES, draw
from rcirl_jax.evaluation.labels.cases.scenes import (
    HISTORY_S,
    RATE_HZ,
    Case,
    Mover,
    at,
    clear,
    speed_tags,
    tags_of_decisions,
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
    "check_noise",
    "clear",
    "draw",
    "lines",
    "position_errors",
    "speed_tags",
    "tags_of_decisions",
    "to_recording",
    "traffic",
]
