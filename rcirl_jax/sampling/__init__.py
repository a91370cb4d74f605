"""Candidate trajectories: one sampler, offline and online."""

from rcirl_jax.sampling.kinematics import trajectory_from_positions, trajectory_on_path
from rcirl_jax.sampling.sampler import (
    FAMILIES,
    SamplerConfig,
    hard_negatives,
    num_candidates,
    sample,
)

__all__ = [
    "FAMILIES",
    "SamplerConfig",
    "hard_negatives",
    "num_candidates",
    "sample",
    "trajectory_from_positions",
    "trajectory_on_path",
]
