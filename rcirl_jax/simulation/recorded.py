"""Recorded drives as cases: the ego follows a human's path among the logged others.

Every suitable vehicle track of a `Recording` becomes one `Case` with a replay.
Positions are smoothed as for training data (`data.smoothing`), projected into
the frame of the lanes that the driver follows (`data.lanes`) and read on the
simulator's 0.1 s clock, linearly between samples. Station 0 is the ego's centre
at its first time on a lane. What is not suitable is counted by reason.
"""

import collections
import dataclasses
from collections.abc import Iterable, Iterator

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.data.collect import Collector
from rcirl_jax.data.config import CollectConfig
from rcirl_jax.data.filters import MAX_ACCELERATION_MPS2, OFF_ROAD_M, follows_ghost
from rcirl_jax.data.lanes import LaneFrame, LaneGraph, project
from rcirl_jax.data.motion import MIN_PATH_ADVANCE_M, FrameTracks, Motion
from rcirl_jax.errors import InputError
from rcirl_jax.geometry.boxes import Box, overlaps
from rcirl_jax.simulation.cases import (
    NUM_AGENTS,
    NUM_ROAD,
    ROAD_STEP_M,
    STEP_S,
    Case,
    Replay,
    Road,
)
from rcirl_jax.simulation.recorded_parts import (
    agents_of,
    crc,
    lines_of,
    perfect_perception,
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
SIDE_WEIGHT = 4.0  # 1, how much more a metre aside counts (as data.collect)
SIDE_VIEW_M = 40.0  # m, an agent farther aside is not in the picture
MIN_SHRINK = 0.2  # 1, 1 - kappa l below which a projection means nothing
EDGE_MARGIN_M = 0.3  # m between the human's box and the drivable area's edge
DESTINATION_ASIDE_M = 20.0  # m, a destination farther aside is on another road
ROUND_STEPS = 50  # steps; tables are cut to whole 5 s, so plan_every divides


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordedConfig:
    """How drives are cut out of recordings."""

    smoothing_s: float = 4.1  # s, Savitzky-Golay window on positions
    min_duration_s: float = 6.0  # s, shorter drives are left out
    max_duration_s: float = 120.0  # s, longer drives are cut
    # steps of the replay tables; None: the longest drive, rounded up to 5 s
    steps: int | None = None
    min_progress_m: float = 10.0  # m, a human who stands shows nothing
    # agents leave the log for the IDM once the ego departs (Replay)
    turns_reactive: bool = True
    # desired speed = max(fastest recorded, share of the limit): 1
    limit_share: float = 0.8
    drop_overlaps: bool = True  # leave out drives that touch another in the log
    max_cases: int | None = None  # at most so many cases, in the order found

    def __post_init__(self) -> None:
        """Reject what cannot be meant."""
        if not 0.0 < self.min_duration_s <= self.max_duration_s:
            raise InputError(
                f"--min_duration_s: {self.min_duration_s}: expected more than 0 and "
                f"at most {self.max_duration_s}"
            )
        if not 0.0 <= self.limit_share <= 2.0:
            raise InputError(f"--limit_share: {self.limit_share}: expected 0 to 2")
        if self.steps is not None and self.steps < 1:
            raise InputError(f"--steps: {self.steps}: expected at least 1")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Drive:
    """One recorded drive: its case, and where it lies in the recording."""

    id: str  # "RECORDING:TRACK"
    case: Case  # numpy leaves; replay tables as long as the drive, [steps + 1]
    frame: LaneFrame  # the reference line is `frame.line`
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
    count: collections.Counter[str] = collections.Counter()
    found: list[tuple[str, Case]] = []
    for recording in recordings:
        for drive in drives(recording, config, count):
            found.append((drive.id, drive.case))
            if len(found) == config.max_cases:
                break
        if len(found) == config.max_cases:
            break
    if dropped is not None:
        dropped.update(count)
    if not found:
        raise InputError(
            f"recordings: suitable drives: 0, left out {dict(count)}: "
            "expected at least one"
        )
    longest = max(int(case.steps) for _, case in found)
    steps = config.steps or -(-longest // ROUND_STEPS) * ROUND_STEPS
    cases = [_padded(case, steps) for _, case in found]
    stacked = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *cases)
    return stacked, tuple(name for name, _ in found)


def _padded(case: Case, steps: int) -> Case:
    """Replay tables of a common length; nobody is present in the padding.

    The human goes on at the last speed and offset, so that no step of the
    padding holds a jump.
    """
    replay = case.replay
    if replay is None:
        raise ValueError("replay: None: expected a recorded drive")
    size = steps + 1
    have = min(replay.ego_s.shape[0], size)
    beyond = np.maximum(np.arange(size) - (have - 1), 0) * STEP_S
    index = np.minimum(np.arange(size), have - 1)
    take = lambda table: np.asarray(table)[..., index]  # noqa: E731
    padded = jax.tree.map(
        lambda leaf: take(leaf) if np.ndim(leaf) else np.asarray(leaf), replay
    )
    padded = padded.replace(
        present=padded.present & (beyond == 0.0),
        ego_s=np.asarray(padded.ego_s + padded.ego_v * beyond, np.float32),
    )
    return case.replace(replay=padded, steps=np.int32(min(int(case.steps), steps)))


def drives(
    recording: Recording,
    config: RecordedConfig,
    dropped: collections.Counter[str] | None = None,
) -> Iterator[Drive]:
    """The suitable drives of one recording, one per human-driven vehicle."""
    count = collections.Counter() if dropped is None else dropped
    cutter = _Cutter(recording, config)
    for number, track in enumerate(recording.tracks):
        if track.kind != Kind.VEHICLE:
            continue
        drive = cutter.drive(number)
        if isinstance(drive, str):
            count[drive] += 1
        else:
            yield drive


class _Cutter:
    """Cuts one recording into drives."""

    def __init__(self, recording: Recording, config: RecordedConfig) -> None:
        self.config = config
        self.collector = Collector(
            recording, CollectConfig(smoothing_s=config.smoothing_s)
        )
        self.recording = recording
        self.rate = recording.rate_hz
        self.speeds = [_speed(t.x, t.y, self.rate) for t in self.collector.tracks]

    def drive(self, number: int) -> Drive | str:
        """The drive of one track, or the reason why there is none."""
        config, smooth = self.config, self.collector.tracks[number]
        if (smooth.num_frames - 1) / self.rate < config.min_duration_s - 1e-6:
            return "too_short"
        lanes = self.collector.graph.match(smooth.x, smooth.y, smooth.heading)
        on = np.flatnonzero(lanes != "")
        if on.size == 0:
            return "off_map"
        first = int(on[0])
        visited = [str(lane) for lane in dict.fromkeys(lanes[on])]
        chain = _long_chain(self.collector.graph, visited, smooth.x, smooth.y)
        frame = self.collector.graph.frame(chain)
        view = self.collector.view(frame)
        last = first + _inside(frame, view.s[number][first:], view.l[number][first:])
        seconds = min((last - first) / self.rate, config.max_duration_s)
        if seconds < config.min_duration_s - 1e-6:
            return "too_short"
        at = first + np.arange(int(seconds / STEP_S + 1e-6) + 1) * STEP_S * self.rate
        if view.s[number][last] - view.s[number][first] < config.min_progress_m:
            return "standing"
        # m/s per step; the smoothing leaves only what camera errors make
        if np.abs(np.diff(self._own(number, at))).max() > MAX_ACCELERATION_MPS2 * STEP_S:
            return "too_noisy"
        return self._build(number, visited[0], frame, view, at)

    def _own(self, number: int, at: np.ndarray) -> np.ndarray:
        return np.interp(at, np.arange(self.speeds[number].size), self.speeds[number])

    def _build(
        self,
        number: int,
        lane_id: str,
        frame: LaneFrame,
        view: FrameTracks,
        at: np.ndarray,
    ) -> Drive | str:
        """Replay, road, lines and agents of a drive at frame positions `at`."""
        smooth, config = self.collector.tracks[number], self.config
        clock = smooth.first_frame + at  # frame positions of the recording
        own = self._table(number, frame, view, clock)
        origin = float(own["s"][0])
        ego_s, ego_l = own["s"] - origin, own["l"]
        tracks, tables = self._others(number, frame, view, clock, own)
        tables["s"] = tables["s"] - origin
        if config.drop_overlaps and _touches(smooth.track, own, tables):
            return "overlapping_boxes"
        if self._follows_missing(frame, clock, origin, ego_s, ego_l, tables):
            return "follows_missing_car"
        lines = lines_of(
            frame,
            self.collector.signals,
            clock / self.rate,
            origin,
            0.5 * smooth.track.length,
        )
        if lines is None:
            return "irregular_light"
        road = self._road(number, lane_id, frame, view, origin, at)
        name = f"{self.recording.name}:{smooth.track.id}"
        limit = frame.table("speed_limit", tables["s"] + origin)
        single = np.float32
        case = Case(
            seed=np.uint32(crc(name)),
            steps=np.int32(at.size - 1),
            ego_v=single(own["v"][0]),
            ego_length=single(smooth.track.length),
            ego_width=single(smooth.track.width),
            road=road,
            lines=lines,
            agents=agents_of(tables, limit * config.limit_share),
            perception=perfect_perception(),
            replay=Replay(
                **{k: tables[k].astype(single) for k in ("s", "l", "heading", "v")},
                present=tables["present"],
                ego_s=ego_s.astype(single),
                ego_l=ego_l.astype(single),
                ego_v=own["v"].astype(single),
                turns_reactive=np.bool_(config.turns_reactive),
            ),
        )
        return Drive(
            id=name,
            case=case,
            frame=frame,
            origin=origin,
            start_s=float(clock[0] / self.rate),
            tracks=tracks,
        )

    def _table(
        self, number: int, frame: LaneFrame, view: FrameTracks, clock: np.ndarray
    ) -> dict[str, np.ndarray]:
        """One track at frame positions `clock`: s, l, heading, v, x, y, yaw, present."""
        smooth = self.collector.tracks[number]
        at, index = clock - smooth.first_frame, np.arange(smooth.num_frames)
        read = lambda values: np.interp(at, index, values)  # noqa: E731
        s, l = read(view.s[number]), read(view.l[number])
        known = (at >= -1e-6) & (at <= smooth.num_frames - 1 + 1e-6)
        shrink = 1.0 - frame.on_grid("kappa", s) * l
        return {
            "s": s,
            "l": l,
            "heading": _wrap(read(np.unwrap(view.tilt[number]))),
            "v": read(self.speeds[number]),
            "x": read(smooth.x),
            "y": read(smooth.y),
            "yaw": read(smooth.heading),
            "present": known & (np.abs(l) < SIDE_VIEW_M) & (shrink > MIN_SHRINK),
        }

    def _others(
        self,
        number: int,
        frame: LaneFrame,
        view: FrameTracks,
        clock: np.ndarray,
        own: dict[str, np.ndarray],
    ) -> tuple[tuple[int, ...], dict[str, np.ndarray]]:
        """The nearest agents over the run, as tables [A, n], and who they are."""
        found = []
        for other, smooth in enumerate(self.collector.tracks):
            ends = smooth.first_frame + smooth.num_frames - 1
            if other == number or smooth.first_frame > clock[-1] or ends < clock[0]:
                continue
            table = self._table(other, frame, view, clock)
            apart = np.abs(table["s"] - own["s"])
            apart += SIDE_WEIGHT * np.abs(table["l"] - own["l"])
            nearest = np.min(np.where(table["present"], apart, np.inf))
            if np.isfinite(nearest):
                found.append((float(nearest), other, table))
        found.sort(key=lambda row: row[:2])
        chosen = found[:NUM_AGENTS]
        shape = (NUM_AGENTS, clock.size)
        tables = {name: np.zeros(shape, v.dtype) for name, v in own.items()}
        tables |= {name: np.zeros(NUM_AGENTS) for name in ("length", "width")}
        tables["kind"] = np.full(NUM_AGENTS, int(Kind.NONE), np.int32)
        for slot, (_, other, table) in enumerate(chosen):
            for name, values in table.items():
                tables[name][slot] = values
            track = self.recording.tracks[other]
            tables["kind"][slot] = int(track.kind)
            tables["length"][slot], tables["width"][slot] = track.length, track.width
        return tuple(other for _, other, _ in chosen), tables

    def _follows_missing(
        self,
        frame: LaneFrame,
        clock: np.ndarray,
        origin: float,
        ego_s: np.ndarray,
        ego_l: np.ndarray,
        tables: dict[str, np.ndarray],
    ) -> bool:
        """Whether a road user missing from the file drives ahead in the ego's lane."""
        time, rows = clock / self.rate, []
        for ghost in self.recording.ghosts:
            share = np.clip((time - ghost.t0) / max(ghost.t1 - ghost.t0, 1e-6), 0, 1)
            x = ghost.start[0] + share * (ghost.end[0] - ghost.start[0])
            y = ghost.start[1] + share * (ghost.end[1] - ghost.start[1])
            s, l = project(frame, x, y)
            rows.append(np.stack([s - origin, l], axis=1))
        row = {"obstacles.valid": tables["present"], "time_valid": np.ones(1, bool)}
        for side in ("lower", "upper"):
            row[f"obstacles.s_{side}"] = tables["s"]
            row[f"obstacles.l_{side}"] = tables["l"]
        motion = Motion(
            s0=origin,
            s=ego_s,
            l=ego_l,
            v0=0.0,
            a0=0.0,
            dl0=0.0,
            future_s=float(time[-1] - time[0]),
            s_at_5s=0.0,
        )
        return follows_ghost(row, motion, np.array(rows).reshape(-1, clock.size, 2))

    def _road(
        self,
        number: int,
        lane_id: str,
        frame: LaneFrame,
        view: FrameTracks,
        origin: float,
        at: np.ndarray,
    ) -> Road:
        """The road grid from the ego on; beyond the map straight and free."""
        track = self.recording.tracks[number]
        grid = np.arange(NUM_ROAD) * ROAD_STEP_M
        rest = slice(int(np.ceil(at[0] - 1e-6)), int(at[-1] + 1e-6) + 1)
        s, l = view.s[number][rest], view.l[number][rest]
        path = _path(s, l, origin + grid)
        reach = 0.5 * track.width + EDGE_MARGIN_M
        left, right = frame.table("road_left", s), frame.table("road_right", s)
        width = frame.table("lane_left", s) - frame.table("lane_right", s)
        kappa = np.where(
            origin + grid < frame.length, frame.on_grid("kappa", origin + grid), 0.0
        )
        graph, single = self.collector.graph, np.float32
        return Road(
            kappa=kappa.astype(single),
            speed_limit=frame.table("speed_limit", origin + grid).astype(single),
            path_l=path.astype(single),
            lane_width=single(np.median(width)),
            lanes_left=np.int32(_count_beside(graph, lane_id, "left")),
            lanes_right=np.int32(_count_beside(graph, lane_id, "right")),
            edge_left=single(max(left.max(), l.max() + reach)),
            edge_right=single(min(right.min(), l.min() - reach)),
            destination=single(self._destination(number, frame, origin)),
        )

    def _destination(self, number: int, frame: LaneFrame, origin: float) -> float:
        """Station of the front bumper at the destination; else the grid's end."""
        end, track = (NUM_ROAD - 1) * ROAD_STEP_M, self.recording.tracks[number]
        if track.destination is None:
            return end
        x, y = track.destination
        s, l = project(frame, np.array([x]), np.array([y]))
        ahead = float(s[0]) - origin + 0.5 * track.length
        inside = abs(float(l[0])) <= DESTINATION_ASIDE_M
        return ahead if inside and 0.0 < ahead < end else end


def _speed(x: np.ndarray, y: np.ndarray, rate: float) -> np.ndarray:
    """Speed [n] m/s of smoothed positions, second-order at the ends too."""
    if x.size < 3:
        ways = np.hypot(np.diff(x), np.diff(y)) * rate
        return np.full(x.size, float(ways.mean()) if ways.size else 0.0)
    vx, vy = (np.gradient(values, edge_order=2) * rate for values in (x, y))
    return np.hypot(vx, vy)


def _long_chain(
    graph: LaneGraph, visited: list[str], x: np.ndarray, y: np.ndarray
) -> tuple[str, ...]:
    """The chain through the first lane, prolonged until the whole track fits."""
    chain = graph.chain(visited[0], visited)
    needed = float(np.hypot(np.diff(x), np.diff(y)).sum())
    while graph.frame(chain).length < needed + ROAD_STEP_M:
        tail = graph.chain(chain[-1], visited)
        more = tail[tail.index(chain[-1]) + 1 :]
        more = tuple(name for name in more if name not in chain)
        if not more:
            break
        chain += more
    return chain


def _inside(frame: LaneFrame, s: np.ndarray, l: np.ndarray) -> int:
    """Number of steps from the first sample on that stay on the mapped road."""
    room = (s > 0.0) & (s < frame.length)
    room &= l < frame.table("road_left", s) + OFF_ROAD_M
    room &= l > frame.table("road_right", s) - OFF_ROAD_M
    out = np.flatnonzero(~room)
    return int(out[0]) - 1 if out.size else s.size - 1


def _path(s: np.ndarray, l: np.ndarray, stations: np.ndarray) -> np.ndarray:
    """The human's lateral offset by station; before and after it the end values."""
    s = np.maximum.accumulate(s)
    keep = np.concatenate([[True], np.diff(s // MIN_PATH_ADVANCE_M) > 0])
    return np.interp(stations, s[keep], l[keep])


def _count_beside(graph: LaneGraph, lane_id: str, side: str) -> int:
    """Same-direction lanes on one side of a lane."""
    seen, name = {lane_id}, getattr(graph.lanes[lane_id], side)
    while name in graph.lanes and name not in seen:
        seen.add(name)
        name = getattr(graph.lanes[name], side)
    return len(seen) - 1


def _wrap(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


_overlaps = jax.jit(jax.vmap(jax.vmap(overlaps, (0, 0)), (None, 0)))
