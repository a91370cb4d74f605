"""One track of a recording -> one case: the way, the others, the road, the lines."""

import dataclasses
import zlib

import numpy as np

from rcirl_jax.data.scenes.collect import Collector
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.scenes.filters import (
    MAX_ACCELERATION_MPS2,
    OFF_ROAD_M,
    follows_ghost,
)
from rcirl_jax.data.scenes.lanes import LaneFrame, LaneGraph, project
from rcirl_jax.data.scenes.lines import signal_state
from rcirl_jax.data.scenes.motion import MIN_PATH_ADVANCE_M, FrameTracks, Motion
from rcirl_jax.data.scenes.smoothing import SmoothTrack, savgol
from rcirl_jax.simulation.cases import (
    NUM_AGENTS,
    NUM_LINES,
    NUM_ROAD,
    ROAD_STEP_M,
    STEP_S,
    Case,
    LineKind,
    Lines,
    Replay,
    Road,
    node,
    perfect_perception,
)
from rcirl_jax.simulation.recorded.agents import agents_of, touches
from rcirl_jax.simulation.recorded.config import RecordedConfig
from rcirl_jax.types import Recording

SIDE_WEIGHT = 4.0  # 1, how much more a metre aside counts (data.collect)
SIDE_VIEW_M = 40.0  # m, nobody farther aside of the line is present
MIN_SHRINK = 0.2  # 1, 1 - kappa l below which a projection means nothing
EDGE_MARGIN_M = 0.3  # m between the human's box and the drivable area's edge
DESTINATION_ASIDE_M = 20.0  # m, a destination farther aside is on another road
PATH_WINDOW_M = 14.0  # m, Savitzky-Golay window by station on the given path
BODY = ("s", "l", "heading", "v", "present", "x", "y", "yaw")  # of a motion table


@dataclasses.dataclass(frozen=True, kw_only=True)
class Drive:
    """One recorded drive: its case, and where it lies in the recording."""

    id: str  # "RECORDING:TRACK"
    case: Case  # numpy leaves; replay tables as long as the drive, [steps + 1]
    frame: LaneFrame  # the case's reference line is `frame.line`
    origin: float  # m, station of the case's s = 0 on that line
    start_s: float  # s, recording time of step 0
    tracks: tuple[int, ...]  # track number of each agent slot in use


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Way:
    """Which track is driven, in which frame, at which times."""

    number: int  # of the track
    lane_id: str  # lane at the start
    frame: LaneFrame
    view: FrameTracks  # all tracks in the frame
    at: np.ndarray  # [n] positions in the track's samples, every 0.1 s
    clock: np.ndarray  # [n] the same in the recording's frames


class Cutter:
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
        clock = at + smooth.first_frame
        if not smooth.track.is_human(clock[0] / self.rate, clock[-1] / self.rate):
            return "not_human"
        return _Way(
            number=number,
            lane_id=visited[0],
            frame=frame,
            view=view,
            at=at,
            clock=clock,
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
        if config.drop_overlaps and touches(track.length, track.width, own, tables):
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
        case = node(
            Case,
            seed=np.uint32(zlib.crc32(name.encode())),
            steps=np.int32(way.at.size - 1),
            ego_v=single(own["v"][0]),
            ego_length=single(track.length),
            ego_width=single(track.width),
            road=self._road(way, own),
            lines=lines,
            agents=agents_of(tables, limit, config),
            perception=perfect_perception(),
            replay=node(
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
        return node(
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
        return node(Lines, kind=kind, **table)


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
