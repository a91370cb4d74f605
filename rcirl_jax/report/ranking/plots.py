"""The paper's figures for one frame and one reward.

`example_frame` is the six-panel figure: the sampled profiles, human against
chosen, and the distances to each class of obstacle; `st_graph` the same frame
on the station-time graph; `discount_factors` the learned gamma_t.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from rcirl_jax.report.style import (
    CANDIDATE,
    CHOSEN,
    CLASS_COLOURS,
    HUMAN,
    figure,
    label,
    save,
)
from rcirl_jax.types import Candidates, Demonstration, Kind, Scene
from rcirl_jax.units import TIMES_S

SHOWN_CANDIDATES = 120  # at most so many profiles are drawn
DISTANCES = (
    ("follow_distance", "gap to the car followed (100: none)", "follow"),
    ("overtake_distance", "gap to the car overtaken (100: none)", "overtake"),
    ("stop_distance", "gap to the stop line (60: none)", "stop"),
    ("collision_distance", "distance to the closest obstacle", "other"),
)


def _mask(trajectory_values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    return np.where(valid, trajectory_values, np.nan)


def draw_obstacles(axis: Axes, scene: Scene) -> None:
    """Obstacles in the driver's way as bands on the station-time graph."""
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


def draw_st_graph(
    axis: Axes, demonstration: Demonstration, candidates: Candidates, chosen: int
) -> None:
    """Obstacles, candidates, human and chosen on one station-time graph."""
    valid = np.asarray(demonstration.scene.time_valid)
    stations = np.asarray(candidates.trajectory.s)
    feasible = np.flatnonzero(np.asarray(candidates.feasible))
    step = max(len(feasible) // SHOWN_CANDIDATES, 1)
    for k in feasible[::step]:
        axis.plot(
            TIMES_S, _mask(stations[k], valid), color=CANDIDATE, lw=0.5, alpha=0.5
        )
    draw_obstacles(axis, demonstration.scene)
    human = _mask(np.asarray(demonstration.human.s), valid)
    axis.plot(TIMES_S, human, color=HUMAN, lw=2, label="human")
    axis.plot(
        TIMES_S,
        _mask(stations[chosen], valid),
        "--",
        color=CHOSEN,
        lw=2,
        label="chosen",
    )
    top = np.nanmax(np.concatenate([human, _mask(stations[chosen], valid)]))
    axis.set_ylim(-10.0, 1.6 * top + 15.0)
    axis.legend(fontsize=8, loc="upper left", frameon=False)
    label(axis, "station-time graph", "t, s", "station, m")


def st_graph(
    path: Path, demonstration: Demonstration, candidates: Candidates, chosen: int
) -> Path:
    """PNG of one frame's station-time graph."""
    made, axes = figure(1, 1, 6.4, 4.6)
    draw_st_graph(axes[0, 0], demonstration, candidates, chosen)
    return save(made, path)


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
    """The paper's example frame: six panels of one scene.

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
    _draw_speeds(axes[0, 1], demonstration, candidates, chosen)
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


def _draw_speeds(
    axis: Axes, demonstration: Demonstration, candidates: Candidates, chosen: int
) -> None:
    valid = np.asarray(demonstration.scene.time_valid)
    speeds = np.asarray(candidates.trajectory.v)
    feasible = np.flatnonzero(np.asarray(candidates.feasible))
    step = max(len(feasible) // SHOWN_CANDIDATES, 1)
    for row in speeds[feasible[::step]]:
        axis.plot(TIMES_S, _mask(row, valid), color=CANDIDATE, lw=0.4, alpha=0.4)
    axis.plot(
        TIMES_S, _mask(np.asarray(demonstration.human.v), valid), color=HUMAN, lw=2
    )
    axis.plot(TIMES_S, _mask(speeds[chosen], valid), "--", color=CHOSEN, lw=2)
    axis.set_ylim(bottom=0.0)
    label(axis, "speed: human (solid), chosen (dashed)", "t, s", "m/s")


def training_curve(
    path: Path, steps: np.ndarray, series: Mapping[str, np.ndarray]
) -> Path:
    """PNG of metrics over steps, one panel each."""
    made, axes = figure(1, len(series), 4.4 * len(series), 3.4)
    for axis, (name, values) in zip(axes[0], series.items(), strict=True):
        axis.plot(steps, values, color=CLASS_COLOURS["follow"], lw=1)
        label(axis, name.replace("_", " "), "step", "")
    return save(made, path)
