"""Background shifting, the paper's figure computed.

    python -m experiments.paper.background_shift --output=DIR [--quick]

The paper says why human and samples must be compared within a scene (section II,
"Background shifting problem"): scenes differ in features that no candidate of the scene
can change, and a learner that pools scenes learns those too. Two frames differ by a
constant; one direction is right in both. Found are the widest margin of one frame alone
and the linear rewards V = w f that the package's losses fit to both, pooled (the
discriminator) and conditional. For a linear reward the conditional losses see
V(sample) - V(human) only, so the background drops out by algebra: that they find the
truth is no discovery. How far pooling is led astray is.

Expected: pooling tilts the direction by about 40 degrees, towards the normal of the
shift, in every draw; the conditional losses stay within a few degrees. Writes
DIR/background_shift.json and .png; half a minute, `--quick`, a tenth of the draws: ten
seconds.
"""

import dataclasses
import functools
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from absl import flags
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from rcirl_jax.cli.running import provenance, run
from rcirl_jax.evaluation.statistics import clopper_pearson, combine_seeds
from rcirl_jax.report.style import (
    CANDIDATE,
    CHOSEN,
    CLASS_COLOURS,
    HUMAN,
    figure,
    label,
    save,
)
from rcirl_jax.reward import CandidateInfo, LossConfig, LossInputs, loss_sums
from rcirl_jax.runtime.atomic_files import write_json

_OUTPUT = flags.DEFINE_string("output", "out/background_shift", "folder to write")
_SEED = flags.DEFINE_integer("seed", 0, "seed of the draws", 0)
_QUICK = flags.DEFINE_bool("quick", False, "few draws")

