"""Background shifting: what pooling scenes does to a learned reward.

The paper says why human and samples must be compared within a scene (section
II, "Background shifting problem"): scenes differ in features that no candidate
of the scene can change, and a learner that pools scenes learns those too. This is
the paper's figure, computed with the package's own losses and a linear reward
V = w f: two frames that differ by a constant, one direction that is right in both,
and the directions that pooling and conditioning find.

For a linear reward the conditional losses see V(sample) - V(human) only, so the
background drops out by algebra: that they find the same is no discovery. How far
pooling is led astray is. Features are numbers without a unit: within a frame the
candidates have a spread of about 1 per feature.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from rcirl_jax.evaluation.exact import clopper_pearson
from rcirl_jax.evaluation.statistics import combine_seeds
from rcirl_jax.reward import Compared, LossConfig, loss_sums

ANGLES = 3600  # directions tried for the widest margin, 0.1 degree apart
DRAWS_AT_ONCE = 20  # keeps the table of margins small


@dataclasses.dataclass(frozen=True, kw_only=True)
class Learning:
    """How a linear reward is fitted; hashable."""

    steps: int = 400  # of Adam on all frames, the step size falling to 0 (cosine)
    rate: float = 0.1  # first step size
    # weight of |w|^2 / 2 for the losses whose scale is free: with separable
    # frames they have no minimum without it
    ridge: float = 0.01
    leaky_rate: float = 0.05  # a of the rank loss, as in the paper


class Frames(NamedTuple):
    """Features of N frames."""

    human: jax.Array  # [N, F]
    candidates: jax.Array  # [N, K, F]


class Learned(NamedTuple):
    """A fitted linear reward."""

    direction: jax.Array  # [F], unit norm
    threshold: jax.Array  # [], of the discriminator: V = threshold divides
    gradient: jax.Array  # [], norm at the last step: how far from a minimum


def _compared(weights: jax.Array, offset: jax.Array, frames: Frames) -> Compared:
    """Values V = w f of all frames; the losses used here read nothing else."""
    table = jnp.zeros(frames.candidates.shape[:2])
    return Compared(
        human=frames.human @ weights,
        candidates=frames.candidates @ weights,
        counts=table == 0.0,
        weight=table[:, 0] + 1.0,
        human_distance=table[:, 0],
        human_collides=table[:, 0] > 0.0,
        distance=table,
        collides=table > 0.0,
        breaks_rule=table,
        human_density=table[:, 0],
        density=table,
        offset=offset,
    )


def learn(loss: str, frames: Frames, start: jax.Array, config: Learning) -> Learned:
    """Fit V = w f to frames with one of the package's losses.

        minimise  loss(w, b) / terms + ridge |w|^2 / 2

    The rank loss has no scale of its own: there w is divided by its norm first,
    as `reward.pinned` does, and the ridge is left out.

    Args:
      loss: key of `reward.LOSSES` that reads values only; "gan" pools, "rank"
        and "logistic" compare within a frame.
      frames: N frames.
      start: [F], not zero.
      config: optimiser.

    Returns:
      Direction, threshold and the last gradient's norm.
    """
    unit = loss == "rank"
    # a common shift changes nothing but the offset, and Adam's patience with it
    centre = jnp.mean(jnp.mean(frames.candidates, axis=1), axis=0)
    moved = Frames(frames.human - centre, frames.candidates - centre)
    constants = LossConfig(leaky_rate=config.leaky_rate)

    def total(params: tuple[jax.Array, jax.Array]) -> jax.Array:
        weights, offset = params
        used = weights / jnp.linalg.norm(weights) if unit else weights
        sums = loss_sums(loss, _compared(used, offset, moved), constants)
        pull = 0.0 if unit else 0.5 * config.ridge * jnp.sum(weights**2)
        return sums.loss / sums.terms + pull

    schedule = optax.cosine_decay_schedule(config.rate, config.steps)
    optimizer = optax.adam(schedule)

    def step(carry: tuple, _: None) -> tuple:
        params, state = carry
        grads = jax.grad(total)(params)
        updates, state = optimizer.update(grads, state)
        return (optax.apply_updates(params, updates), state), optax.tree.norm(grads)

    first = (start, jnp.zeros(()))
    last, norms = jax.lax.scan(
        step, (first, optimizer.init(first)), None, length=config.steps
    )
    weights, offset = last[0]
    scale = jnp.linalg.norm(weights)
    direction = weights / scale
    return Learned(direction, direction @ centre - offset / scale, norms[-1])


def angle_deg(a: jax.Array, b: jax.Array) -> jax.Array:
    """Angle between directions of unit norm [..., F], in degrees."""
    cosine = jnp.clip(jnp.sum(a * b, axis=-1), -1.0, 1.0)
    return jnp.degrees(jnp.arccos(cosine))


# ---------------------------------------------------------------- two frames


@dataclasses.dataclass(frozen=True, kw_only=True)
class TwoFrames:
    """The paper's example; hashable."""

    samples: int = 100  # per frame, from a two-dimensional Cauchy distribution
    scale: float = 0.6  # of the distribution
    # where the tail is cut off: all samples stay below the human along the truth
    reach: float = 2.5
    lead: float = 3.0  # how far the human lies from the samples' centre
    shift: float = 4.0  # from the first frame to the second
    shift_angle_deg: float = 45.0  # from the truth, clockwise
    learning: Learning = Learning(steps=1000)


