"""The picture of one recorded scene: what was collected and how it was labelled.

Left the scene from above in lane coordinates, right its station-time graph on
the same station axis, below the human's speed and acceleration. One colour per
decision; numbers are the slots of `Obstacles`, so that a box, its boundary on
the graph and the row of the array can be told to be the same.
"""

import itertools
import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator

from rcirl_jax.report.data.scene_view import (
    KIND_WORDS,
    LINE_KINDS,
    View,
    spoken,
    tag_names,
    view_of,
)
from rcirl_jax.report.style import CANDIDATE, CHOSEN, CLASS_COLOURS, HUMAN, label, save
from rcirl_jax.report.style import plt as pyplot
from rcirl_jax.types import Decision, Demonstration, Kind
from rcirl_jax.units import DT_S, HORIZON_S, STATION_STEP_M, TIMES_S

DECISION_COLOURS = {
    Decision.FOLLOW: CLASS_COLOURS["follow"],
    Decision.YIELD: CLASS_COLOURS["virtual"],
    Decision.OVERTAKE: CLASS_COLOURS["overtake"],
    Decision.STOP: CLASS_COLOURS["stop"],
    Decision.NUDGE_LEFT: CLASS_COLOURS["nudge"],
    Decision.NUDGE_RIGHT: CLASS_COLOURS["nudge"],
    Decision.IGNORE: CANDIDATE,
}
ROAD_COLOUR = "#444444"
OFF_ROAD_COLOUR = "#EEEEEE"
WIDTH_INCHES, HEIGHT_INCHES = 5.6, 7.9  # inches without the legend
GRAPH_INCHES, MOTION_INCHES = (2.45, 7.15), (0.6, 1.75)  # above the legend
LINE_INCHES = 0.175  # of the legend
Rect = tuple[float, float, float, float]  # left, bottom, width, height
ASIDE_M = 1.5  # m beside the road and the boxes
BEND_SHOWN_DEG = 15.0  # deg of bend along the driven way that is worth a word
LABEL_HIGH = 0.034  # height of a line of text, share of the station axis
LETTER_S = 0.185  # s, width of a letter on the time axis
SHORT_CHARS = 2  # letters of a slot number alone
LEGEND_CHARS = 84  # letters in a line of the legend


def draw_scene(path: Path, demonstration: Demonstration, row: int) -> Path:
    """PNG of one scene.

    Args:
      path: PNG to write.
      demonstration: one unbatched demonstration.
      row: its number in the dataset, for the heading.

    Raises:
      InputError: it holds numbers that are not finite, or no valid time.
    """
    view = view_of(demonstration, row)
    entries = _legend(view)
    lines = sum(1 + str(entry.get_label()).count("\n") for entry in entries)
    below = LINE_INCHES * lines  # inches of the legend
    height = HEIGHT_INCHES + below
    made = pyplot.figure(figsize=(WIDTH_INCHES, height))
    heading = "\n".join(_heading(view, row))
    made.suptitle(heading, fontsize=10, x=0.02, y=1.0 - 0.08 / height, ha="left")

    # by hand: automatic layouts fail on a legend that may be half the picture
    def place(left: float, right: float, low: float, high: float) -> Rect:
        return left, (low + below) / height, right - left, (high - low) / height

    above = made.add_axes(place(0.11, 0.44, *GRAPH_INCHES))
    graph = made.add_axes(place(0.47, 0.97, *GRAPH_INCHES), sharey=above)
    speed = made.add_axes(place(0.11, 0.47, *MOTION_INCHES))
    acceleration = made.add_axes(place(0.61, 0.97, *MOTION_INCHES))
    for axis in (above, graph, speed, acceleration):
        axis.grid(True, linewidth=0.4, alpha=0.5)
        axis.spines[["top", "right"]].set_visible(False)
    _draw_above(above, view)
    _draw_graph(graph, view)
    _draw_motion(speed, acceleration, view)
    made.legend(
        handles=entries, loc="lower left", fontsize=8, frameon=False, borderaxespad=0.2
    )
    return save(made, path)


