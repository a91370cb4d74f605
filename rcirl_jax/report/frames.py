"""Example scenes under an exported reward: the paper's figures of one frame.

`draw_frame` is the six-panel figure (the sampled profiles, human against chosen, the
distances to each class of obstacle) and the same frame's station-time graph.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes

from rcirl_jax.data.store.dataset import Demonstrations
from rcirl_jax.evaluation.attribution import attribute
from rcirl_jax.evaluation.ranking.score import candidates_key
from rcirl_jax.export.closed_loop import incumbent_score
from rcirl_jax.export.loading import own_cost_of, reward_params
from rcirl_jax.export.reader import Reward
from rcirl_jax.features import feature_map
from rcirl_jax.planner.rank import Params, Score
from rcirl_jax.report.style import (
    CANDIDATE,
    CHOSEN,
    CLASS_COLOURS,
    HUMAN,
    figure,
    label,
    save,
)
from rcirl_jax.sampling import SamplerConfig, sample
from rcirl_jax.sampling.sampler import as_candidates
from rcirl_jax.train.featurise import human_of
from rcirl_jax.train.metrics import read_metrics
from rcirl_jax.types import (
    Candidates,
    Decision,
    Demonstration,
    Kind,
    Scene,
    Tag,
)
from rcirl_jax.units import TIMES_S

WANTED = (
    Tag.STOPPING,
    Tag.STARTING,
    Tag.CUT_IN,
    Tag.YIELDING,
    Tag.OVERTAKING,
    Tag.RED_LIGHT,
)
SHOWN_CANDIDATES = 120  # at most so many profiles are drawn
DISTANCES = (
    ("follow_distance", "gap to the car followed (100: none)", "follow"),
    ("overtake_distance", "gap to the car overtaken (100: none)", "overtake"),
    ("stop_distance", "gap to the stop line (60: none)", "stop"),
    ("collision_distance", "distance to the closest obstacle", "other"),
)


def pick_frames(dataset: Demonstrations, count: int) -> np.ndarray:
    """Return held-out rows to draw: one per interesting tag, then any."""
    index = dataset.indices("test")
    rows = dataset.read(index)
    tags = np.asarray(rows.scene.tags)
    follows = np.any(np.asarray(rows.decisions) == Decision.FOLLOW, axis=1)
    full = np.asarray(rows.future_s) > 7.0
    chosen: list[int] = []
    for tag in WANTED:
        found = np.flatnonzero(tags[:, tag] & follows & full)
        chosen += [int(i) for i in found[:1] if int(i) not in chosen]
    chosen += [i for i in range(index.size) if i not in chosen]
    return index[np.array(chosen[:count], int)]


@dataclasses.dataclass(frozen=True, kw_only=True)
class DrawnFrame:
    """The content of one example-frame figure."""

    picture: Path
    caption: str
    chosen: int  # candidate with the highest value
    values: np.ndarray  # [K]
    feasible: np.ndarray  # [K] bool
    human_value: float
    human_s: np.ndarray  # [T] m
    chosen_s: np.ndarray  # [T] m
    # feature -> its part of V(chosen) - V(human), over all times
    reasons: dict[str, float]


_attributed = jax.jit(attribute, static_argnames="activation")


@functools.cache
def _sampled(preset: str, sampler: SamplerConfig, own: Score | None) -> Callable:
    """Return a program: scene, weights of `own` -> what a frame shows.

    That is the candidates, the human, and of the candidates and last the human: the
    features [K + 1, T, F] and the values [K + 1] of the own score, 0 without one.
    """
    features = feature_map(preset)

    def made(key: jax.Array, one: Demonstration, weights: Params) -> tuple:
        candidates, human = sample(key, one.scene, sampler), human_of(one, sampler)
        both = jax.tree.map(
            lambda many, one: jnp.concatenate([many, one]),
            candidates,
            as_candidates(human),
        )
        values = own(weights, one.scene, both) if own else jnp.zeros(both.family.shape)
        return candidates, human, features.of_candidates(one.scene, both), values

    return jax.jit(made)


def draw_frame(
    dataset: Demonstrations,
    reward: Reward,
    sampler: SamplerConfig,
    row: int,
    picture: Path,
    *,
    st_graph: Path | None = None,
) -> DrawnFrame:
    """Draw the six-panel figure of one scene, and its ST graph if a path is given."""
    rows = dataset.read(np.array([row]))
    one = jax.tree.map(lambda x: jnp.asarray(x[0]), rows)
    prior, own = reward.prior_cost, (None, None)
    if prior is not None:
        own = incumbent_score(prior.incumbent, own_cost_of([reward]))
    program = _sampled(reward.preset, sampler, own[0])
    made = program(candidates_key(jnp.asarray(row)), one, own[1])
    (candidates, human), (x, by_own) = made[:2], map(np.asarray, made[2:])
    valid = np.asarray(one.scene.time_valid)
    mask = np.broadcast_to(valid, x.shape[:2])
    every = reward.value(x, mask) if prior is None else reward.total(x, by_own, mask)
    values, x_human = every[:-1], x[-1]
    feasible = np.asarray(candidates.feasible)
    chosen = int(np.argmax(np.where(feasible, values, -np.inf)))
    drawn = one.replace(human=human)
    names = [tag.name.lower() for tag in Tag if bool(one.scene.tags[tag])]
    weights = reward_params(reward)
    parts = _attributed(*weights, x[chosen], x_human, valid, reward.activation)
    reasons = np.asarray(parts, np.float64).sum(axis=0).tolist()
    example_frame(
        picture,
        drawn,
        candidates,
        chosen,
        human_features=x_human,
        chosen_features=x[chosen],
        names=feature_map(reward.preset).names,
    )
    if st_graph is not None:
        made, axes = figure(1, 1, 6.4, 4.6)
        draw_st_graph(axes[0, 0], drawn, candidates, chosen)
        save(made, st_graph)
    return DrawnFrame(
        picture=picture,
        caption=(
            f"scene {row} ({', '.join(names) or 'no tag'}): human (black), chosen "
            "(orange, dashed) and candidates (grey)"
        ),
        chosen=chosen,
        values=values,
        feasible=feasible,
        human_value=float(every[-1]),
        human_s=np.asarray(human.s),
        chosen_s=np.asarray(candidates.trajectory.s[chosen]),
        reasons=dict(zip(reward.names, reasons, strict=True)),
    )


def draw_frames(
    dataset: Demonstrations,
    reward: Reward,
    sampler: SamplerConfig,
    folder: Path,
    count: int,
) -> list[tuple[Path, str]]:
    """Draw the paper's example-frame figure for some held-out scenes.

    Returns:
      (PNG, caption) per frame: the first also as a large ST graph.
    """
    pictures = []
    for number, row in enumerate(pick_frames(dataset, count)):
        path, graph = folder / f"frame_{number}.png", folder / "st_graph.png"
        frame = draw_frame(
            dataset,
            reward,
            sampler,
            int(row),
            path,
            st_graph=graph if number == 0 else None,
        )
        pictures.append((path, frame.caption))
        if number == 0:
            pictures.append((graph, f"station-time graph of scene {int(row)}"))
    return pictures


def draw_training(workdir: Path, folder: Path) -> list[tuple[Path, str]]:
    """Draw loss and pair accuracy over the steps of a run, from metrics.jsonl."""
    rows = read_metrics(workdir / "metrics.jsonl")
    names = ("loss", "pair_accuracy", "queries_per_s")
    made, axes = figure(1, len(names), 4.4 * len(names), 3.4)
    for axis, name in zip(axes[0], names, strict=True):
        values = np.array([row.get(name) or np.nan for row in rows], float)
        steps = [row["step"] for row in rows]
        axis.plot(steps, values, color=CLASS_COLOURS["follow"], lw=1)
        label(axis, name.replace("_", " "), "step", "")
    path = save(made, folder / "training.png")
    return [(path, "training: loss, pairs won by the human, queries per second")]


def _mask(trajectory_values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    return np.where(valid, trajectory_values, np.nan)


def draw_obstacles(axis: Axes, scene: Scene) -> None:
    """Draw obstacles in the driver's way as bands on the station-time graph."""
    obstacles, width = scene.obstacles, float(scene.ego.width)
    path_l = np.asarray(scene.path.l)
    grid = np.arange(path_l.size) * 2.0
    for slot in range(len(obstacles.kind)):
        kind = int(obstacles.kind[slot])
        if kind == Kind.NONE:
            continue
        low = np.asarray(obstacles.s_lower[slot])
        high = np.asarray(obstacles.s_upper[slot])
        own = np.interp(0.5 * (low + high), grid, path_l)
        beside = np.maximum(
            np.asarray(obstacles.l_lower[slot]) - own,
            own - np.asarray(obstacles.l_upper[slot]),
        )
        shown = np.asarray(obstacles.valid[slot]) & (beside < 0.5 * width + 0.2)
        if kind in (Kind.STOP, Kind.VIRTUAL):
            colour = CLASS_COLOURS["stop" if kind == Kind.STOP else "virtual"]
            axis.plot(TIMES_S, _mask(low, shown), color=colour, linewidth=3)
        else:
            axis.fill_between(
                TIMES_S,
                np.where(shown, low, np.nan),
                np.where(shown, high, np.nan),
                color=CLASS_COLOURS["other"],
                alpha=0.45,
                linewidth=0,
            )


