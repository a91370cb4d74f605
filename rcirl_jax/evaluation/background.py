"""Background shifting: what pooling scenes does to a learned reward.

The paper says why human and samples must be compared within a scene (section
II, "Background shifting problem"): scenes differ in features that no candidate
of the scene can change, and a learner that pools scenes learns those too. Two
measurements of that, with the package's own losses and a linear reward V = w f:

* the paper's figure: two frames that differ by a constant, one direction that
  is right in both, and the directions that pooling and conditioning find;
* a choice problem with a hidden reward, where the background is made large.

For a linear reward the conditional losses see V(sample) - V(human) only, so the
background drops out by algebra: that their curves are flat is no discovery. How
much pooling loses, and what brings the background back in, are.

Features are numbers without a unit: within a frame the candidates have a spread
of about 1 per feature, and the background's size is told in that spread.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.exact import clopper_pearson
from rcirl_jax.evaluation.statistics import (
    combine_seeds,
    paired_difference,
)
from rcirl_jax.reward import Compared, LossConfig, loss_sums

ANGLES = 3600  # directions tried for the widest margin, 0.1 degree apart
DRAWS_AT_ONCE = 20  # keeps the table of margins small
TEST_FRAMES = 1000  # fresh frames per seed


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
    counts: jax.Array  # [N, K] bool, False where the candidate is the human
    weight: jax.Array  # [N] 1, or 0 for frames left out


class Learned(NamedTuple):
    """A fitted linear reward."""

    direction: jax.Array  # [F], unit norm
    threshold: jax.Array  # [], of the discriminator: V = threshold divides
    gradient: jax.Array  # [], norm at the last step: how far from a minimum


def _compared(weights: jax.Array, offset: jax.Array, frames: Frames) -> Compared:
    """Values V = w f of all frames; the losses used here read nothing else."""
    table = jnp.zeros(frames.counts.shape)
    return Compared(
        human=frames.human @ weights,
        candidates=frames.candidates @ weights,
        counts=frames.counts,
        weight=frames.weight,
        human_distance=table[:, 0],
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
    as `reward.network.pinned` does, and the ridge is left out.

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
    centre, _ = pooled_moments(frames)
    moved = frames._replace(
        human=frames.human - centre, candidates=frames.candidates - centre
    )
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


def pooled_moments(frames: Frames) -> tuple[jax.Array, jax.Array]:
    """Mean and spread of all candidates of all frames, each [F]."""
    share = frames.weight / jnp.sum(frames.weight)
    centre = share @ jnp.mean(frames.candidates, axis=1)
    apart = (frames.candidates - centre) ** 2
    return centre, jnp.sqrt(share @ jnp.mean(apart, axis=1))


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
        counts=jnp.ones((2, config.samples), bool),
        weight=jnp.ones(2),
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


# ------------------------------------------------------------ choice problem


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
    learning: Learning = Learning()


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
