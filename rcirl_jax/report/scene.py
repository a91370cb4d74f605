"""The picture of one recorded scene: what was collected and how it was labelled.

Left the scene from above in lane coordinates, right its station-time graph on
the same station axis, below the human's speed and acceleration. One colour per
decision; numbers are the slots of `Obstacles`, so that a box, its boundary on
the graph and the row of the array can be told to be the same.
"""

import dataclasses
import itertools
import textwrap
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator

from rcirl_jax.data.scenes.manoeuvres import blocking
from rcirl_jax.errors import InputError
from rcirl_jax.report.style import CANDIDATE, CHOSEN, CLASS_COLOURS, HUMAN, label, save
from rcirl_jax.report.style import plt as pyplot
from rcirl_jax.types import Decision, Demonstration, Kind, Tag
from rcirl_jax.units import DT_S, HORIZON_S, STATION_STEP_M, TIMES_S

KIND_WORDS = {
    Kind.VEHICLE: "vehicle",
    Kind.CYCLIST: "cyclist",
    Kind.PEDESTRIAN: "pedestrian",
    Kind.STATIC: "standing object",
    Kind.STOP: "stop line",
    Kind.VIRTUAL: "destination",
}
LINE_KINDS = (Kind.STOP, Kind.VIRTUAL)
BEHIND_M = (12.0, 40.0)  # m behind the ego, at least and at most
AHEAD_M, SPARE_M = 15.0, 40.0  # m beyond the human's end; more for the ignored
LEAST_VIEW_M = 60.0  # m of road that is shown at least
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """One scene as numpy arrays, and the window that is drawn."""

    rows: Demonstration
    blocks: np.ndarray  # [N, T] bool, in the driver's path
    slots: list[int]  # filled slots that are known at some time
    low: float  # m, lowest station drawn
    high: float  # m, highest

    def first(self, slot: int) -> int:
        """Return the index of the first time at which the slot is known."""
        return int(np.argmax(self.rows.scene.obstacles.valid[slot]))

    def decision(self, slot: int) -> Decision:
        """Return the label of the slot."""
        return Decision(int(self.rows.decisions[slot]))

    def kind(self, slot: int) -> Kind:
        """Return what is in the slot."""
        return Kind(int(self.rows.scene.obstacles.kind[slot]))

    def inside(self, slot: int) -> bool:
        """Return whether the first box, or a line, lies in the window."""
        at, obstacles = self.first(slot), self.rows.scene.obstacles
        ends = obstacles.s_lower[slot, at], obstacles.s_upper[slot, at]
        return bool(ends[1] >= self.low and ends[0] <= self.high)


def tag_names(demonstration: Demonstration) -> list[str]:
    """Return the scene's tags in their order, lower case, as in the manifest."""
    tags = np.asarray(demonstration.scene.tags)
    return [tag.name.lower() for tag in Tag if bool(tags[tag])]


def spoken(name: str) -> str:
    """Return a name of a tag, a decision or a reason as words."""
    return name.replace("_", " ").lower()


def describe_scene(demonstration: Demonstration, row: int) -> str:
    """Describe the scene in words, for those who do not see its picture."""
    view = view_of(demonstration, row)
    human, valid = view.rows.human, view.rows.scene.time_valid
    words = [
        f"Scene {row}, {', '.join(map(spoken, tag_names(view.rows))) or 'no tag'}: "
        f"the human drives {float(human.s[valid][-1]):.0f} m in "
        f"{float(TIMES_S[valid][-1]):.1f} s, from {float(human.v[0]):.1f} to "
        f"{float(human.v[valid][-1]):.1f} m/s."
    ]
    ignored = 0
    for slot in view.slots:
        if view.decision(slot) == Decision.IGNORE:
            ignored += 1
        else:
            name = spoken(view.decision(slot).name)
            words.append(f"{_place(view, slot)}: {name}.")
    words.append(f"{ignored} ignored." if ignored else "Nothing is ignored.")
    return " ".join(words)


def _place(view: View, slot: int) -> str:
    """Return kind and place of an obstacle when it is first known."""
    obstacles, at = view.rows.scene.obstacles, view.first(slot)
    s = 0.5 * float(obstacles.s_lower[slot, at] + obstacles.s_upper[slot, at])
    where = f"{abs(s):.0f} m {'ahead' if s >= 0.0 else 'behind'}"
    if view.kind(slot) not in LINE_KINDS:
        l = 0.5 * float(obstacles.l_lower[slot, at] + obstacles.l_upper[slot, at])
        aside = l - float(view.rows.scene.ego.l)
        if abs(aside) > 1.0:
            where += f", {abs(aside):.0f} m to the {'left' if aside > 0 else 'right'}"
    when = f" at {TIMES_S[at]:.1f} s" if at else ""
    return f"{KIND_WORDS[view.kind(slot)].capitalize()} {slot}, {where}{when}"