ANGLES = 3600  # directions tried for the widest margin, 0.1 degree apart
DRAWS_AT_ONCE = 20  # keeps the table of margins small
LEAKY_RATE = 0.05  # a of the rank loss, as in the paper
# weight of |w|^2 / 2 for the losses whose scale is free: with separable frames they
# have no minimum without it
RIDGE = 0.01
STEPS, RATE = 1000, 0.1  # of Adam; the first step size falls to 0 (cosine)
TRUTH = (0.0, 1.0)  # the direction that is right in both frames
DIRECTIONS = {  # name -> loss; None: the widest margin of one frame alone
    "one frame": None,
    "pooled": "gan",
    "conditional, logistic": "logistic",
    "conditional, rank": "rank",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class TwoFrames:
    """The paper's example; features are numbers without a unit."""

    samples: int = 100  # per frame, from a two-dimensional Cauchy distribution
    scale: float = 0.6  # of the distribution
    # where the tail is cut off: all samples stay below the human along the truth
    reach: float = 2.5
    lead: float = 3.0  # how far the human lies from the samples' centre
    shift: float = 4.0  # from the first frame to the second
    shift_angle_deg: float = 45.0  # from the truth, clockwise


class Frames(NamedTuple):
    """Features of N frames."""

    human: jax.Array  # [N, F]
    candidates: jax.Array  # [N, K, F]


class Learned(NamedTuple):
    """A fitted linear reward."""

    direction: jax.Array  # [F], unit norm
    threshold: jax.Array  # [], of the discriminator: V = threshold divides
    gradient: jax.Array  # [], norm at the last step: how far from a minimum


def two_frames(key: jax.Array, config: TwoFrames) -> Frames:
    """Draws samples and human, and the same once more, shifted by a constant.

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
    """Finds a frame's max-margin direction [2]: argmax_u min_k u (human - f_k).

    Every angle is tried. Source: Ratliff et al. (ICML 2006), one frame, no slack.
    """
    turn = jnp.arange(ANGLES) * (2.0 * np.pi / ANGLES)
    tried = jnp.stack([jnp.cos(turn), jnp.sin(turn)], axis=-1)  # [A, 2]
    margin = jnp.min((human - candidates) @ tried.T, axis=0)
    return tried[jnp.argmax(margin)]


def learn(loss: str, frames: Frames, start: jax.Array) -> Learned:
    """Fits V = w f to frames with one of the package's losses.

        minimise  loss(w, b) / terms + ridge |w|^2 / 2

    The rank loss has no scale of its own: there w is divided by its norm first, as
    `reward.effective_params` does, and the ridge is left out.

    Args:
      loss: key of `reward.LOSSES` that reads values only; "gan" pools.
      frames: N frames.
      start: [F], not zero.
    """
    unit = loss == "rank"
    # a common shift changes nothing but the offset, and Adam's patience with it
    centre = jnp.mean(jnp.mean(frames.candidates, axis=1), axis=0)
    human, candidates = frames.human - centre, frames.candidates - centre
    table = jnp.zeros(candidates.shape[:2])  # of what these losses do not read

    def total(params: tuple[jax.Array, jax.Array]) -> jax.Array:
        weights, offset = params
        used = weights / jnp.linalg.norm(weights) if unit else weights
        info = CandidateInfo(
            human_distance=table[:, 0],
            human_collides=table[:, 0] > 0.0,
            distance=table,
            collides=table > 0.0,
            breaks_rule=table,
            human_density=table[:, 0],
            density=table,
            human_own=table[:, 0],
            own=table,
        )
        compared = LossInputs(
            human=human @ used,
            candidates=candidates @ used,
            feasible=table == 0.0,
            weight=table[:, 0] + 1.0,
            info=info,
            offset=offset,
        )
        sums = loss_sums(loss, compared, LossConfig(leaky_rate=LEAKY_RATE))
        pull = 0.0 if unit else 0.5 * RIDGE * jnp.sum(weights**2)
        return sums.loss / sums.terms + pull

    optimizer = optax.adam(optax.cosine_decay_schedule(RATE, STEPS))

    def step(carry: tuple, _: None) -> tuple:
        params, state = carry
        grads = jax.grad(total)(params)
        updates, state = optimizer.update(grads, state)
        return (optax.apply_updates(params, updates), state), optax.tree.norm(grads)

    first = (start, jnp.zeros(()))
    carry = (first, optimizer.init(first))
    ((weights, offset), _), norms = jax.lax.scan(step, carry, None, length=STEPS)
    scale = jnp.linalg.norm(weights)
    direction = weights / scale
    return Learned(direction, direction @ centre - offset / scale, norms[-1])


@functools.partial(jax.jit, static_argnames=("draws", "config"))
def draw_examples(
    seed: int, draws: int, config: TwoFrames
) -> tuple[Frames, dict[str, Learned]]:
    """Returns D draws of the two frames and the `DIRECTIONS` found, leaves [D, ...]."""

    def one(key: jax.Array) -> tuple[Frames, dict[str, Learned]]:
        draw_key, start_key = jax.random.split(key)
        frames = two_frames(draw_key, config)
        start = jax.random.normal(start_key, (2,))
        alone = widest_margin(frames.human[0], frames.candidates[0])
        found = {"one frame": Learned(alone, jnp.zeros(()), jnp.zeros(()))}
        for name, loss in DIRECTIONS.items():
            if loss is not None:
                found[name] = learn(loss, frames, start)
        return frames, found

    keys = jax.random.split(jax.random.key(seed), draws)
    return jax.lax.map(one, keys, batch_size=DRAWS_AT_ONCE)


def angle_deg(a: ArrayLike, b: ArrayLike) -> np.ndarray:
    """Returns the angle between directions of unit norm [..., F], in degrees."""
    cosine = jnp.clip(jnp.sum(jnp.asarray(a) * jnp.asarray(b), axis=-1), -1.0, 1.0)
    return np.asarray(jnp.degrees(jnp.arccos(cosine)))


def example_numbers(found: dict[str, Learned]) -> dict[str, Any]:
    """Returns angles of D draws with intervals, ready for JSON.

    Per direction: the mean angle to the truth in degrees with its 95 % bootstrap
    interval over draws, where 95 % of the draws lie, and the mean angle to the first
    frame's own optimum. `conditional_nearer`: share of draws in which a conditional
    direction is nearer to the truth than the pooled one, with its exact interval.
    """
    angles = {name: angle_deg(x.direction, TRUTH) for name, x in found.items()}
    numbers: dict[str, Any] = {"angle_to_truth_deg": {}, "conditional_nearer": {}}
    for name in DIRECTIONS:
        values, count = angles[name], angles[name].size
        apart = angle_deg(found[name].direction, found["one frame"].direction)
        low, high = np.quantile(values, [0.025, 0.975])
        mean = combine_seeds(values, np.arange(count))
        numbers["angle_to_truth_deg"][name] = {
            "mean": mean.value,
            "low": mean.low,
            "high": mean.high,
            "draws_from": float(low),
            "draws_to": float(high),
            "to_one_frame_deg": float(apart.mean()),
            "last_gradient": float(jnp.max(found[name].gradient)),
        }
        if name.startswith("conditional"):
            nearer = int(np.sum(values < angles["pooled"]))
            low, high = clopper_pearson(nearer, count)
            share = {"share": nearer / count, "low": low, "high": high}
            numbers["conditional_nearer"][name] = share
    return numbers


# ---------------------------------------------------------------- picture

COLOURS = {
    "one frame": HUMAN,
    "pooled": CHOSEN,
    "conditional, logistic": CLASS_COLOURS["follow"],
    "conditional, rank": CLASS_COLOURS["overtake"],
}
MARKS = ((CLASS_COLOURS["other"], "o", 6), (CLASS_COLOURS["nudge"], "s", 3))  # frames
ARROW = 2.2  # length of the arrows in feature units


def draw(path: Path, frames: Frames, found: dict[str, Learned]) -> None:
    """Draws one example: each frame alone, both pooled, differences within a frame."""
    made, axes = figure(1, 3, 13.5, 4.8)
    alone, pooled, within = axes[0]

    def arrow(axis: Axes, name: str, start: np.ndarray, *, again: bool = False) -> None:
        end = start + ARROW * np.asarray(found[name].direction)
        style = {"arrowstyle": "-|>", "color": COLOURS[name], "lw": 2.2}
        axis.annotate(
            "", xy=(end[0], end[1]), xytext=(start[0], start[1]), arrowprops=style
        )
        if again:
            return
        angle = float(angle_deg(found[name].direction, TRUTH))
        text = f"{name}: {angle:.1f}° off"
        axis.plot([], [], color=COLOURS[name], lw=2.2, label=text)

    def truth(axis: Axes, start: np.ndarray) -> None:
        ends = np.stack([start, start + 1.5 * ARROW * np.asarray(TRUTH)])
        axis.plot(*ends.T, ":", color=CANDIDATE, lw=1.6)

    for number, (colour, mark, size) in enumerate(MARKS):
        human, samples = frames.human[number], frames.candidates[number]
        for axis in (alone, pooled):
            axis.plot(*samples.T, mark, color=colour, ms=3, alpha=0.7, mew=0)
            axis.plot(*human, "*", color=colour, ms=15, mec=HUMAN, mew=1.0)
        apart = (human - samples).T
        within.plot(*apart, mark, color=colour, ms=size, alpha=0.7, mew=0)
        centre = np.median(samples, axis=0)
        truth(alone, centre)
        arrow(alone, "one frame", centre, again=number > 0)
        place = (centre[0] + (-1.7, 1.7)[number], centre[1] - 1.6)
        alone.annotate(f"frame {number + 1}", place, fontsize=9, ha="center")
    direction = found["pooled"].direction
    centre = np.mean(frames.candidates, axis=(0, 1))
    foot = centre + (float(found["pooled"].threshold) - centre @ direction) * direction
    along = np.array([direction[1], -direction[0]])
    ends = np.stack([foot - 4.5 * along, foot + 4.5 * along])
    pooled.plot(*ends.T, color=CHOSEN, lw=1.0)
    pooled.annotate(
        "discriminator's\nboundary", tuple(ends[0]), (2, -2), fontsize=8, color=CHOSEN,
        textcoords="offset points", va="top",
    )  # fmt: skip
    truth(pooled, foot)
    arrow(pooled, "pooled", foot)
    within.plot(0.0, 0.0, "+", color=HUMAN, ms=9, mew=1.5)
    truth(within, np.zeros(2))
    for name in ("conditional, logistic", "conditional, rank"):
        arrow(within, name, np.zeros(2))
    label(alone, "each frame alone: widest margin", "feature 1", "feature 2")
    label(pooled, "pooled: all humans against all samples", "feature 1", "feature 2")
    names = [f"difference of feature {i}" for i in (1, 2)]
    label(within, "conditional: human − sample within each frame", *names)
    for axis in axes[0]:
        axis.plot([], [], ":", color=CANDIDATE, lw=1.6, label="truth")
        axis.legend(fontsize=8, frameon=False, loc="upper left")
        axis.set_aspect("equal")
    for axis in (alone, pooled):
        axis.set_xlim(-4.0, 6.5)
        axis.set_ylim(-3.5, 9.5)
    save(made, path)


def main() -> None:
    """Draws, picture; numbers as JSON."""
    draws, folder = 20 if _QUICK.value else 200, Path(_OUTPUT.value)
    folder.mkdir(parents=True, exist_ok=True)
    moved, still = TwoFrames(), TwoFrames(shift=0.0)
    frames, found = draw_examples(_SEED.value, draws, moved)
    example = example_numbers(found)
    alike = example_numbers(draw_examples(_SEED.value, draws, still)[1])
    learning = {"steps": STEPS, "rate": RATE, "ridge": RIDGE, "leaky_rate": LEAKY_RATE}
    body = {
        "draws": draws,
        "example": example,
        "example_without_shift": alike,
        "two_frames": {**dataclasses.asdict(moved), "learning": learning},
        "made_by": provenance(),
    }
    target = folder / "background_shift.json"
    write_json(target, body)
    picture = folder / "background_shift.png"
    draw(picture, *jax.tree.map(lambda x: np.asarray(x[0]), (frames, found)))
    for name, angle in example["angle_to_truth_deg"].items():
        mean, low, high = (angle[key] for key in ("mean", "low", "high"))
        print(f"angle to the truth, {name}: {mean:.3g} [{low:.3g}, {high:.3g}] degrees")
    print(f"written: {target} and {picture.name}")


if __name__ == "__main__":
    run(main)
