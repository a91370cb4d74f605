"""A choice problem with a hidden reward, before a background of any size.

What `background` says of losses that pool scenes, measured: how often a learned
reward chooses as the hidden one does while the scenes drift apart.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.insight.background import (
    Frames,
    Learning,
    angle_deg,
    interval,
    learn,
    pooled_moments,
)
from rcirl_jax.evaluation.statistics import paired_difference

TEST_FRAMES = 1000  # fresh frames per seed


@dataclasses.dataclass(frozen=True, kw_only=True)
class World:
    """A choice problem with a hidden linear reward; hashable.

    Frame n has K candidates f = b_n + e^(tau g_n) z, z ~ N(0, I), and a person
    who takes candidate k with a probability proportional to e^(beta w* f_k).
    g_n ~ N(0, 1) makes the choice easy: values that lie far apart. A background
    "along" lies on one fixed direction u at a given angle to w* and goes with g,

        b_n = sigma_b (rho g_n + sqrt(1 - rho^2) h_n) u,      h_n ~ N(0, 1),

    as speed and easy choices both belong to an empty road. One "around" has the
    same size, all directions alike, and goes with nothing:
    b_n ~ N(0, sigma_b^2 I / F). The first biases a learner that pools, even with
    rho = 0; the second only adds noise.
    """

    frames: int = 512  # made per seed; training takes the first N of them
    features: int = 8  # F
    candidates: int = 16  # K
    beta: float = 3.0  # how sure the person is, per unit of value
    tau: float = 0.5  # how much the ease of the choice differs
    rho: float = 0.8  # correlation of background and ease
    background_angle_deg: float = 45.0  # from u to w*
    learning: Learning = dataclasses.field(default_factory=Learning)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One learner in one world: a line of the chart."""

    loss: str
    along: bool = True  # background on one direction; False: around
    correlated: bool = True  # False: rho = 0
    # features divided by their spread over all frames, as training does, so the
    # rank loss's unit norm is one in those units; False: by the spread within
    pooled_scale: bool = False


ROWS = {
    "GAN": Row(loss="gan"),
    "GAN, uncorrelated": Row(loss="gan", correlated=False),
    "GAN, all directions": Row(loss="gan", along=False),
    "RC-IRL logistic": Row(loss="logistic"),
    "RC-IRL rank": Row(loss="rank"),
    "RC-IRL rank, pooled scale": Row(loss="rank", pooled_scale=True),
}


class Hidden(NamedTuple):
    """What is the same in all frames of one seed; both [F], unit norm."""

    reward: jax.Array  # w*
    background: jax.Array  # u


def hidden_world(key: jax.Array, world: World) -> Hidden:
    """A random w*, and a random u at the given angle to it."""
    reward_key, aside_key = jax.random.split(key)
    reward = jax.random.normal(reward_key, (world.features,))
    reward = reward / jnp.linalg.norm(reward)
    aside = jax.random.normal(aside_key, (world.features,))
    aside = aside - reward * (reward @ aside)
    aside = aside / jnp.linalg.norm(aside)
    turn = np.radians(world.background_angle_deg)
    return Hidden(reward, np.cos(turn) * reward + np.sin(turn) * aside)


def simulate(
    key: jax.Array,
    hidden: Hidden,
    count: int,
    world: World,
    sigma_b: jax.Array,
    row: tuple[jax.Array, jax.Array],
) -> tuple[Frames, jax.Array]:
    """Frames of one seed, with their background.

    Args:
      key: consumed.
      hidden: of this seed.
      count: N.
      world: the choice problem.
      sigma_b: [] size of the background; nothing else depends on it.
      row: [] bool each, background along u (else around), and correlated.

    Returns:
      Frames, and [N] the number of the candidate with the highest w* f.
    """
    keys = jax.random.split(key, 5)
    ease = jax.random.normal(keys[0], (count,))
    shape = (count, world.candidates, world.features)
    own = jnp.exp(world.tau * ease)[:, None, None] * jax.random.normal(keys[1], shape)
    values = own @ hidden.reward
    doubt = jax.random.gumbel(keys[2], values.shape)
    chosen = jnp.argmax(world.beta * values + doubt, axis=1)
    other = jax.random.normal(keys[3], (count,))
    along, correlated = row
    rho = jnp.where(correlated, world.rho, 0.0)
    size = rho * ease + jnp.sqrt(1.0 - rho**2) * other
    around = jax.random.normal(keys[4], (count, world.features))
    background = sigma_b * jnp.where(
        along, size[:, None] * hidden.background, around / np.sqrt(world.features)
    )
    candidates = own + background[:, None]
    human = jnp.take_along_axis(candidates, chosen[:, None, None], axis=1)[:, 0]
    counts = jnp.arange(world.candidates) != chosen[:, None]
    frames = Frames(human, candidates, counts, jnp.ones(count))
    return frames, jnp.argmax(values, axis=1)


