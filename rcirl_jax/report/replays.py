"""Named cases driven again by several rows, thinned for a player in a web page.

A frame holds the ego, the agents near it, its plan and the stop lines that demand
a stop; the last one is the end of the drive. Numbers are rounded to what a screen can
show: a drive of 120 s takes about 100 kB of JSON.
"""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np
import tqdm
from numpy.typing import ArrayLike

from rcirl_jax.errors import InputError
from rcirl_jax.simulation.cases import (
    ROAD_STEP_M,
    STEP_S,
    Case,
    LineKind,
    Record,
    Snapshot,
)
from rcirl_jax.simulation.metrics import CaseMetrics
from rcirl_jax.simulation.rows import RECORDED_HUMAN, Row, human_row
from rcirl_jax.simulation.suite import CaseSet, drive_with_logs, rollout_config
from rcirl_jax.types import Kind
from rcirl_jax.units import TIMES_S

MAX_CASES = 6  # cases of a page
FRAME_STEPS = 2  # simulator steps between two frames: 5 Hz
BEHIND_M, AHEAD_M = 45.0, 110.0  # m of road around the ego in which agents are kept
APART_M, APART_MPS = 2.0, 1.0  # m, m/s at which two drives have parted
# a column of the table that does not hold, in words
BROKEN = (
    "at-fault collision",
    "above the speed limit",
    "|acceleration| above 4 m/s²",
    "|lateral acceleration| above 4 m/s²",
    "|jerk| above 6 m/s³",
    "|lateral jerk| above 6 m/s³",
)
PLAN_AHEAD_S = np.arange(1.0, 6.0)  # s ahead of the frame at which the plan is kept


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReplayedDrive:
    """One row's drive of a case, [I] frames; JSON-ready."""

    row: str
    summary: str
    # (s, what happened), in order of time; the moment to look at first is one
    events: list[tuple[float, str]]
    start: float  # s, the moment to look at first
    end: str  # what ended the drive before its time, or ""
    t: list[float]  # [I] s
    s: list[float]  # [I] m, station
    l: list[float]  # [I] m
    heading: list[float]  # [I] rad, against the reference line
    v: list[float]  # [I] m/s
    a: list[float]  # [I] m/s^2
    clearance: list[float | None]  # [I] m; None: nobody near
    # [I] stations of the plan in force, m beyond s, at PLAN_AHEAD_S
    plan: list[list[float]]
    red: list[list[int]]  # [I] numbers of the lines that demand a stop
    # [I] flat quadruples: slot, s, l, heading
    agents: list[list[float]]
    # m, offset of the path that it planned itself, on the road's grid; empty: the given
    path_l: list[float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Replay:
    """One case driven by every row; JSON-ready by `dataclasses.asdict`."""

    case: str
    group: str
    parameters: dict[str, float]
    frame_s: float  # s between frames, but the last two
    # s, when the first two drives part
    apart: float | None
    road_step: float  # m between the points of the road
    x: list[float]  # [R] m, reference line
    y: list[float]  # [R] m
    turn: list[float]  # [R] rad, its heading
    path_l: list[float]  # [R] m, offset of the path given to the ego
    edges: tuple[float, float]  # m, offsets of the road's edges, left and right
    marks: list[float]  # m, offsets of the lane marks
    lines: list[float]  # m, stations of the stop lines
    ego: tuple[float, float]  # m, length and width
    # slot -> (kind, length, width) of whoever is met
    bodies: dict[int, tuple[str, float, float]]
    drives: tuple[ReplayedDrive, ...]


def make_replays(
    rows: Sequence[Row], cases: CaseSet, ids: Sequence[str], plan_every: int
) -> list[Replay]:
    """ReplayedDrive the named cases with every row, and with the recorded human if any.

    On a CPU the drives are those of the suite (`drive_with_logs`); elsewhere they
    differ in the last digit, and traffic is chaotic: then a replay's numbers are its
    own.

    Args:
      rows: who drives; names differ.
      cases: the suite.
      ids: cases of it; the first `MAX_CASES` are driven.
      plan_every: steps of 0.1 s between two plans.

    Raises:
      InputError: a case that the suite does not have.
    """
    ids = list(dict.fromkeys(ids))[:MAX_CASES]
    for name in ids:
        if name not in cases.ids:
            raise InputError(f"replays: case: {name}: expected a case of the suite")
    if not ids:
        return []
    places = [cases.ids.index(name) for name in ids]
    built = [cases.build(place, place + 1) for place in places]
    every = jax.tree.map(lambda *x: np.concatenate(x), *built)
    if every.replay is None:
        rows = [row for row in rows if not row.follow_log]
    elif not any(row.follow_log for row in rows):
        rows = [*rows, human_row()]
    drives: list[list[ReplayedDrive]] = [[] for _ in ids]
    for row in tqdm.tqdm(rows, desc="drive cases to be played", unit="row"):
        config = rollout_config(row, cases.duration_s, plan_every)
        driven = (every, *drive_with_logs(row, every, config))
        for number in range(len(ids)):
            one = jax.tree.map(lambda x, at=number: np.asarray(x[at]), driven)
            drives[number].append(thin(row.name, *one))
    return [
        _replay(name, cases, place, jax.tree.map(lambda x: x[0], one), tuple(found))
        for name, place, one, found in zip(ids, places, built, drives, strict=True)
    ]


def thin(
    row: str, case: Case, metrics: CaseMetrics, record: Record, shot: Snapshot
) -> ReplayedDrive:
    """Thin one drive to frames; unbatched numpy leaves, record and snapshots [S]."""
    last = int(np.flatnonzero(record.valid)[-1])
    steps = np.arange(FRAME_STEPS - 1, last + FRAME_STEPS, FRAME_STEPS)
    steps = np.minimum(steps, last)  # the end is a frame
    events, start = _events(case, record, last)
    short = (last + 1) * STEP_S < float(case.steps) * STEP_S - 1e-6
    red = np.asarray(shot.line_red, bool) & (case.lines.kind != LineKind.NONE)
    gap = float(metrics.min_clearance)
    near = f"closest {max(gap, 0.0):.1f} m" if np.isfinite(gap) else "nobody near"
    broken = _broken_words(metrics)
    plans: list[list[float]] = []  # while they last
    for step in () if row == RECORDED_HUMAN else steps:
        now = (step + 1) * STEP_S
        ahead = now + PLAN_AHEAD_S - plan_start(record, shot, int(step))
        ahead = ahead[ahead <= TIMES_S[-1]]
        stations = np.interp(ahead, TIMES_S, shot.plan_s[step])
        plans.append(_rounded(stations - record.s[step], 1))
    return ReplayedDrive(
        row=row,
        summary=f"{float(metrics.progress):.0f} m driven, {near}, {broken}",
        events=events,
        start=start,
        end="ended by an at-fault collision" if short else "",
        t=_rounded((steps + 1) * STEP_S, 1),
        s=_rounded(record.s[steps], 1),
        l=_rounded(record.l[steps], 2),
        heading=_rounded(record.heading[steps], 3),
        v=_rounded(record.v[steps], 1),
        a=_rounded(record.a[steps], 1),
        clearance=[
            round(float(x), 1) if np.isfinite(x) else None
            for x in record.clearance[steps]
        ],
        plan=plans or [[] for _ in steps],
        red=[np.flatnonzero(red[step]).tolist() for step in steps],
        agents=[_agents(case, record, shot, int(step)) for step in steps],
        path_l=_own_path(record, shot, last),
    )


def _own_path(record: Record, shot: Snapshot, last: int) -> list[float]:
    """Offsets m of a drive's own path on the road's grid; [] if the path was given.

    What was driven up to the step `last`, then what was planned in it.
    """
    if shot.plan_l is None:
        return []
    s = np.append(record.s[: last + 1], shot.plan_s[last, 1:])
    l = np.append(record.l[: last + 1], shot.plan_l[last, 1:])
    return _rounded(np.interp(np.arange(0.0, s.max(), ROAD_STEP_M), s, l), 2)


def _rounded(values: ArrayLike, digits: int) -> list[float]:
    return np.round(np.asarray(values, np.float64), digits).tolist()


def _agents(case: Case, record: Record, shot: Snapshot, step: int) -> list[float]:
    """Return who is there, once more whom the ego has hit since the last frame."""
    agents = shot.agents
    before = max(step - FRAME_STEPS, 0)
    present = np.asarray(agents.present[step], bool)
    if np.any(record.collision[before + 1 : step + 1] > 0):
        hit = np.asarray(agents.gone[step], bool) & agents.present[before]
        present = present | hit
    ahead = np.asarray(agents.s[step]) - float(record.s[step])
    near = (ahead > -BEHIND_M) & (ahead < AHEAD_M)
    found: list[float] = []
    for slot in np.flatnonzero(present & near & (case.agents.kind != Kind.NONE)):
        found += [
            int(slot),
            round(float(agents.s[step, slot]), 1),
            round(float(agents.l[step, slot]), 2),
            round(float(agents.heading[step, slot]), 2),
        ]
    return found


def _events(
    case: Case, record: Record, last: int
) -> tuple[list[tuple[float, str]], float]:
    """Return what happened and when, and the moment to look at first."""
    time = lambda step: round((int(step) + 1) * STEP_S, 1)  # noqa: E731
    found = []
    for name, happens in (
        ("at-fault collision", record.at_fault > 0),
        ("collision", (record.collision > 0) & (record.at_fault == 0)),
        ("red light run", record.red_light),
        ("stop sign run", record.stop_sign),
    ):
        steps = np.flatnonzero(np.asarray(happens, bool)[: last + 1])
        found += [(time(step), name) for step in steps]
    worst = min(worst_step(record), last)
    if found:
        start = min(found)[0]
    else:
        gap = float(record.clearance[worst])
        what = (
            f"closest, {max(gap, 0.0):.1f} m" if np.isfinite(gap) else "hardest braking"
        )
        start = time(worst)
        found.append((start, what))
    return sorted(found), start


def worst_step(record: Record) -> int:
    """Return the step to look at: an at-fault crash, a crash, the least clearance.

    Without anybody near it is the hardest braking.
    """
    valid = np.asarray(record.valid, bool)
    for hits in (record.at_fault, record.collision):
        found = np.flatnonzero(valid & (np.asarray(hits) > 0))
        if found.size:
            return int(found[0])
    clearance = np.where(valid, np.asarray(record.clearance), np.inf)
    if np.isfinite(clearance).any():
        return int(np.argmin(clearance))
    return int(np.argmin(np.where(valid, np.asarray(record.a), np.inf)))


def plan_start(record: Record, snapshot: Snapshot, step: int) -> float:
    """Return the time [s] at which the plan in force at a step was made.

    A held plan repeats; it begins where the ego was when it was made.
    """
    plans, s = np.asarray(snapshot.plan_s), np.append(0.0, np.asarray(record.s))
    k = step
    while k > 0 and abs(s[k] - plans[step, 0]) > 1e-3:
        if not np.array_equal(plans[k - 1], plans[step]):
            break
        k -= 1
    return k * STEP_S


def broken_bounds(found: CaseMetrics) -> list[str]:
    """Return what a drive breaks, in words; leaves are scalars, or [6] per column."""
    broken = [
        words
        for words, holds in zip(BROKEN, found.holds, strict=True)
        if not holds and not (found.at_fault > 0 and words != BROKEN[0])
    ]
    lines = {"red light run": found.red_lights, "stop sign run": found.stop_signs}
    return broken + [words for words, count in lines.items() if count > 0]


def _broken_words(found: CaseMetrics) -> str:
    return ", ".join(broken_bounds(found)) or "all bounds hold, no line run"


def goes_as(drive: ReplayedDrive, found: CaseMetrics) -> bool:
    """Return whether a drive breaks the bounds that `found` breaks."""
    return drive.summary.endswith(f", {_broken_words(found)}")


def _apart(drives: Sequence[ReplayedDrive]) -> float | None:
    """Return when the first two drives are `APART_M` or `APART_MPS` apart."""
    if len(drives) < 2:
        return None
    one, two = drives[:2]
    count = min(len(one.s), len(two.s))
    far = np.abs(np.subtract(one.s[:count], two.s[:count])) > APART_M
    far |= np.abs(np.subtract(one.v[:count], two.v[:count])) > APART_MPS
    if far.any():
        return one.t[int(np.argmax(far))]
    return None if len(one.s) == len(two.s) else one.t[count - 1]


def _replay(
    name: str, cases: CaseSet, place: int, case: Case, drives: tuple[ReplayedDrive, ...]
) -> Replay:
    """Return a case and its road up to where the drives have looked."""
    road = case.road
    reach = max(max(drive.s) for drive in drives) + AHEAD_M
    count = min(int(reach / ROAD_STEP_M) + 2, len(road.kappa))
    x, y, turn = road_in_plane(np.asarray(road.kappa))
    edges = float(road.edge_left), float(road.edge_right)
    lanes = range(-int(road.lanes_right), int(road.lanes_left) + 2)
    marks = [(lane - 0.5) * float(road.lane_width) for lane in lanes]
    met = {int(a) for drive in drives for frame in drive.agents for a in frame[::4]}
    who, lines = case.agents, case.lines
    return Replay(
        case=name,
        group=cases.groups[place],
        parameters={k: round(float(v), 3) for k, v in cases.parameters[place].items()},
        frame_s=FRAME_STEPS * STEP_S,
        apart=_apart(drives),
        road_step=ROAD_STEP_M,
        x=_rounded(x[:count], 2),
        y=_rounded(y[:count], 2),
        turn=_rounded(turn[:count], 4),
        path_l=_rounded(road.path_l[:count], 2),
        edges=(round(edges[0], 2), round(edges[1], 2)),
        marks=[round(l, 2) for l in marks if edges[1] + 0.2 < l < edges[0] - 0.2],
        lines=_rounded(np.where(lines.kind != LineKind.NONE, lines.s, -1e4), 1),
        ego=(round(float(case.ego_length), 2), round(float(case.ego_width), 2)),
        bodies={
            slot: (
                Kind(int(who.kind[slot])).name.lower(),
                round(float(who.length[slot]), 2),
                round(float(who.width[slot]), 2),
            )
            for slot in sorted(met)
        },
        drives=drives,
    )


def road_in_plane(kappa: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (x, y, heading) [R] of the reference line from its curvature [R] 1/m.

    heading' = kappa, x' = cos(heading), y' = sin(heading); trapezoids on the
    ROAD_STEP_M grid, chords at the mean heading.
    """
    kappa = np.asarray(kappa, np.float64)
    turn = 0.5 * (kappa[1:] + kappa[:-1]) * ROAD_STEP_M
    heading = np.append(0.0, np.cumsum(turn))
    chord = ROAD_STEP_M * np.sinc(0.5 * turn / np.pi)
    middle = heading[:-1] + 0.5 * turn
    x = np.append(0.0, np.cumsum(chord * np.cos(middle)))
    return x, np.append(0.0, np.cumsum(chord * np.sin(middle))), heading