TRUTH = (0.0, 1.0)  # the direction that is right in both frames
DIRECTIONS = {  # name -> loss; None: the widest margin of one frame alone
    "one frame": None,
    "pooled": "gan",
    "conditional, logistic": "logistic",
    "conditional, rank": "rank",
}


def two_frames(key: jax.Array, config: TwoFrames) -> Frames:
    """One draw: samples and human, and the same once more, shifted by a constant.

    A radius of the two-dimensional Cauchy distribution is drawn by inverting

        P(r < R) = 1 - 1 / sqrt(1 + (R / scale)^2)

    up to `reach`. Source: the caption of the paper's figure.
    """
    radius_key, angle_key = jax.random.split(key)
    most = 1.0 - 1.0 / np.sqrt(1.0 + (config.reach / config.scale) ** 2)
    share = jax.random.uniform(radius_key, (config.samples,), maxval=most)
    radius = config.scale * jnp.sqrt((1.0 - share) ** -2 - 1.0)
    turn = jax.random.uniform(angle_key, (config.samples,), maxval=2.0 * np.pi)
    around = radius[:, None] * jnp.stack([jnp.cos(turn), jnp.sin(turn)], axis=-1)
    aside = np.radians(config.shift_angle_deg)
    moved = config.shift * np.array([np.sin(aside), np.cos(aside)])
    moves = jnp.asarray(np.stack([np.zeros(2), moved]), jnp.float32)
    return Frames(
        human=config.lead * jnp.asarray(TRUTH) + moves,
        candidates=around + moves[:, None],
    )


def widest_margin(human: jax.Array, candidates: jax.Array) -> jax.Array:
    """Max-margin direction of one frame [2]: argmax_u min_k u (human - f_k).

    Every angle is tried. Source: Ratliff et al. (ICML 2006), one frame, no slack.
    """
    turn = jnp.arange(ANGLES) * (2.0 * np.pi / ANGLES)
    tried = jnp.stack([jnp.cos(turn), jnp.sin(turn)], axis=-1)  # [A, 2]
    margin = jnp.min((human - candidates) @ tried.T, axis=0)
    return tried[jnp.argmax(margin)]


def find_directions(
    key: jax.Array, config: TwoFrames
) -> tuple[Frames, dict[str, Learned]]:
    """One draw of the two frames and the directions found in it (`DIRECTIONS`)."""
    draw_key, start_key = jax.random.split(key)
    frames = two_frames(draw_key, config)
    start = jax.random.normal(start_key, (2,))
    alone = widest_margin(frames.human[0], frames.candidates[0])
    zero = jnp.zeros(())
    found = {"one frame": Learned(alone, zero, zero)}
    for name, loss in DIRECTIONS.items():
        if loss is not None:
            found[name] = learn(loss, frames, start, config.learning)
    return frames, found


@functools.partial(jax.jit, static_argnames=("draws", "config"))
def draw_examples(
    seed: int, draws: int, config: TwoFrames
) -> tuple[Frames, dict[str, Learned]]:
    """`find_directions` for D draws, leaves [D, ...]."""
    keys = jax.random.split(jax.random.key(seed), draws)
    find = lambda key: find_directions(key, config)  # noqa: E731
    return jax.lax.map(find, keys, batch_size=DRAWS_AT_ONCE)


def example_numbers(found: dict[str, Learned]) -> dict[str, Any]:
    """Angles of D draws with intervals, ready for JSON.

    Per direction: the mean angle to the truth in degrees with its 95 % bootstrap
    interval over draws, where 95 % of the draws lie, and the mean angle to the
    first frame's own optimum. `conditional_nearer`: share of draws in which a
    conditional direction is nearer to the truth than the pooled one, with the
    exact interval of a rate.
    """
    truth = jnp.asarray(TRUTH)
    angles = {n: np.asarray(angle_deg(x.direction, truth)) for n, x in found.items()}
    alone = found["one frame"].direction
    numbers: dict[str, Any] = {"angle_to_truth_deg": {}, "conditional_nearer": {}}
    for name in DIRECTIONS:
        values = angles[name]
        apart = np.asarray(angle_deg(found[name].direction, alone))
        low, high = np.quantile(values, [0.025, 0.975])
        numbers["angle_to_truth_deg"][name] = {
            **interval(values),
            "draws_from": float(low),
            "draws_to": float(high),
            "to_one_frame_deg": float(apart.mean()),
            "last_gradient": float(jnp.max(found[name].gradient)),
        }
    for name in angles:
        if name.startswith("conditional"):
            nearer = int(np.sum(angles[name] < angles["pooled"]))
            low, high = clopper_pearson(nearer, angles[name].size)
            share = nearer / angles[name].size
            line = {"share": share, "low": low, "high": high}
            numbers["conditional_nearer"][name] = line
    return numbers


def interval(values: np.ndarray) -> dict[str, float]:
    """Mean of [n] draws or seeds with its 95 % bootstrap interval."""
    found = combine_seeds(values, np.arange(values.size))
    return {"mean": found.value, "low": found.low, "high": found.high}