def _heading(view: View, row: int) -> list[str]:
    """Tags, speed, limit, bend and length of the recording."""
    scene, valid = view.rows.scene, view.rows.scene.time_valid
    tags = ", ".join(map(spoken, tag_names(view.rows))) or "no tag"
    facts = [
        f"{float(scene.ego.v):.1f} m/s at t = 0",
        f"limit {float(scene.path.speed_limit[0]):.1f} m/s",
        f"{float(view.rows.future_s):.1f} s recorded",
    ]
    driven = np.arange(scene.path.kappa.size) * STATION_STEP_M
    driven = driven <= view.rows.human.s[valid][-1]
    bend = float(np.rad2deg(scene.path.kappa[driven].sum() * STATION_STEP_M))
    if abs(bend) > BEND_SHOWN_DEG:
        facts.append(f"bends {abs(bend):.0f}° {'left' if bend > 0.0 else 'right'}")
    return [f"scene {row}: {tags}", ", ".join(facts)]


# ------------------------------------------------------------------- from above


def _draw_above(axis: Axes, view: View) -> None:
    """Road, path, human, ego and all obstacles; station up, left is left."""
    rows, path = view.rows, view.rows.scene.path
    grid = np.arange(path.l.size) * STATION_STEP_M
    axis.set_facecolor(OFF_ROAD_COLOUR)
    axis.fill_betweenx(grid, path.road_right, path.road_left, color="white", lw=0)
    for bound in (path.road_left, path.road_right):
        axis.plot(bound, grid, color=ROAD_COLOUR, lw=1.4)
    for bound in (path.lane_left, path.lane_right):
        axis.plot(bound, grid, color=ROAD_COLOUR, lw=0.8, ls=(0, (5, 4)))
    axis.plot(path.l, grid, color=CHOSEN, lw=1.2, ls=":")
    for slot in view.slots:
        if view.kind(slot) in LINE_KINDS:
            _draw_line(axis, view, slot)
        else:
            _draw_body(axis, view, slot)
    valid, ego = rows.scene.time_valid, rows.scene.ego
    axis.plot(
        rows.human.l[valid], rows.human.s[valid], "o-", color=HUMAN, lw=1.4, ms=2.2
    )
    corner = (float(ego.l - 0.5 * ego.width), -0.5 * float(ego.length))
    box = Rectangle(corner, float(ego.width), float(ego.length), zorder=4)
    box.set(facecolor=HUMAN, edgecolor="white", linewidth=0.6)
    axis.add_patch(box)
    left, right = _aside(view)
    axis.set_xlim(left, right)  # left of the road is left on the paper
    axis.set_ylim(view.low, view.high)
    axis.xaxis.set_major_locator(MaxNLocator(4, integer=True, prune="both"))
    label(axis, "from above", "lateral offset, m", "station, m")


def _aside(view: View) -> tuple[float, float]:
    """Lateral offsets at the left and right edge of the view from above."""
    path, obstacles = view.rows.scene.path, view.rows.scene.obstacles
    grid = np.arange(path.l.size) * STATION_STEP_M
    shown = (grid <= view.high) & (grid >= view.low)
    left = [float(path.road_left[shown].max()), float(view.rows.scene.ego.l) + 2.0]
    right = [float(path.road_right[shown].min()), float(view.rows.scene.ego.l) - 2.0]
    for slot in view.slots:
        if view.kind(slot) not in LINE_KINDS and view.inside(slot):
            at = view.first(slot)
            left.append(float(obstacles.l_upper[slot, at]))
            right.append(float(obstacles.l_lower[slot, at]))
    return max(left) + ASIDE_M, min(right) - ASIDE_M


