"""Pictures of one simulated drive: a PNG and a GIF.

Everything is drawn around the drive's worst moment: the first collision by the
ego's fault, else the first collision, else the smallest clearance. Step k of a
record is the moment (k + 1) * 0.1 s.
"""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon

from rcirl_jax.report.case.drive import (
    VIEW_AHEAD_M,
    VIEW_BEHIND_M,
    CaseDrive,
    on_host,
    plan_start,
    present_at,
    window,
)
from rcirl_jax.report.style import CANDIDATE, CHOSEN, CLASS_COLOURS, HUMAN, label, save
from rcirl_jax.report.style import plt as pyplot
from rcirl_jax.simulation.cases import (
    ROAD_STEP_M,
    STEP_S,
    Case,
    LineKind,
    Record,
    Snapshot,
)
from rcirl_jax.types import Kind
from rcirl_jax.units import TIMES_S

KIND_COLOURS = {
    Kind.VEHICLE: CLASS_COLOURS["follow"],
    Kind.CYCLIST: CLASS_COLOURS["overtake"],
    Kind.PEDESTRIAN: CLASS_COLOURS["virtual"],
    Kind.STATIC: CANDIDATE,
}
EGO_COLOUR = CHOSEN
STOP_COLOUR = CLASS_COLOURS["stop"]
GO_COLOUR = CLASS_COLOURS["overtake"]
NUM_INSTANTS = 5  # strips
INSTANTS_S = 6.0  # s from the first strip to the last
ST_BEFORE_S, ST_AFTER_S = 6.0, 9.0  # s, the ST graph's window around the moment
ASIDE_MARGIN_M, MAX_ASIDE_M = 3.0, 26.0  # m beyond the road; m shown at most
STRIP_INCHES = 13.0  # inches, width of a strip in the PNG
NOSE_LENGTH_M = 1.0  # m, shorter boxes have no wedge at their front
PLAN_SHOWN_S = 5.0  # s of the plan that the ST graph has room for
IN_PATH_M = 0.2  # m beyond the half widths within which a body is in the way
MAX_ACCELERATION_MPS2 = 4.0  # m/s^2, bound of the paper's table
MAX_JERK_MPS3 = 6.0  # m/s^3, bound of the paper's table
SHOWN_CLEARANCE_M = 30.0  # m, larger clearances are cut off
GIF_FPS = 5  # 1/s, real time
GIF_BEFORE_S, GIF_AFTER_S = 7.0, 3.0  # s of drive around the moment


def _box(
    axis: Axes, pose: tuple, size: tuple[float, float], colour: str, has_nose: bool
) -> None:
    """A box at (x, y, heading), with a dark wedge at its front."""
    (x, y, heading), (length, width) = pose, size
    outline = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * (length / 2, width / 2)
    nose = np.array([[1.0, 0.0], [0.3, 1.0], [0.3, -1.0]]) * (length / 2, width / 2)
    turn = np.array(
        [[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]]
    )
    parts = ((outline, colour, HUMAN), (nose, HUMAN, "none"))[: 1 + has_nose]
    for corners, fill, edge in parts:
        shape = Polygon(corners @ turn + (x, y), closed=True, facecolor=fill)
        shape.set(edgecolor=edge, linewidth=0.6, zorder=3)
        axis.add_patch(shape)


def _draw_road(axis: Axes, drive: CaseDrive, station: float, step: int) -> None:
    road, lines = drive.case.road, drive.case.lines
    s = np.arange(station - VIEW_BEHIND_M - 20.0, station + VIEW_AHEAD_M + 20.0, 1.0)

    def draw(l: np.ndarray | float, **look: Any) -> None:  # noqa: ANN401
        x, y, _ = drive.place(s, np.broadcast_to(l, s.shape), station)
        axis.plot(x, y, **look)

    for edge in (road.edge_left, road.edge_right):
        draw(float(edge), color=HUMAN, lw=1.4)
    for k in range(-int(road.lanes_right), int(road.lanes_left) + 2):
        l = (k - 0.5) * float(road.lane_width)
        if float(road.edge_right) + 0.2 < l < float(road.edge_left) - 0.2:
            draw(l, color=CANDIDATE, lw=0.8, ls=(0, (8, 6)))
    grid = np.arange(road.path_l.shape[0]) * ROAD_STEP_M
    draw(np.interp(s, grid, road.path_l), color=EGO_COLOUR, lw=0.8, ls=":")
    across = np.array([float(road.edge_right), float(road.edge_left)])
    for number in np.flatnonzero(np.asarray(lines.kind) != LineKind.NONE):
        at = float(lines.s[number])
        if s[0] < at < s[-1]:
            x, y, _ = drive.place(np.full(2, at), across, station)
            red = bool(drive.shot.line_red[step, number])
            axis.plot(x, y, color=STOP_COLOUR if red else GO_COLOUR, lw=3, zorder=2)