@functools.partial(jax.jit, static_argnames="world")
def _made(
    seeds: jax.Array,
    world: World,
    sigma_b: jax.Array,
    row: tuple[jax.Array, jax.Array],
) -> tuple[Hidden, Frames, jax.Array, jax.Array]:
    """Hidden world, frames to train on and then to test on, best, starts; [R, ...]."""

    def one(seed: jax.Array) -> tuple[Hidden, Frames, jax.Array, jax.Array]:
        keys = jax.random.split(jax.random.key(seed), 3)
        hidden = hidden_world(keys[0], world)
        count = world.frames + TEST_FRAMES
        frames, best = simulate(keys[1], hidden, count, world, sigma_b, row)
        return hidden, frames, best, jax.random.normal(keys[2], (world.features,))

    return jax.vmap(one)(seeds)


@functools.partial(jax.jit, static_argnames=("loss", "world"))
def _tested(
    made: tuple[Hidden, Frames, jax.Array, jax.Array],
    loss: str,
    world: World,
    count: jax.Array,
    pooled: jax.Array,
) -> dict[str, jax.Array]:
    """One learner, all seeds side by side; leaves [R].

    N is a weight and not a shape: one compile for the whole chart.
    """

    def one(hidden: Hidden, frames: Frames, best: jax.Array, start: jax.Array) -> dict:
        train = jax.tree.map(lambda x: x[: world.frames], frames)
        test = jax.tree.map(lambda x: x[world.frames :], frames)
        kept = jnp.arange(world.frames) < count
        train = train._replace(weight=kept.astype(jnp.float32))
        scale = jnp.where(pooled, pooled_moments(train)[1], 1.0)
        scaled = train._replace(
            human=train.human / scale, candidates=train.candidates / scale
        )
        found = learn(loss, scaled, start, world.learning)
        weights = found.direction / scale
        weights = weights / jnp.linalg.norm(weights)
        best = best[world.frames :]
        picked = jnp.argmax(test.candidates @ weights, axis=1)
        by_human = ~test.counts[jnp.arange(best.size), best]
        return {
            "agreement": jnp.mean(picked == best),
            "angle_deg": angle_deg(weights, hidden.reward),
            "human_agreement": jnp.mean(by_human),
            "last_gradient": found.gradient,
        }

    return jax.vmap(one)(*made)


def measure(
    row: Row, count: int, sigma_b: float, seeds: Sequence[int], world: World
) -> dict[str, np.ndarray]:
    """Train one learner on N frames per seed and test it on fresh frames.

    Args:
      row: the learner and its kind of background.
      count: N, training frames, at most `world.frames`.
      sigma_b: size of the background, in spreads within a frame.
      seeds: R; a seed fixes w*, u, frames and start, whatever sigma_b is.
      world: the choice problem.

    Returns:
      Arrays [R]: "agreement", share of fresh frames in which learned and hidden
      reward have the same best candidate; "angle_deg" between them;
      "human_agreement", the same share for the simulated person;
      "last_gradient", norm at the last step.
    """
    if not 1 <= count <= world.frames or sigma_b < 0.0:
        raise InputError(
            f"background: frames, size: {count}, {sigma_b}:"
            f" expected 1 to {world.frames} frames and a size >= 0"
        )
    made = _made(
        jnp.asarray(seeds, jnp.uint32),
        world,
        jnp.float32(sigma_b),
        (jnp.bool_(row.along), jnp.bool_(row.correlated)),
    )
    pooled = jnp.bool_(row.pooled_scale)
    found = _tested(made, row.loss, world, jnp.int32(count), pooled)
    return {name: np.asarray(values, np.float64) for name, values in found.items()}


def sweep(
    points: Sequence[tuple[int, float]], seeds: Sequence[int], world: World
) -> dict[str, Any]:
    """All rows at some points (N, sigma_b), ready for JSON.

    Returns:
      {"points": [[N, sigma_b], ...], "rows": {row: {measure: [interval per
      point]}}, "logistic_minus_gan": [paired difference of agreement per point]}.
    """
    rows: dict[str, Any] = {}
    runs: dict[str, list[np.ndarray]] = {}
    for name, row in ROWS.items():
        cells = [measure(row, n, sigma_b, seeds, world) for n, sigma_b in points]
        runs[name] = [cell["agreement"] for cell in cells]
        rows[name] = {key: [interval(cell[key]) for cell in cells] for key in cells[0]}
    cluster = np.arange(len(seeds))
    gains = [
        dataclasses.asdict(paired_difference(a, b, cluster))
        for a, b in zip(runs["RC-IRL logistic"], runs["GAN"], strict=True)
    ]
    shown = [[n, sigma_b] for n, sigma_b in points]
    return {"points": shown, "rows": rows, "logistic_minus_gan": gains}


def summary(body: dict[str, Any]) -> str:
    """The main numbers of the experiment as lines of text."""

    def text(line: dict[str, float]) -> str:
        return f"{line['mean']:.3g} [{line['low']:.3g}, {line['high']:.3g}]"

    lines = [
        f"angle to the truth, {name}: {text(line)} degrees"
        for name, line in body["example"]["angle_to_truth_deg"].items()
    ]
    for part in ("by_size", "by_frames"):
        for number in (0, -1):
            count, size = body[part]["points"][number]
            rows = body[part]["rows"].items()
            told = "; ".join(f"{n} {text(x['agreement'][number])}" for n, x in rows)
            lines.append(f"agreement, {count} frames, background {size:g}: {told}")
    return "\n".join(lines)
