"""Pictures of scenes to be judged: what the human and one obstacle did, no labels.

A row shows one scene: stations, offsets and speeds over time, and views from above
at five times. The human is blue, the obstacle red, others grey.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from rcirl_jax.evaluation.labels.judged import Found
from rcirl_jax.report.style import plt as pyplot
from rcirl_jax.units import NUM_STATIONS, STATION_STEP_M, TIMES_S

ROWS = 6  # scenes on a sheet
VIEWS = 5  # times seen from above
VIEW_M, BESIDE_M = (-35.0, 65.0), 6.5  # m shown along the road and to each side
LINE_M = 1.7  # m beside the human within which others are in its line
HUMAN, OTHER, REST = "tab:blue", "tab:red", "silver"
GRID_M = np.arange(NUM_STATIONS) * STATION_STEP_M
BOUNDS = ("s_lower", "s_upper", "l_lower", "l_upper")


def draw_sheets(folder: Path, scenes: Sequence[Found]) -> int:
    """PNGs sheet_000.png and so on below a folder; returns how many."""
    folder.mkdir(parents=True, exist_ok=True)
    shown = [(row, slot) for _, row, slot in scenes if slot is not None]
    for first in range(0, len(shown), ROWS):
        _draw(folder / f"sheet_{first // ROWS:03d}.png", shown[first : first + ROWS])
    return -(-len(shown) // ROWS)


def _draw(path: Path, scenes: Sequence[tuple[dict, int]]) -> None:
    made = pyplot.figure(figsize=(17.0, 3.05 * len(scenes)))
    grid = made.add_gridspec(len(scenes), 4, width_ratios=[1, 1, 1, 2])
    for place, (row, slot) in enumerate(scenes):
        axes = [made.add_subplot(grid[place, column]) for column in range(3)]
        _over_time(axes, row, slot)
        views = grid[place, 3].subgridspec(VIEWS, 1, hspace=0.05)
        times = np.flatnonzero(row["time_valid"])
        chosen = np.linspace(0, times.size - 1, VIEWS).round().astype(int)
        for view, time in enumerate(times[chosen]):
            _from_above(made.add_subplot(views[view, 0]), row, slot, int(time))
    made.savefig(path, dpi=72, bbox_inches="tight")
    pyplot.close(made)


def _over_time(axes: Sequence[Axes], row: dict, slot: int) -> None:
    """Stations, offsets and speeds of the human and the obstacle."""
    known = row["time_valid"]
    seen = row["obstacles.valid"][slot] & known
    box = {name: row[f"obstacles.{name}"][slot][seen] for name in BOUNDS}
    times, own = TIMES_S[seen], TIMES_S[known]
    for axis, name, size in ((axes[0], "s", "length"), (axes[1], "l", "width")):
        half, middle = 0.5 * row[f"ego.{size}"], row[f"human.{name}"][known]
        axis.fill_between(own, middle - half, middle + half, color=HUMAN, alpha=0.6)
        low, high = box[f"{name}_lower"], box[f"{name}_upper"]
        axis.fill_between(times, low, high, color=OTHER, alpha=0.6)
        axis.set_title(f"{name}, m", fontsize=9, pad=2)
    for name in ("lane_left", "lane_right"):
        line = np.interp(row["human.s"], GRID_M, row[f"path.{name}"])
        axes[1].plot(own, line[known], "k:")
    _others_in_line(axes[0], row, slot)
    axes[2].plot(own, np.gradient(row["human.s"], TIMES_S)[known], ".-", color=HUMAN)
    axes[2].plot(times, row["obstacles.speed"][slot][seen], ".-", color=OTHER)
    axes[2].set_title("v, m/s", fontsize=9, pad=2)


def _others_in_line(axis: Axes, row: dict, slot: int) -> None:
    s_lower, s_upper, l_lower, l_upper = (row[f"obstacles.{name}"] for name in BOUNDS)
    near = np.abs(0.5 * (l_lower + l_upper) - row["human.l"]) < LINE_M
    near &= row["obstacles.valid"] & row["time_valid"]
    near &= (row["obstacles.track"] >= 0)[:, None]
    near[slot] = False
    for at, time in zip(*np.nonzero(near), strict=True):
        ends = [s_lower[at, time], s_upper[at, time]]
        axis.plot([TIMES_S[time]] * 2, ends, color="grey", lw=2, alpha=0.6)
    reach = row["human.s"][row["time_valid"]][-1]
    axis.set_ylim(-40.0, reach + 70.0)


def _from_above(axis: Axes, row: dict, slot: int, time: int) -> None:
    """Boxes about the human at one time, with its lane and its own path."""
    s, l = row["human.s"][time], row["human.l"][time]
    for name in ("lane_left", "lane_right"):
        axis.plot(GRID_M - s, row[f"path.{name}"], "k:", lw=0.8)
    axis.plot(GRID_M - s, row["path.l"], color=HUMAN, lw=0.6)
    length, width = row["ego.length"], row["ego.width"]
    corner = (-0.5 * length, l - 0.5 * width)
    axis.add_patch(Rectangle(corner, length, width, color=HUMAN))
    there = row["obstacles.valid"][:, time] & (row["obstacles.track"] >= 0)
    for at in np.flatnonzero(there).tolist():
        low_s, high_s, low, high = (row[f"obstacles.{n}"][at, time] for n in BOUNDS)
        colour = OTHER if at == slot else REST
        box = Rectangle((low_s - s, low), high_s - low_s, high - low, color=colour)
        axis.add_patch(box)
    axis.set_xlim(*VIEW_M)
    axis.set_ylim(l - BESIDE_M, l + BESIDE_M)
    axis.set_yticks([])
    axis.text(VIEW_M[0], l, f" {TIMES_S[time]:.1f} s", fontsize=8)