def _aside(drive: CaseDrive, steps: np.ndarray) -> tuple[float, float]:
    """Lowest and highest y [m] of a strip that holds the road at all these steps."""
    road, low, high = drive.case.road, 0.0, 0.0
    for station in np.asarray(drive.record.s)[steps]:
        s = station + np.arange(-VIEW_BEHIND_M, VIEW_AHEAD_M, 5.0)
        for edge in (road.edge_left, road.edge_right):
            y = drive.place(s, np.full(s.size, float(edge)), float(station))[1]
            low, high = min(low, float(y.min())), max(high, float(y.max()))
    low, high = low - ASIDE_MARGIN_M, high + ASIDE_MARGIN_M
    return max(low, -MAX_ASIDE_M), min(high, MAX_ASIDE_M)


def _draw_strip(
    axis: Axes, drive: CaseDrive, step: int, aside: tuple[float, float]
) -> None:
    """Bird's-eye view at one step; the ego's road station is at x = 0."""
    record, agents, who = drive.record, drive.shot.agents, drive.case.agents
    station = float(record.s[step])
    _draw_road(axis, drive, station, step)
    s, l = np.asarray(agents.s[step]), np.asarray(agents.l[step])
    x, y, line = drive.place(s, l, station)
    heading = line + agents.heading[step]
    for a in np.flatnonzero(present_at(drive, step)):
        size = (float(who.length[a]), float(who.width[a]))
        colour = KIND_COLOURS.get(Kind(int(who.kind[a])), CANDIDATE)
        nose = int(who.kind[a]) != Kind.STATIC and size[0] > NOSE_LENGTH_M
        if abs(x[a]) < 2.0 * VIEW_AHEAD_M:
            _box(axis, (x[a], y[a], heading[a]), size, colour, nose)
    own = (float(drive.case.ego_length), float(drive.case.ego_width))
    pose = (0.0, float(record.l[step]), float(record.heading[step]))
    _box(axis, pose, own, EGO_COLOUR, True)
    axis.set_xlim(-VIEW_BEHIND_M, VIEW_AHEAD_M)
    axis.set_ylim(*aside)
    axis.set_aspect("equal")
    axis.grid(False)
    clearance = float(record.clearance[step])
    gap = f"{clearance:.1f} m" if np.isfinite(clearance) else "nobody near"
    words = f"t = {drive.time(step):.1f} s   speed {float(record.v[step]):.1f} m/s   "
    words += f"clearance {gap}"
    if step == drive.worst:
        crash = drive.record.collision[step] > 0
        words += "   << " + ("collision" if crash else "worst moment")
    label(axis, words, "", "m")


def _bands(axis: Axes, drive: CaseDrive, steps: np.ndarray) -> None:
    """Agents in the ego's path, by station over time."""
    case, agents, who = drive.case, drive.shot.agents, drive.case.agents
    grid = np.arange(case.road.path_l.shape[0]) * ROAD_STEP_M
    time = (steps + 1) * STEP_S
    present = np.stack([present_at(drive, int(step)) for step in steps])
    for a in np.flatnonzero(present.any(axis=0)):
        s, l, heading = (
            np.asarray(v)[steps, a] for v in (agents.s, agents.l, agents.heading)
        )
        cosine, sine = np.abs(np.cos(heading)), np.abs(np.sin(heading))
        length, width = float(who.length[a]), float(who.width[a])
        half_s = 0.5 * (length * cosine + width * sine)
        half_l = 0.5 * (length * sine + width * cosine)
        apart = np.abs(l - np.interp(s, grid, case.road.path_l)) - half_l
        shown = present[:, a] & (apart - 0.5 * float(case.ego_width) < IN_PATH_M)
        axis.fill_between(
            time,
            s - half_s,
            s + half_s,
            where=shown,
            color=KIND_COLOURS.get(Kind(int(who.kind[a])), CANDIDATE),
            alpha=0.45,
            linewidth=1.5,
        )