def view_of(demonstration: Demonstration, row: int) -> View:
    """Return numpy arrays of an unbatched demonstration and what to show of it.

    Args:
      demonstration: unbatched.
      row: its number in the dataset, for messages.

    Raises:
      InputError: it holds numbers that are not finite, or no valid time.
    """
    rows = jax.tree.map(np.asarray, demonstration)
    _check(rows, row)
    scene, obstacles = rows.scene, rows.scene.obstacles
    known = (obstacles.kind != Kind.NONE) & obstacles.valid.any(axis=1)
    flat = {f"obstacles.{k}": v for k, v in vars(obstacles).items()}
    flat |= {"path.l": scene.path.l, "ego.width": scene.ego.width}
    slots = np.flatnonzero(known).tolist()
    low, high = _window(rows, slots)
    return View(rows=rows, blocks=blocking(flat), slots=slots, low=low, high=high)


def _check(rows: Demonstration, row: int) -> None:
    """Refuse in one line what cannot be drawn."""
    valid, obstacles = rows.scene.time_valid, rows.scene.obstacles
    if valid.ndim != 1 or not valid.any():
        raise InputError(
            f"scene {row}: time_valid: {int(valid.sum())} valid times of shape "
            f"{valid.shape}: expected one scene with at least one"
        )
    used = {f"human.{n}": getattr(rows.human, n)[valid] for n in "slva"}
    known = obstacles.valid & (obstacles.kind != Kind.NONE)[:, None]
    for name in ("s_lower", "s_upper", "l_lower", "l_upper"):
        used[f"obstacles.{name}"] = getattr(obstacles, name)[known]
    used |= {f"path.{name}": leaf for name, leaf in vars(rows.scene.path).items()}
    for name, values in used.items():
        if not np.isfinite(values).all():
            raise InputError(f"scene {row}: {name}: not finite: expected numbers")


def _window(rows: Demonstration, slots: Sequence[int]) -> tuple[float, float]:
    """Return stations to draw: the human's way, all that mattered, what fits."""
    obstacles = rows.scene.obstacles
    first = np.argmax(obstacles.valid, axis=1)
    number = np.arange(first.size)
    rear, front = obstacles.s_lower[number, first], obstacles.s_upper[number, first]
    matters = [k for k in slots if rows.decisions[k] != Decision.IGNORE]
    end = float(rows.human.s[rows.scene.time_valid].max())
    behind = min([0.0, *(float(rear[k]) - 3.0 for k in slots)])
    low = -min(max(-behind, BEHIND_M[0]), BEHIND_M[1])
    low = min([low, *(float(rear[k]) - 3.0 for k in matters)])
    high = max([end + AHEAD_M, *(float(front[k]) + 5.0 for k in matters)])
    others = max([high, *(float(front[k]) + 5.0 for k in slots)])
    return low, max(min(others, high + SPARE_M), low + LEAST_VIEW_M)


def draw_scene(path: Path, demonstration: Demonstration, row: int) -> Path:
    """Draw one scene.

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
    """Return tags, speed, limit, bend and length of the recording."""
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


def _draw_above(axis: Axes, view: View) -> None:
    """Draw road, path, human, ego and all obstacles; station up, left is left."""
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
    """Return the offsets at the left and right edge of the view from above."""
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
    """Draw the box when first known, the trail over all known times, the number."""
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
    """Draw a stop line or the destination across the road."""
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


def _draw_graph(axis: Axes, view: View) -> None:
    """Draw the human's s(t) between the boundaries of what blocks the path."""
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
    """Draw bars at the times themselves, filled between neighbours."""
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
    """Write number and decision at the first free place along the boundary.

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


def _draw_motion(speed: Axes, acceleration: Axes, view: View) -> None:
    """Draw the human's speed beside the limit, and acceleration."""
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
    """Return lines, and one row per decision with the slots that it was made for."""
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
    """Join runs of numbers: 0, 2 to 5."""
    parts = []
    for _, group in itertools.groupby(enumerate(slots), lambda pair: pair[1] - pair[0]):
        run = [slot for _, slot in group]
        parts += [f"{run[0]} to {run[-1]}"] if len(run) > 2 else map(str, run)
    return ", ".join(parts)
