"""What a planner answers to a scene."""

import flax.struct
import jax


class Plan(flax.struct.PyTreeNode, kw_only=True):
    """One plan: the command in force until the next one, and its evidence."""

    acceleration: jax.Array  # [] m/s^2, command
    s: jax.Array  # [T] m, planned stations in the scene's frame
    fallback: jax.Array  # [] bool: no candidate was admissible
    admissible: jax.Array  # [] int32, candidates that passed the safety filter