def _draw_st(axis: Axes, drive: CaseDrive) -> None:
    """Station-time graph around the moment."""
    first, last = window(drive, ST_BEFORE_S, ST_AFTER_S)
    steps = np.arange(first, last + 1)
    time, s = (steps + 1) * STEP_S, np.asarray(drive.record.s)[steps]
    _bands(axis, drive, steps)
    lines = drive.case.lines
    for number in np.flatnonzero(np.asarray(lines.kind) != LineKind.NONE):
        red = np.asarray(drive.shot.line_red[steps, number], bool)
        for shown, colour in ((red, STOP_COLOUR), (~red, GO_COLOUR)):
            level = np.where(shown, float(lines.s[number]), np.nan)
            axis.plot(time, level, color=colour, lw=2.5)
    begin = plan_start(drive.record, drive.shot, drive.worst)
    plan = np.asarray(drive.shot.plan_s[drive.worst])
    axis.plot(begin + TIMES_S, plan, "--", color=HUMAN, lw=1.5)
    axis.plot(time, s, color=EGO_COLOUR, lw=2.2)
    axis.axvline(drive.time(drive.worst), color=HUMAN, lw=0.8, ls=":")
    end = max(float(time[-1]), drive.time(drive.worst) + PLAN_SHOWN_S)
    top = max(float(s.max()), float(np.interp(end, begin + TIMES_S, plan)))
    axis.set_ylim(float(s.min()) - 10.0, top + 20.0)
    axis.set_xlim(float(time[0]) - STEP_S, end)
    label(axis, "station-time graph", "t, s", "station, m")


def _draw_series(axes: list[Axes], drive: CaseDrive) -> None:
    """Speed, acceleration, jerk and clearance over the whole drive."""
    record, time = drive.record, (np.arange(drive.last + 1) + 1) * STEP_S
    cut = lambda leaf: np.asarray(leaf)[: drive.last + 1]  # noqa: E731
    v, a = cut(record.v), cut(record.a)
    jerk = np.append(np.nan, np.diff(a) / STEP_S)
    clearance = np.where(cut(record.clearance) <= SHOWN_CLEARANCE_M, 1.0, np.nan)
    clearance = clearance * np.where(np.isfinite(clearance), cut(record.clearance), 0.0)
    panels = (
        (v, "speed (grey: limit)", "m/s", None),
        (a, "acceleration", "m/s²", MAX_ACCELERATION_MPS2),
        (jerk, "jerk along the road", "m/s³", MAX_JERK_MPS3),
        (clearance, f"clearance below {SHOWN_CLEARANCE_M:.0f} m", "m", None),
    )
    for axis, (values, title, unit, bound) in zip(axes, panels, strict=True):
        axis.plot(time, values, color=EGO_COLOUR, lw=1.2)
        if bound is not None:
            for level in (-bound, bound):
                axis.axhline(level, color=STOP_COLOUR, lw=0.8, ls=":")
        axis.axvline(drive.time(drive.worst), color=HUMAN, lw=0.8, ls=":")
        axis.set_xlim(0.0, 1.03 * float(time[-1]))
        label(axis, title, "t, s", unit)
    axes[0].plot(time, cut(record.speed_limit), color=CANDIDATE, lw=1.2)
    axes[0].set_ylim(0.0, 1.1 * float(max(v.max(), cut(record.speed_limit).max())))
    axes[3].axhline(0.0, color=STOP_COLOUR, lw=0.8, ls=":")
    axes[3].set_ylim(min(-0.5, float(np.nanmin(np.append(clearance, 0.0)))), None)