def _draw_body(axis: Axes, view: View, slot: int) -> None:
    """Box when first known, trail over all known times, number."""
    obstacles, at = view.rows.scene.obstacles, view.first(slot)
    colour, valid = DECISION_COLOURS[view.decision(slot)], obstacles.valid[slot]
    low, high = obstacles.s_lower[slot], obstacles.s_upper[slot]
    right, left = obstacles.l_lower[slot], obstacles.l_upper[slot]
    s = np.where(valid, 0.5 * (low + high), np.nan)
    l = np.where(valid, 0.5 * (right + left), np.nan)
    axis.plot(l, s, color=colour, lw=1.0, alpha=0.9, zorder=2)
    last = len(valid) - 1 - int(np.argmax(valid[::-1]))
    if view.low < s[last] < view.high and abs(s[last] - s[at]) > 1.0:
        mark = "^" if s[last] > s[at] else "v"
        axis.plot(l[last], s[last], mark, color=colour, ms=3.5, zorder=2)
    if not view.inside(slot):
        return
    corner = (float(right[at]), float(low[at]))
    size = (float(left[at] - right[at]), float(high[at] - low[at]))
    box = Rectangle(corner, *size, facecolor=colour, edgecolor=HUMAN, zorder=3)
    box.set(linewidth=0.7, linestyle="-" if at == 0 else (0, (1.5, 1.0)))
    box.set_alpha(0.95 if at == 0 else 0.5)
    box.set_gid(f"slot {slot}")
    axis.add_patch(box)
    words = str(slot)
    if view.kind(slot) != Kind.VEHICLE:
        words += f" {KIND_WORDS[view.kind(slot)]}"
    if at:
        words += f" ({TIMES_S[at]:.1f} s)"
    middle = 0.5 * float(low[at] + high[at])
    # beside the box, long words towards the middle of the picture
    inwards = len(words) > SHORT_CHARS and l[at] < sum(_aside(view)) / 2.0
    beside = float(left[at]) + 0.25 if inwards else float(right[at]) - 0.25
    text = axis.text(beside, middle, words, fontsize=7, va="center", zorder=5)
    text.set(ha="right" if inwards else "left", clip_on=True)


def _draw_line(axis: Axes, view: View, slot: int) -> None:
    """A stop line or the destination across the road."""
    path, at = view.rows.scene.path, view.first(slot)
    s = float(view.rows.scene.obstacles.s_lower[slot, at])
    if not view.inside(slot):
        return
    grid = np.arange(path.l.size) * STATION_STEP_M
    ends = [float(np.interp(s, grid, x)) for x in (path.road_left, path.road_right)]
    colour = DECISION_COLOURS[view.decision(slot)]
    (line,) = axis.plot(ends, [s, s], color=colour, lw=3.5, zorder=2)
    line.set_gid(f"slot {slot}")
    axis.annotate(
        f"{slot} {KIND_WORDS[view.kind(slot)]}",
        (ends[0], s),
        (0, 3),
        textcoords="offset points",
        fontsize=7,
    )


# ----------------------------------------------------------- station-time graph


def _draw_graph(axis: Axes, view: View) -> None:
    """The human's s(t) between the boundaries of what blocks the driver's path."""
    rows, valid = view.rows, view.rows.scene.time_valid
    end = float(TIMES_S[valid][-1])
    if end < HORIZON_S - 0.5 * DT_S:
        middle = 0.5 * (view.low + view.high)
        axis.axvspan(end, HORIZON_S, facecolor=OFF_ROAD_COLOUR, zorder=0)
        words = "no recording"
        axis.text(
            0.5 * (end + HORIZON_S), middle, words, fontsize=7, rotation=90, ha="center"
        )
    wishes = []
    for slot in view.slots:
        shown = view.blocks[slot] & valid
        if shown.any():
            _draw_boundary(axis, view, slot, shown)
            wishes.append((slot, shown))
    half = 0.5 * float(rows.scene.ego.length)
    s, t = rows.human.s[valid], TIMES_S[valid]
    axis.fill_between(t, s - half, s + half, color=HUMAN, alpha=0.12, lw=0)
    axis.plot(t, s, "o-", color=HUMAN, lw=1.6, ms=2.2)
    taken: list[tuple[float, float, float]] = []
    for slot, shown in wishes:
        _label_boundary(axis, view, slot, shown, taken)
    axis.set_xlim(0.0, HORIZON_S)
    label(axis, "station-time graph", "t, s", "")
    axis.tick_params(labelleft=False)


def _draw_boundary(axis: Axes, view: View, slot: int, shown: np.ndarray) -> None:
    """Bars at the times themselves, filled between neighbours."""
    obstacles = view.rows.scene.obstacles
    colour = DECISION_COLOURS[view.decision(slot)]
    low, high = obstacles.s_lower[slot], obstacles.s_upper[slot]
    if view.kind(slot) in LINE_KINDS:
        t = TIMES_S[shown]
        from_s, to_s = t - 0.5 * DT_S, t + 0.5 * DT_S
        bars = axis.hlines(low[shown], from_s, to_s, color=colour, lw=3.5)
    else:
        axis.fill_between(
            TIMES_S, low, high, where=shown, color=colour, alpha=0.35, lw=0
        )
        bars = axis.vlines(TIMES_S[shown], low[shown], high[shown], color=colour)
        bars.set_linewidth(1.4)
    bars.set_gid(f"slot {slot}")


