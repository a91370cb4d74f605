"""Short drives of hand-made cases; one compiled program per policy."""

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.planner.plan import held
from rcirl_jax.simulation.rollout import RolloutConfig, drive_cases


def constant(params, scene, key, before=None):
    """The ego's acceleration is the parameter."""
    return held(scene.ego.v, params + 0.0 * scene.ego.v)


def stack(cases):
    return jax.tree.map(lambda *x: np.stack(x), *cases)


def drive(cases, steps=300, policy=constant, params=0.0, **config):
    """(record, snapshot), numpy leaves [B, S, ...]; up to 4 cases have one shape."""
    config = RolloutConfig(steps=steps, **config)
    params = jnp.asarray(params) if isinstance(params, float) else params
    filled = [*cases, *[cases[-1]] * (-len(cases) % 4)]
    record, shot, _ = drive_cases(policy, params, stack(filled), config)
    return jax.tree.map(lambda x: np.asarray(x)[: len(cases)], (record, shot))
