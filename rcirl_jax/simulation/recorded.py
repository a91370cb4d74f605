"""Recorded drives as cases: the ego follows a human's path among the logged others.

Every suitable vehicle track of a `Recording` becomes one `Case` with a replay.
Positions are smoothed as for training data (`data.smoothing`), projected into
the frame of the lanes that the driver follows (`data.lanes`) and read on the
simulator's 0.1 s clock, linearly between samples. Station 0 is the ego's centre
at its first time on a lane. What is not suitable is counted by reason.
"""

import collections
import dataclasses
import zlib
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.data.collect import Collector
from rcirl_jax.data.config import CollectConfig
from rcirl_jax.data.filters import MAX_ACCELERATION_MPS2, OFF_ROAD_M, follows_ghost
from rcirl_jax.data.lanes import LaneFrame, LaneGraph, project
from rcirl_jax.data.lines import signal_state
from rcirl_jax.data.motion import MIN_PATH_ADVANCE_M, FrameTracks, Motion
from rcirl_jax.data.smoothing import SmoothTrack, savgol
from rcirl_jax.errors import InputError
from rcirl_jax.geometry.boxes import Box, overlaps
from rcirl_jax.simulation.cases import (
    NUM_AGENTS,
    NUM_LINES,
    NUM_MOVES,
    NUM_PHASES,
    NUM_ROAD,
    ROAD_STEP_M,
    STEP_S,
    Agents,
    Case,
    Driver,
    LineKind,
    Lines,
    Perception,
    Replay,
    Road,
    Script,
)
from rcirl_jax.types import Kind, Recording

REASONS = {
    "too_short": "less than the minimum duration on the mapped lanes",
    "off_map": "the car is never on a lane",
    "standing": "the car gets less far than the minimum progress",
    "too_noisy": "accelerations no car can do remain after smoothing",
    "overlapping_boxes": "the human's box overlaps another's in the log",
    "follows_missing_car": "the leader is missing from the file",
    "irregular_light": "a light on the way has no cycle",
}
SIDE_WEIGHT = 4.0  # 1, how much more a metre aside counts (data.collect)
SIDE_VIEW_M = 40.0  # m, nobody farther aside of the line is present
MIN_SHRINK = 0.2  # 1, 1 - kappa l below which a projection means nothing
EDGE_MARGIN_M = 0.3  # m between the human's box and the drivable area's edge
DESTINATION_ASIDE_M = 20.0  # m, a destination farther aside is on another road
ROUND_STEPS = 50  # steps; tables end at whole 5 s, so that plan_every divides
KEEPS_LANE = 0.17  # sin of 10 degrees; who heads so keeps a lane (agents.LANE_TILT)
PATH_WINDOW_M = 14.0  # m, Savitzky-Golay window by station on the given path
BODY = ("s", "l", "heading", "v", "present", "x", "y", "yaw")  # of a motion table

_T = TypeVar("_T")