def _label_boundary(
    axis: Axes,
    view: View,
    slot: int,
    shown: np.ndarray,
    taken: list[tuple[float, float, float]],
) -> None:
    """Number and decision at the first place along the boundary that is free.

    Args:
      axis: the graph.
      view: the scene.
      slot: whose boundary it is.
      shown: [T] bool, times at which it is drawn.
      taken: (from t, to t, height) of the labels so far; the new one is added.
    """
    obstacles = view.rows.scene.obstacles
    words = f"{slot} {spoken(view.decision(slot).name)}"
    high = LABEL_HIGH * (view.high - view.low)
    wide = LETTER_S * len(words)
    for at, above in itertools.product(np.flatnonzero(shown).tolist(), (True, False)):
        edge = obstacles.s_upper[slot, at] if above else obstacles.s_lower[slot, at]
        start = min(float(TIMES_S[at]) + 0.08, HORIZON_S - wide)
        s = float(edge) + (0.65 if above else -0.65) * high
        free = all(
            start > b or start + wide < a or abs(s - y) > high for a, b, y in taken
        )
        if free and view.low + high < s < view.high - high:
            taken.append((start, start + wide, s))
            back = {"facecolor": "white", "alpha": 0.75, "pad": 0.6, "lw": 0}
            axis.text(start, s, words, fontsize=7.5, va="center", bbox=back, zorder=6)
            return


# ------------------------------------------------------------ signals and words


def _draw_motion(speed: Axes, acceleration: Axes, view: View) -> None:
    """The human's speed beside the limit, and acceleration."""
    rows, valid = view.rows, view.rows.scene.time_valid
    human, path, t = rows.human, rows.scene.path, TIMES_S[valid]
    grid = np.arange(path.l.size) * STATION_STEP_M
    limit = np.interp(human.s[valid], grid, path.speed_limit)
    speed.plot(t, limit, color=CANDIDATE, lw=1.4, ls="--")
    speed.plot(t, human.v[valid], "o-", color=HUMAN, lw=1.4, ms=2.2)
    top = max(float(limit.max()), float(human.v[valid].max()), 1.0)
    speed.set_ylim(0.0, 1.1 * top)
    acceleration.axhline(0.0, color=CANDIDATE, lw=0.8)
    acceleration.plot(t, human.a[valid], "o-", color=HUMAN, lw=1.4, ms=2.2)
    reach = max(1.0, 1.1 * float(np.abs(human.a[valid]).max()))
    acceleration.set_ylim(-reach, reach)
    for axis in (speed, acceleration):
        axis.set_xlim(0.0, HORIZON_S)
    label(speed, "speed (dashed: limit)", "t, s", "m/s")
    label(acceleration, "acceleration", "t, s", "m/s²")


def _legend(view: View) -> list[Patch | Line2D]:
    """Lines, and one row per decision with the slots that it was made for."""
    rows: list[Patch | Line2D] = [
        Line2D([], [], color=HUMAN, marker="o", ms=3, label="human; box: ego at t = 0"),
        Line2D([], [], color=CHOSEN, ls=":", label="given path"),
    ]
    for decision in DECISION_COLOURS:
        slots = [k for k in view.slots if view.decision(k) == decision]
        if slots:
            words = f"{spoken(decision.name)}: {_runs(slots)}"
            rows.append(Patch(color=DECISION_COLOURS[decision], label=words))
    away = [slot for slot in view.slots if not view.inside(slot)]
    if away:
        obstacles, places = view.rows.scene.obstacles, []
        for slot in away:
            at = obstacles.s_lower[slot, view.first(slot)]
            places.append(f"{slot} at {float(at):.0f} m")
        words = textwrap.fill("not in view: " + ", ".join(places), LEGEND_CHARS)
        rows.append(Line2D([], [], ls="", label=words))
    return rows


def _runs(slots: Sequence[int]) -> str:
    """Numbers with runs joined: 0, 2 to 5."""
    parts = []
    for _, group in itertools.groupby(enumerate(slots), lambda pair: pair[1] - pair[0]):
        run = [slot for _, slot in group]
        parts += [f"{run[0]} to {run[-1]}"] if len(run) > 2 else map(str, run)
    return ", ".join(parts)