def _legend(drive: CaseDrive) -> list[Patch | Line2D]:
    kinds = {int(k) for k in np.asarray(drive.case.agents.kind)}
    rows: list[Patch | Line2D] = [Patch(color=EGO_COLOUR, label="ego")]
    rows += [
        Patch(color=colour, label=kind.name.lower())
        for kind, colour in KIND_COLOURS.items()
        if int(kind) in kinds
    ]
    rows.append(Line2D([], [], color=EGO_COLOUR, ls=":", label="given path"))
    rows.append(Line2D([], [], color=HUMAN, ls="--", label="plan at the worst moment"))
    if np.any(np.asarray(drive.case.lines.kind) != LineKind.NONE):
        rows.append(Line2D([], [], color=STOP_COLOUR, lw=3, label="line: stop"))
        rows.append(Line2D([], [], color=GO_COLOUR, lw=3, label="line: open"))
    rows.append(Line2D([], [], color=STOP_COLOUR, ls=":", label="bound"))
    return rows


def _inches(low: float, high: float, width: float) -> float:
    """Height of a strip from y = low to high [m] that is `width` inches wide."""
    return width * (high - low) / (VIEW_BEHIND_M + VIEW_AHEAD_M)


def draw_case(
    case: Case, record: Record, snapshot: Snapshot, path: Path, title: str
) -> Path:
    """PNG of one drive: five strips, the ST graph, four signals over time.

    Args:
      case: one unbatched case.
      record: its record, leaves [S].
      snapshot: its snapshots (`RolloutConfig.snapshots`), leaves [S, ...].
      path: PNG to write.
      title: heading of the picture.

    Raises:
      InputError: the record holds no valid step, or several drives.
    """
    drive = on_host(path, case, record, snapshot)
    first, last = window(drive, INSTANTS_S / 2.0, INSTANTS_S / 2.0)
    steps = np.round(np.linspace(first, last, NUM_INSTANTS)).astype(int)
    steps[np.argmin(np.abs(steps - drive.worst))] = drive.worst
    aside = [_aside(drive, np.array([step])) for step in steps]
    strips = [_inches(low, high, STRIP_INCHES) + 0.5 for low, high in aside]
    made = pyplot.figure(figsize=(STRIP_INCHES + 1.0, sum(strips) + 6.8))
    made.set_layout_engine("constrained")
    made.suptitle(title, fontsize=12, x=0.01, ha="left")
    grid = made.add_gridspec(NUM_INSTANTS + 2, 4, height_ratios=[*strips, 2.9, 2.9])
    for row, step in enumerate(steps):
        _draw_strip(made.add_subplot(grid[row, :]), drive, int(step), aside[row])
    made.axes[-1].set_xlabel("m ahead of the ego, along its road's tangent", fontsize=9)
    lower = [made.add_subplot(grid[NUM_INSTANTS:, :2])]
    for row in (NUM_INSTANTS, NUM_INSTANTS + 1):
        lower += [made.add_subplot(grid[row, column]) for column in (2, 3)]
    for axis in lower:
        axis.grid(True, linewidth=0.4, alpha=0.5)
    for axis in made.axes:
        axis.spines[["top", "right"]].set_visible(False)
    _draw_st(lower[0], drive)
    _draw_series(lower[1:], drive)
    rows = _legend(drive)
    ncols = -(-len(rows) // 2)
    made.legend(handles=rows, loc="outside lower center", ncols=ncols, fontsize=9)
    return save(made, path)


def animate_case(
    case: Case, record: Record, snapshot: Snapshot, path: Path, title: str
) -> Path:
    """GIF of at most 10 s of the drive around its worst moment, in real time.

    Args: as `draw_case`; `path` is the GIF to write.
    """
    drive = on_host(path, case, record, snapshot)
    first, last = window(drive, GIF_BEFORE_S, GIF_AFTER_S)
    stride = int(round(1.0 / (GIF_FPS * STEP_S)))
    # the worst moment is one of the frames
    steps = np.arange(first + (drive.worst - first) % stride, last + 1, stride)
    aside = _aside(drive, steps)
    strip = _inches(*aside, 8.8)
    height = strip + 1.1
    made = pyplot.figure(figsize=(9.5, height), dpi=80)
    axis = made.add_axes((0.06, 0.45 / height, 8.8 / 9.5, strip / height))
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = PillowWriter(fps=GIF_FPS)
    made.suptitle(title, fontsize=10, x=0.01, ha="left")
    with writer.saving(made, str(path), dpi=80):
        for step in steps:
            axis.clear()
            _draw_strip(axis, drive, int(step), aside)
            axis.set_xlabel("m ahead of the ego", fontsize=9)
            writer.grab_frame()
    pyplot.close(made)
    return path