def _draw_candidates(
    axis: Axes,
    demonstration: Demonstration,
    candidates: Candidates,
    leaf: str,
    how: dict,
) -> None:
    """Draw a leaf (s, v) of some feasible candidates over time, in grey."""
    values = np.asarray(getattr(candidates.trajectory, leaf))
    feasible = np.flatnonzero(np.asarray(candidates.feasible))
    for row in values[feasible[:: max(len(feasible) // SHOWN_CANDIDATES, 1)]]:
        shown = _mask(row, np.asarray(demonstration.scene.time_valid))
        axis.plot(TIMES_S, shown, color=CANDIDATE, **how)


def _draw_both(
    axis: Axes,
    demonstration: Demonstration,
    candidates: Candidates,
    chosen: int,
    leaf: str,
) -> list[np.ndarray]:
    """Draw a leaf (s, v) of the human and, dashed, of the chosen; return both [T]."""
    valid = np.asarray(demonstration.scene.time_valid)
    human = _mask(np.asarray(getattr(demonstration.human, leaf)), valid)
    axis.plot(TIMES_S, human, color=HUMAN, lw=2, label="human")
    best = _mask(np.asarray(getattr(candidates.trajectory, leaf)[chosen]), valid)
    axis.plot(TIMES_S, best, "--", color=CHOSEN, lw=2, label="chosen")
    return [human, best]


def draw_st_graph(
    axis: Axes, demonstration: Demonstration, candidates: Candidates, chosen: int
) -> None:
    """Draw obstacles, candidates, human and chosen on one station-time graph."""
    _draw_candidates(axis, demonstration, candidates, "s", {"lw": 0.5, "alpha": 0.5})
    draw_obstacles(axis, demonstration.scene)
    top = np.nanmax(_draw_both(axis, demonstration, candidates, chosen, "s"))
    axis.set_ylim(-10.0, 1.6 * top + 15.0)
    axis.legend(fontsize=8, loc="upper left", frameon=False)
    label(axis, "station-time graph", "t, s", "station, m")


def example_frame(
    path: Path,
    demonstration: Demonstration,
    candidates: Candidates,
    chosen: int,
    *,
    human_features: np.ndarray,
    chosen_features: np.ndarray,
    names: Sequence[str],
) -> Path:
    """Draw the paper's example frame: six panels of one scene.

    Args:
      path: PNG to write.
      demonstration: one unbatched demonstration.
      candidates: its K candidates.
      chosen: number of the candidate with the highest value.
      human_features: [T, F] of the human.
      chosen_features: [T, F] of the chosen candidate.
      names: feature names in column order.
    """
    made, axes = figure(2, 3, 13.0, 7.2)
    valid = np.asarray(demonstration.scene.time_valid)
    draw_st_graph(axes[0, 0], demonstration, candidates, chosen)
    speeds = axes[0, 1]
    _draw_candidates(speeds, demonstration, candidates, "v", {"lw": 0.4, "alpha": 0.4})
    _draw_both(speeds, demonstration, candidates, chosen, "v")
    speeds.set_ylim(bottom=0.0)
    label(speeds, "speed: human (solid), chosen (dashed)", "t, s", "m/s")
    panels = [axes[0, 2], *axes[1]]
    for axis, (name, title, kind) in zip(panels, DISTANCES, strict=True):
        if name not in names:
            axis.set_visible(False)
            continue
        column = list(names).index(name)
        axis.plot(TIMES_S, _mask(human_features[:, column], valid), color=HUMAN, lw=2)
        axis.plot(
            TIMES_S, _mask(chosen_features[:, column], valid), "--", color=CHOSEN, lw=2
        )
        axis.spines["left"].set_color(CLASS_COLOURS[kind])
        axis.set_ylim(bottom=min(0.0, float(np.min(human_features[:, column]))))
        label(axis, title, "t, s", "m")
    return save(made, path)
