"""Fitting the familiarity: recorded scenes against scenes of the catalogue.

Minimises the weighted binary cross entropy of `reward.familiarity`; the catalogue
weighs ELSEWHERE times as much as all recordings together, so that doubt leaves the
choice to the own cost, and every recorded source weighs as its share says:

    loss = mean_i w_i BCE(familiarity(x_i), y_i) + DECAY |weights|^2,   y = 1 recorded

with Adam over all scenes at once from a fixed seed: the same scenes give the same
familiarity. What never varies gets no weight.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax

from rcirl_jax.features import FeatureMap
from rcirl_jax.planner.prediction import as_seen
from rcirl_jax.reward.familiarity import Familiarity, familiarity_logit
from rcirl_jax.sampling import trajectory_on_path
from rcirl_jax.types import Candidates, Scene
from rcirl_jax.units import TIMES_S

UNITS = 16  # H
STEPS = 1500
STEP_SIZE = 1e-2
DECAY = 1e-3
ELSEWHERE = 3.0  # weight of the catalogue, where the recordings have 1
STILL = 1e-3  # scale below which a feature does not vary
LANES = 64  # scenes whose features are made together


def scene_features(scenes: Scene, features: FeatureMap) -> np.ndarray:
    """[n, F] raw features of n scenes at t = 0, as the planner sees them."""
    return np.asarray(_scene_features(scenes, features))


@functools.partial(jax.jit, static_argnames="features")
def _scene_features(scenes: Scene, features: FeatureMap) -> jax.Array:
    def one(scene: Scene) -> jax.Array:
        scene = as_seen(scene)
        straight = trajectory_on_path(scene, scene.ego.v * jnp.asarray(TIMES_S))
        only = Candidates(
            trajectory=jax.tree.map(lambda x: x[None], straight),
            feasible=jnp.ones(1, bool),
            family=jnp.zeros(1, jnp.int32),
        )
        return jnp.stack([row[0, 0] for row in features.rows(scene, only)])

    return jax.lax.map(one, scenes, batch_size=LANES)


def fit_familiarity(
    recorded: np.ndarray, weights: np.ndarray, elsewhere: np.ndarray, counts: np.ndarray
) -> Familiarity:
    """The familiarity of recorded scenes.

    Args:
      recorded: [n, F] of `scene_features`.
      weights: [n] > 0, of the recorded scenes.
      elsewhere: [m, F], of the catalogue's.
      counts: [F] bool, of `of_the_scene`.
    """
    both = np.concatenate([recorded, elsewhere]).astype(np.float64)
    location, spread = both.mean(axis=0), both.std(axis=0)
    varies = counts & (spread > STILL)
    scale = np.where(varies, spread, 1.0)
    shares = np.concatenate(
        [
            weights / weights.sum(),
            np.full(len(elsewhere), ELSEWHERE / len(elsewhere)),
        ]
    )
    mask = jnp.asarray(varies, jnp.float32)[:, None]
    first, last = jax.random.split(jax.random.key(0))
    size = recorded.shape[1]
    start = Familiarity(
        location=jnp.asarray(location, jnp.float32),
        scale=jnp.asarray(scale, jnp.float32),
        kernel=mask * jax.random.normal(first, (size, UNITS)) * size**-0.5,
        bias=jnp.zeros(UNITS),
        out=jax.random.normal(last, (UNITS,)) * UNITS**-0.5,
        offset=jnp.zeros(()),
    )
    labels = np.arange(len(both)) < len(recorded)
    return _fit(
        start,
        mask,
        jnp.asarray(both, jnp.float32),
        jnp.asarray(labels, jnp.float32),
        jnp.asarray(shares / (1.0 + ELSEWHERE), jnp.float32),
    )


@jax.jit
def _fit(
    start: Familiarity, mask: jax.Array, x: jax.Array, y: jax.Array, share: jax.Array
) -> Familiarity:
    optimizer = optax.adam(STEP_SIZE)
    free = {name: getattr(start, name) for name in ("kernel", "bias", "out", "offset")}

    def loss(free: dict[str, jax.Array]) -> jax.Array:
        logits = familiarity_logit(start.replace(**free), x)
        fit = jnp.sum(share * optax.sigmoid_binary_cross_entropy(logits, y))
        return fit + DECAY * sum(jnp.sum(leaf**2) for leaf in free.values())

    def step(_: int, carry: tuple) -> tuple:
        free, state = carry
        updates, state = optimizer.update(jax.grad(loss)(free), state)
        return optax.apply_updates(free, updates), state

    free, _ = jax.lax.fori_loop(0, STEPS, step, (free, optimizer.init(free)))
    return start.replace(**free | {"kernel": mask * free["kernel"]})