def _node(kind: type[_T], /, **leaves: Any) -> _T:  # noqa: ANN401
    """A pytree node of numpy leaves."""
    return kind(**leaves)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordedConfig:
    """How drives are cut out; the drivers are the medians of the IDM population."""

    smoothing_s: float = 4.1  # s, Savitzky-Golay window on positions; 0: none
    min_duration_s: float = 6.0  # s, shorter drives are left out
    max_duration_s: float = 120.0  # s, longer drives are cut
    # steps of the replay tables; None: the longest drive, rounded up to 5 s
    steps: int | None = None
    min_progress_m: float = 10.0  # m, a human who stands shows nothing
    max_cases: int | None = None  # at most so many cases, in the order found
    drop_overlaps: bool = True  # leave out drives that touch another in the log
    turns_reactive: bool = True  # agents may leave the log for the IDM (Replay)
    # 1, desired speed = max(fastest recorded, this share of the speed limit)
    limit_share: float = 0.8
    headway: float = 1.4  # s, T
    standstill: float = 2.0  # m, s0
    acceleration: float = 1.4  # m/s^2, a
    braking: float = 2.0  # m/s^2, b
    delay: float = 0.4  # s, reaction delay

    def __post_init__(self) -> None:
        """Reject what cannot be meant."""
        if not 0.0 < self.min_duration_s <= self.max_duration_s:
            raise InputError(
                f"--min_duration_s: {self.min_duration_s}: expected more than 0 and "
                f"at most {self.max_duration_s}"
            )
        for name in ("steps", "max_cases"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InputError(f"--{name}: {value}: expected at least 1")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Drive:
    """One recorded drive: its case, and where it lies in the recording."""

    id: str  # "RECORDING:TRACK"
    case: Case  # numpy leaves; replay tables as long as the drive, [steps + 1]
    frame: LaneFrame  # the case's reference line is `frame.line`
    origin: float  # m, station of the case's s = 0 on that line
    start_s: float  # s, recording time of step 0
    tracks: tuple[int, ...]  # track number of each agent slot in use


def recorded_cases(
    recordings: Iterable[Recording],
    config: RecordedConfig,
    dropped: collections.Counter[str] | None = None,
) -> tuple[Case, tuple[str, ...]]:
    """Every suitable recorded drive as a case.

    Args:
      recordings: from `data.importers.read_recordings`.
      config: how drives are cut.
      dropped: counts what was left out, by `REASONS`.

    Returns:
      (cases, ids): leaves with a leading [B]; ids "RECORDING:TRACK".

    Raises:
      InputError: no drive is suitable.
    """
    count = collections.Counter() if dropped is None else dropped
    found: list[Drive] = []
    for recording in recordings:
        for drive in drives(recording, config, count):
            found.append(drive)
            if len(found) == config.max_cases:
                break
        if len(found) == config.max_cases:
            break
    if not found:
        raise InputError(
            f"recordings: suitable drives: 0, left out {dict(count)}: "
            "expected at least one"
        )
    longest = max(int(drive.case.steps) for drive in found)
    steps = config.steps or -(-longest // ROUND_STEPS) * ROUND_STEPS
    cases = [_padded(drive.case, steps) for drive in found]
    stacked = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *cases)
    return stacked, tuple(drive.id for drive in found)


def drives(
    recording: Recording,
    config: RecordedConfig,
    dropped: collections.Counter[str] | None = None,
) -> Iterator[Drive]:
    """The suitable drives of one recording, one per human-driven vehicle."""
    cutter = _Cutter(recording, config)
    for number, track in enumerate(recording.tracks):
        if track.kind != Kind.VEHICLE:
            continue
        drive = cutter.drive(number)
        if not isinstance(drive, str):
            yield drive
        elif dropped is not None:
            dropped[drive] += 1


def _padded(case: Case, steps: int) -> Case:
    """Replay tables of length `steps + 1`; nobody is present in the padding.

    There the human goes on at the last speed and offset: no step holds a jump.
    """
    assert case.replay is not None
    last = min(int(case.steps), steps)
    index = np.arange(steps + 1)
    beyond = np.maximum(index - last, 0) * STEP_S
    cut = lambda x: np.asarray(x)[..., np.minimum(index, last)] if np.ndim(x) else x  # noqa: E731
    replay = jax.tree.map(cut, case.replay)
    replay = replay.replace(
        present=replay.present & (beyond == 0.0),
        ego_s=(replay.ego_s + replay.ego_v * beyond).astype(np.float32),
    )
    return case.replace(replay=replay, steps=np.int32(last))


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Way:
    """Which track is driven, in which frame, at which times."""

    number: int  # of the track
    lane_id: str  # lane at the start
    frame: LaneFrame
    view: FrameTracks  # all tracks in the frame
    at: np.ndarray  # [n] positions in the track's samples, every 0.1 s
    clock: np.ndarray  # [n] the same in the recording's frames


class _Cutter:
    """Cuts one recording into drives."""

    def __init__(self, recording: Recording, config: RecordedConfig) -> None:
        self.recording, self.config = recording, config
        self.rate = recording.rate_hz
        settings = CollectConfig(smoothing_s=config.smoothing_s)
        self.collector = Collector(recording, settings)
        self.tracks = self.collector.tracks
        self.speeds = [_speed(track) * self.rate for track in self.tracks]

    def drive(self, number: int) -> Drive | str:
        """The drive of one track, or the reason why there is none."""
        way = self._way(number)
        return way if isinstance(way, str) else self._build(way)

    def _way(self, number: int) -> _Way | str:
        config, smooth = self.config, self.tracks[number]
        graph = self.collector.graph
        lanes = graph.match(smooth.x, smooth.y, smooth.heading)
        on = np.flatnonzero(lanes != "")
        if on.size == 0:
            return "off_map"
        first, visited = int(on[0]), [str(name) for name in dict.fromkeys(lanes[on])]
        frame = graph.frame(_long_chain(graph, visited, smooth.x, smooth.y))
        view = self.collector.view(frame)
        s, l = view.s[number][first:], view.l[number][first:]
        count = _steps_inside(frame, s, l)
        seconds = min(count / self.rate, config.max_duration_s)
        if seconds < config.min_duration_s - 1e-6:
            return "too_short"
        if s[count] - s[0] < config.min_progress_m:
            return "standing"
        at = first + np.arange(int(seconds / STEP_S + 1e-6) + 1) * STEP_S * self.rate
        return _Way(
            number=number,
            lane_id=visited[0],
            frame=frame,
            view=view,
            at=at,
            clock=at + smooth.first_frame,
        )

    def _build(self, way: _Way) -> Drive | str:
        track, config = self.recording.tracks[way.number], self.config
        own = self._table(way, way.number)
        # the filter dips back before a start from standstill: there the car stands
        forward = np.maximum.accumulate(own["s"])
        own["v"] = np.where(forward > own["s"], 0.0, own["v"])
        own["s"] = forward
        if np.abs(np.diff(own["v"])).max() > MAX_ACCELERATION_MPS2 * STEP_S:
            return "too_noisy"
        chosen, tables = self._others(way, own)
        if config.drop_overlaps and _touches(track.length, track.width, own, tables):
            return "overlapping_boxes"
        if self._follows_missing(way, own, tables):
            return "follows_missing_car"
        lines = self._lines(way, float(own["s"][0]), 0.5 * track.length)
        if lines is None:
            return "irregular_light"
        origin = float(own["s"][0])
        limit = way.frame.table("speed_limit", tables["s"]) * config.limit_share
        tables["s"] = tables["s"] - origin
        name, single = f"{self.recording.name}:{track.id}", np.float32
        case = _node(
            Case,
            seed=np.uint32(zlib.crc32(name.encode())),
            steps=np.int32(way.at.size - 1),
            ego_v=single(own["v"][0]),
            ego_length=single(track.length),
            ego_width=single(track.width),
            road=self._road(way, own),
            lines=lines,
            agents=_agents(tables, limit, config),
            perception=_node(
                Perception,
                sigma_position=single(0),
                sigma_speed=single(0),
                latency=single(0),
                dropout=single(0),
            ),
            replay=_node(
                Replay,
                **{key: tables[key].astype(single) for key in BODY[:4]},
                present=tables["present"],
                ego_s=(own["s"] - origin).astype(single),
                ego_l=own["l"].astype(single),
                ego_v=own["v"].astype(single),
                turns_reactive=np.bool_(config.turns_reactive),
            ),
        )
        return Drive(
            id=name,
            case=case,
            frame=way.frame,
            origin=origin,
            start_s=float(way.clock[0] / self.rate),
            tracks=chosen,
        )

    def _table(self, way: _Way, number: int) -> dict[str, np.ndarray]:
        """One track's `BODY` at the way's times; stations are the frame's."""
        smooth, frame = self.tracks[number], way.frame
        at, index = way.clock - smooth.first_frame, np.arange(smooth.num_frames)
        read = lambda values: np.interp(at, index, values)  # noqa: E731
        s, l = read(way.view.s[number]), read(way.view.l[number])
        tilt = read(np.unwrap(way.view.tilt[number]))
        known = (at >= -1e-6) & (at <= smooth.num_frames - 1 + 1e-6)
        shrink = 1.0 - frame.on_grid("kappa", s) * l
        return {
            "s": s,
            "l": l,
            "heading": (tilt + np.pi) % (2.0 * np.pi) - np.pi,
            "v": read(self.speeds[number]),
            "present": known & (np.abs(l) < SIDE_VIEW_M) & (shrink > MIN_SHRINK),
            "x": read(smooth.x),
            "y": read(smooth.y),
            "yaw": read(smooth.heading),
        }

    def _others(self, way: _Way, own: dict) -> tuple[tuple[int, ...], dict]:
        """Track numbers of the nearest agents over the run, and tables [A, n]."""
        found = []
        for other, smooth in enumerate(self.tracks):
            end = smooth.first_frame + smooth.num_frames - 1
            away = smooth.first_frame > way.clock[-1] or end < way.clock[0]
            if other == way.number or away:
                continue
            table = self._table(way, other)
            apart = np.abs(table["s"] - own["s"])
            apart = apart + SIDE_WEIGHT * np.abs(table["l"] - own["l"])
            nearest = np.min(np.where(table["present"], apart, np.inf))
            if np.isfinite(nearest):
                found.append((float(nearest), other, table))
        found.sort(key=lambda row: row[:2])
        chosen = tuple(other for _, other, _ in found[:NUM_AGENTS])
        shape = (NUM_AGENTS, way.at.size)
        tables = {name: np.zeros(shape, own[name].dtype) for name in BODY}
        size = {"kind": np.zeros(NUM_AGENTS, np.int32)}
        size |= {name: np.ones(NUM_AGENTS) for name in ("length", "width")}
        for slot, (_, other, table) in enumerate(found[:NUM_AGENTS]):
            for name in BODY:
                tables[name][slot] = table[name]
            for name in size:
                size[name][slot] = getattr(self.recording.tracks[other], name)
        return chosen, tables | size

    def _follows_missing(self, way: _Way, own: dict, tables: dict) -> bool:
        """Whether somebody missing from the file drives ahead in the ego's lane."""
        time, rows = way.clock / self.rate, []
        for ghost in self.recording.ghosts:
            share = np.clip((time - ghost.t0) / max(ghost.t1 - ghost.t0, 1e-6), 0, 1)
            x = ghost.start[0] + share * (ghost.end[0] - ghost.start[0])
            y = ghost.start[1] + share * (ghost.end[1] - ghost.start[1])
            rows.append(np.stack(project(way.frame, x, y), axis=1))
        row = {"obstacles.valid": tables["present"], "time_valid": np.ones(1, bool)}
        for side in ("lower", "upper"):
            row |= {f"obstacles.{key}_{side}": tables[key] for key in "sl"}
        none = dict.fromkeys(("s0", "v0", "a0", "dl0", "future_s", "s_at_5s"), 0.0)
        motion = Motion(s=own["s"], l=own["l"], **none)
        return follows_ghost(row, motion, np.array(rows).reshape(-1, time.size, 2))

    def _road(self, way: _Way, own: dict) -> Road:
        """The road grid from the ego on; beyond the map straight."""
        frame, track = way.frame, self.recording.tracks[way.number]
        origin = float(own["s"][0])
        rest = slice(int(way.at[0]), int(way.at[-1] + 1e-6) + 1)
        s, l = way.view.s[way.number][rest], way.view.l[way.number][rest]
        at = origin + np.arange(NUM_ROAD) * ROAD_STEP_M
        kappa = np.where(at < frame.length, frame.on_grid("kappa", at), 0.0)
        forward = np.maximum.accumulate(s)
        keep = np.append(True, np.diff(forward // MIN_PATH_ADVANCE_M) > 0)
        path = savgol(
            np.interp(at, forward[keep], l[keep]), 1.0 / ROAD_STEP_M, PATH_WINDOW_M
        )
        width = frame.table("lane_left", s) - frame.table("lane_right", s)
        # the human's way is drivable
        reach = track.width * np.abs(np.cos(own["heading"]))
        reach = reach + track.length * np.abs(np.sin(own["heading"]))
        reach = 0.5 * reach + EDGE_MARGIN_M
        left = max(frame.table("road_left", s).max(), (own["l"] + reach).max())
        right = min(frame.table("road_right", s).min(), (own["l"] - reach).min())
        graph, single = self.collector.graph, np.float32
        return _node(
            Road,
            kappa=kappa.astype(single),
            speed_limit=frame.table("speed_limit", at).astype(single),
            path_l=path.astype(single),
            lane_width=single(np.median(width)),
            lanes_left=np.int32(_count_beside(graph, way.lane_id, "left")),
            lanes_right=np.int32(_count_beside(graph, way.lane_id, "right")),
            edge_left=single(left),
            edge_right=single(right),
            destination=single(self._destination(way, origin)),
        )

    def _destination(self, way: _Way, origin: float) -> float:
        """Station of the front bumper at the destination; else the grid's end."""
        end, track = (NUM_ROAD - 1) * ROAD_STEP_M, self.recording.tracks[way.number]
        if track.destination is None:
            return end
        x, y = track.destination
        s, l = project(way.frame, np.array([x]), np.array([y]))
        ahead = float(s[0]) - origin + 0.5 * track.length
        inside = abs(float(l[0])) <= DESTINATION_ASIDE_M
        return ahead if inside and 0.0 < ahead < end else end

    def _lines(self, way: _Way, origin: float, front: float) -> Lines | None:
        """The nearest lines ahead with trusted lights or stop signs.

        None if a light on the way does not repeat green, yellow, red.
        """
        time = way.clock / self.rate
        names = ("s", "offset", "green", "yellow", "red")
        table = {name: np.zeros(NUM_LINES, np.float32) for name in names}
        kind, slot = np.zeros(NUM_LINES, np.int32), 0
        for station, lane in sorted(way.frame.stop_lines, key=lambda row: row[0]):
            trusted = self.collector.signals
            lights = [trusted[name] for name in lane.signal_ids if name in trusted]
            if station - origin < front or not (lights or lane.stop_sign):
                continue
            if slot == NUM_LINES:
                break
            table["s"][slot] = station - origin
            kind[slot] = LineKind.STOP_SIGN
            if lights:
                kind[slot] = LineKind.LIGHT
                states = np.stack([signal_state(light, time) for light in lights])
                colours = np.select([states == "red", states == "yellow"], [2, 1])
                cycle = light_cycle(colours.max(axis=0))
                if cycle is None:
                    return None
                for name, value in zip(names[1:], cycle, strict=True):
                    table[name][slot] = value
            slot += 1
        return _node(Lines, kind=kind, **table)


def light_cycle(colours: np.ndarray) -> tuple[float, float, float, float] | None:
    """(offset, green, yellow, red) s that shows these colours, or None.

    Args:
      colours: [n] 0 green, 1 yellow, 2 red, every 0.1 s. Runs between two
        switches give the durations; the first and the last run may be cut.
    """
    switches = np.flatnonzero(np.diff(colours)) + 1
    starts = np.append(0, switches)
    lengths = np.diff(np.append(starts, colours.size))
    shown = colours[starts]
    full = np.zeros(3)
    for colour in range(3):
        runs = lengths[shown == colour]
        inner = lengths[1:-1][shown[1:-1] == colour]
        if runs.size:
            full[colour] = np.median(inner) if inner.size else runs.max()
    begin = np.append(0.0, np.cumsum(full))[shown[0]]
    gone = full[shown[0]] - lengths[0] if lengths.size > 1 else 0.0
    # half a step earlier, so that no switch falls on a step
    offset = begin + gone + 0.5
    phase = np.mod(np.arange(colours.size) + offset, full.sum())
    again = (phase >= full[0]).astype(int) + (phase >= full[0] + full[1])
    if not np.array_equal(again, colours):
        return None
    offset, green, yellow, red = np.append(offset, full) * STEP_S
    return float(offset), float(green), float(yellow), float(red)


def _agents(tables: dict, limit: np.ndarray, config: RecordedConfig) -> Agents:
    """Who the replayed agents are, and how they drive once they leave the log.

    They never appear by themselves (`appear_s` = inf): the log brings them.
    """
    kind, present = tables["kind"], tables["present"]
    drives_by_itself = (kind == Kind.VEHICLE) | (kind == Kind.CYCLIST)
    first = np.argmax(present, axis=1)[:, None]
    start = lambda key: np.take_along_axis(tables[key], first, 1)[:, 0]  # noqa: E731
    fastest = np.max(np.where(present, tables["v"], 0.0), axis=1)
    share = np.max(np.where(present, limit, 0.0), axis=1)
    share = np.where(kind == Kind.VEHICLE, share, 0.0)
    sine, cosine = (
        np.sum(np.where(present, wave(tables["heading"]), 0.0), axis=1)
        for wave in (np.sin, np.cos)
    )
    heading = np.arctan2(sine, cosine)
    along = np.where(cosine >= 0.0, 0.0, np.pi)
    heading = np.where(np.abs(np.sin(heading)) < KEEPS_LANE, along, heading)
    fill = lambda value: np.full(NUM_AGENTS, value, np.float32)  # noqa: E731
    driver = _node(
        Driver,
        desired=np.maximum(fastest, share).astype(np.float32),
        **{
            name: fill(getattr(config, name))
            for name in ("headway", "standstill", "acceleration", "braking", "delay")
        },
        reacts=drives_by_itself,
        obeys_lines=kind == Kind.VEHICLE,
        changes_lane=np.zeros(NUM_AGENTS, bool),
        politeness=fill(0.0),
        threshold=fill(np.inf),
        lapse_start=fill(np.inf),
        lapse_end=fill(np.inf),
    )
    phases, moves = (NUM_AGENTS, NUM_PHASES), (NUM_AGENTS, NUM_MOVES)
    script = _node(
        Script,
        start=np.full(phases, np.inf, np.float32),
        speed=np.zeros(phases, np.float32),
        rate=np.ones(phases, np.float32),
        move_start=np.full(moves, np.inf, np.float32),
        move_l=np.zeros(moves, np.float32),
        move_speed=np.ones(moves, np.float32),
    )
    script.start[kind == Kind.STATIC, 0] = 0.0  # target speed 0: stays where it is
    return _node(
        Agents,
        kind=kind,
        **{name: tables[name].astype(np.float32) for name in ("length", "width")},
        appear_s=fill(np.inf),
        appear_t=fill(0.0),
        relative=np.zeros(NUM_AGENTS, bool),
        **{name: start(name).astype(np.float32) for name in ("s", "l", "v")},
        heading=heading.astype(np.float32),
        v_share=fill(0.0),
        arrival_s=fill(np.inf),
        driver=driver,
        script=script,
    )


def _touches(length: float, width: float, own: dict, tables: dict) -> bool:
    """Whether the human's box meets an agent's anywhere in the log."""
    x, y = (tables[name] - own[name] for name in "xy")
    reach = 0.5 * (length + width + tables["length"] + tables["width"])[:, None]
    near = tables["present"] & (np.hypot(x, y) < reach)
    slot, step = np.nonzero(near)
    if slot.size == 0:
        return False
    count = -(-slot.size // 256) * 256  # few sizes compile
    slot, step = np.resize(slot, count), np.resize(step, count)
    single = lambda *values: [jnp.asarray(v, jnp.float32) for v in values]  # noqa: E731
    zero = np.zeros(count)
    one = single(zero, zero, own["yaw"][step], zero + length, zero + width)
    size = (tables["length"][slot], tables["width"][slot])
    other = single(x[slot, step], y[slot, step], tables["yaw"][slot, step], *size)
    return bool(np.any(_meet(one, other)))


@jax.jit
def _meet(one: list[jax.Array], other: list[jax.Array]) -> jax.Array:
    """Whether boxes overlap, [q]; each a list of the leaves of `Box`."""
    box = lambda row: Box(  # noqa: E731
        x=row[0], y=row[1], heading=row[2], length=row[3], width=row[4]
    )
    return jax.vmap(lambda a, b: overlaps(box(a), box(b)))(one, other)


def _speed(track: SmoothTrack) -> np.ndarray:
    """Way per sample [n] m along the heading, >= 0: nobody reverses."""
    if track.num_frames < 3:  # the derivative at the ends takes three samples
        return np.zeros(track.num_frames)
    dx, dy = (np.gradient(values, edge_order=2) for values in (track.x, track.y))
    return np.maximum(dx * np.cos(track.heading) + dy * np.sin(track.heading), 0.0)


def _long_chain(
    graph: LaneGraph, visited: list[str], x: np.ndarray, y: np.ndarray
) -> tuple[str, ...]:
    """The chain through the first lane, prolonged until the whole track fits."""
    chain = graph.chain(visited[0], visited)
    needed = float(np.hypot(np.diff(x), np.diff(y)).sum())
    while graph.frame(chain).length < needed:
        tail = graph.chain(chain[-1], visited)
        more = [name for name in tail[tail.index(chain[-1]) :] if name not in chain]
        if not more:
            break
        chain += tuple(more)
    return chain


def _steps_inside(frame: LaneFrame, s: np.ndarray, l: np.ndarray) -> int:
    """Number of samples after the first that stay on the mapped road."""
    room = (s > 0.0) & (s < frame.length)
    room &= l < frame.table("road_left", s) + OFF_ROAD_M
    room &= l > frame.table("road_right", s) - OFF_ROAD_M
    out = np.flatnonzero(~room)
    return max(int(out[0]) - 1, 0) if out.size else s.size - 1


def _count_beside(graph: LaneGraph, lane_id: str, side: str) -> int:
    """Same-direction lanes on one side of a lane."""
    seen, name = {lane_id}, getattr(graph.lanes[lane_id], side)
    while name in graph.lanes and name not in seen:
        seen.add(name)
        name = getattr(graph.lanes[name], side)
    return len(seen) - 1
