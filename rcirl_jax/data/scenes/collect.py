"""Automatic collection: Recording -> Demonstrations.

Every recorded car with enough future is an expert. Each planning frame becomes
one Scene in the Frenet frame of the lanes the driver follows, with all others
as obstacles, and the recorded motion as the human Trajectory. What is dropped
is counted by reason.
"""

import collections
import itertools
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from rcirl_jax.data.recording import MAX_SPEED_MPS
from rcirl_jax.data.scenes import filters, labels
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.scenes.lanes import LaneFrame, LaneGraph, project
from rcirl_jax.data.scenes.lines import line_obstacles, trusted_signals
from rcirl_jax.data.scenes.motion import (
    GRID_M,
    Driver,
    FrameTracks,
    Motion,
    driver_of,
    given_path,
    human_motion,
)
from rcirl_jax.data.scenes.tracks import SmoothTrack, smooth_track, steady_tracks
from rcirl_jax.geometry.limits import LOOK_AHEAD_M, planning_limit
from rcirl_jax.geometry.relevance import relevance_distance
from rcirl_jax.sampling.kinematics import trajectory_from_positions
from rcirl_jax.types import (
    Demonstration,
    Ego,
    Kind,
    Obstacles,
    Path,
    Recording,
    Scene,
    Trajectory,
)
from rcirl_jax.units import (
    HORIZON_S,
    NUM_OBSTACLES,
    NUM_STATIONS,
    STATION_STEP_M,
    TIMES_S,
)

VIEW_BEHIND_M = 60.0  # m, obstacles farther behind are not collected
MAX_MISSING_POINTS = 1000  # of the line that a missing road user is taken to drive
VIEW_BESIDE_M = 12.0  # m, obstacles farther beside are not collected
VIEW_NUMBERS = 7  # float64 of a sample in a frame: s, l, tilt and the table of four
# m, the scene's station grid and as far beyond it as its speed limits look
LONG_GRID_M = np.arange(0.0, GRID_M[-1] + LOOK_AHEAD_M + 1e-6, STATION_STEP_M)
BOX = ("s_lower", "s_upper", "l_lower", "l_upper", "speed", "valid")
LABELLED_AT_ONCE = 64  # scenes
CHUNK = 512  # scenes per device call; padded, so that it compiles once
VIEWS_BYTES = 256 * 2**20  # of tracks kept in the frames of chains


class Collector:
    """Cuts one recording into demonstrations; `dropped` counts the reasons."""

    def __init__(self, recording: Recording, config: CollectConfig) -> None:
        # without tracks that flicker; `flicker` counts them
        self.recording, self.flicker = steady_tracks(recording, config)
        recording = self.recording
        self.config = config
        self.rate = recording.rate_hz
        self.tracks = [
            smooth_track(track, self.rate, config.smoothing_s)
            for track in recording.tracks
        ]
        self.graph = LaneGraph(recording)
        self.signals, self.signal_notes = trusted_signals(
            recording, config.signal_checks
        )
        self.dropped: collections.Counter[str] = collections.Counter()
        # of the scenes: how many end with their surroundings, times recorded, times cut
        self.ended: collections.Counter[str] = collections.Counter()
        self._views: dict[tuple[str, ...], FrameTracks] = {}
        self._missing_views: dict[tuple[str, ...], list[tuple[np.ndarray, ...]]] = {}
        counts = [track.num_frames for track in self.tracks]
        self._first = np.array([track.first_frame for track in self.tracks])
        self._last = self._first + np.array(counts) - 1
        self._ends = np.cumsum(counts)[:-1]
        self._x = np.concatenate([t.x for t in self.tracks] or [[]])
        self._y = np.concatenate([t.y for t in self.tracks] or [[]])
        self._heading = np.concatenate([t.heading for t in self.tracks] or [[]])
        self._offset = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(int)
        self._size = np.array([(t.track.length, t.track.width) for t in self.tracks])
        self._kind = np.array([t.track.kind for t in self.tracks], np.int32)

    def own_frames(self, smooth: SmoothTrack) -> slice:
        """Return the samples of a track that are the recording's own, not surroundings.

        All of them, unless the recording is a piece of a longer log.
        """
        if self.recording.scenes_within is None:
            return slice(0, smooth.num_frames)
        low, high = (
            int(np.ceil(time * self.rate - 1e-6)) - smooth.first_frame
            for time in self.recording.scenes_within
        )
        start = min(max(low, 0), smooth.num_frames)
        return slice(start, min(max(high, start), smooth.num_frames))

    def begins_here(self, smooth: SmoothTrack) -> bool:
        """Whether the log first saw this track inside the recording's own time."""
        if self.recording.scenes_within is None:
            return True
        low, high = self.recording.scenes_within
        return low - 1e-6 <= smooth.track.first_seen_s < high - 1e-6

    def scenes(self) -> Iterator[dict]:
        """Yield rows of one scene each, as flat dicts of numpy arrays."""
        rows = itertools.chain.from_iterable(
            self._scenes_of(number, smooth)
            for number, smooth in enumerate(self.tracks)
            if smooth.track.kind == Kind.VEHICLE
        )
        while some := list(itertools.islice(rows, LABELLED_AT_ONCE)):
            labels.add_labels(some)
            yield from some

    def _scenes_of(self, number: int, smooth: SmoothTrack) -> Iterator[dict]:
        config, rate = self.config, self.rate
        first = int(np.ceil(config.min_history_s * rate))
        last = smooth.num_frames - 1 - int(np.ceil(config.min_future_s * rate))
        stride = max(int(round(config.stride_s * rate)), 1)
        # frames of the track before this piece of the log
        before = smooth.first_frame - int(round(smooth.track.first_seen_s * rate))
        starts = np.arange(first, last + 1 + before, stride) - before
        if starts.size == 0:
            self.dropped["future_too_short"] += self.begins_here(smooth)
            return
        own = self.own_frames(smooth)
        starts = starts[(starts >= own.start) & (starts < own.stop)]
        if starts.size == 0:
            return
        lane_ids = self.graph.match(smooth.x, smooth.y, smooth.heading)
        visited = collections.Counter(lane_ids[lane_ids != ""].tolist())
        driven: dict[str, tuple[LaneFrame, Driver]] = {}  # by the lane of the start
        for start in starts:
            lane = str(lane_ids[start])
            if lane == "":
                self.dropped["off_map"] += 1
                continue
            now, track = (smooth.first_frame + start) / rate, smooth.track
            end = min(now + HORIZON_S, float(track.t[-1]))
            if not track.is_human(now - config.min_history_s, end):
                self.dropped["not_human"] += 1
                continue
            if lane not in driven:
                frame = self.graph.frame(self.graph.chain(lane, visited))
                driven[lane] = frame, driver_of(self.view(frame), number, rate)
            row = self._scene(number, int(start), *driven[lane])
            if isinstance(row, str):
                self.dropped[row] += 1
            else:
                # times of the recorded future, and those of them without mask
                times = int(np.sum(row["future_s"] + 1e-6 >= TIMES_S))
                cut = times - int(np.sum(row["time_valid"]))
                self.ended.update(shortened=int(cut > 0), times=times, times_cut=cut)
                yield row

    def view(self, frame: LaneFrame) -> FrameTracks:
        """All tracks in the chain's frame (cached for the chains last asked for)."""
        if frame.chain in self._views:
            self._views[frame.chain] = self._views.pop(frame.chain)
        else:
            each = VIEW_NUMBERS * 8 * max(self._x.size, 1)
            while len(self._views) >= max(VIEWS_BYTES // each, 1):
                self._views.pop(next(iter(self._views)))
            s, l = project(frame, self._x, self._y)
            tilt = self._heading - frame.on_grid("heading", s)
            split_s, rate = np.split(s, self._ends), self.rate
            speeds = [
                np.gradient(one) * rate if one.size > 1 else 0.0 * one
                for one in split_s
            ]
            tilts = [np.unwrap(one) for one in np.split(tilt, self._ends)]
            columns = (s, l, np.concatenate(tilts), np.concatenate(speeds))
            self._views[frame.chain] = FrameTracks(
                s=split_s,
                l=np.split(l, self._ends),
                tilt=tilts,
                table=np.stack(columns, axis=1),
            )
        return self._views[frame.chain]

    def _scene(
        self, number: int, start: int, frame: LaneFrame, driver: Driver
    ) -> dict | str:
        """Return one scene, or the reason why there is none."""
        motion = human_motion(driver, start, frame.length)
        if motion is None:
            return "off_map"
        row = self._ego_and_path(number, start, frame, driver, motion)
        if reason := filters.reject_motion(row, motion, self.config):
            return reason
        self._add_obstacles(row, number, start, frame, motion)
        if reason := self._end(row, number, motion):
            return reason
        missing = self._missing(frame, start, number)
        if reason := filters.reject(row, motion, self.config, missing):
            return reason
        return row

    def _end(self, row: dict, number: int, motion: Motion) -> str | None:
        """End the mask where the surroundings end; or the reason to drop the scene."""
        now = row["frame"] / self.rate
        track, end = self.tracks[number].track, np.inf
        for begin, until in track.leader_missing:
            if begin <= now + 1e-6 < until:
                return "follows_missing_car"
            if begin > now:
                end = min(end, begin - now - 1.0 / self.rate)
        of = row["obstacles.track"]
        ends = np.where(of < 0, np.inf, self._last[of] / self.rate - now)
        end = min(end, filters.surroundings_end(row, ends))
        if end >= row["future_s"]:
            return None
        if end < self.config.min_surroundings_s:
            return "surroundings_end"
        row["time_valid"] = row["time_valid"] & (end + 1e-6 >= TIMES_S)
        return filters.reject_motion(row, motion, self.config)

    def _ego_and_path(
        self,
        number: int,
        start: int,
        frame: LaneFrame,
        driver: Driver,
        motion: Motion,
    ) -> dict:
        smooth = self.tracks[number]
        stations = motion.s0 + GRID_M
        path_l = given_path(driver, start, motion.s0, frame.length, LONG_GRID_M)
        row = {
            "ego.s": 0.0,
            "ego.l": motion.l[0],
            "ego.dl": motion.dl0,
            "ego.ddl": 0.0,
            "ego.v": motion.v0,
            "ego.a": motion.a0,
            "ego.length": smooth.track.length,
            "ego.width": smooth.track.width,
            "path.kappa": frame.on_grid("kappa", stations),
            "path.l": path_l[:NUM_STATIONS],
            "time_valid": motion.future_s + 1e-6 >= TIMES_S,
            "human.s": motion.s,
            "human.l": motion.l,
            "future_s": motion.future_s,
            "s_at_5s": motion.s_at_5s,
            "track": number,
            "frame": smooth.first_frame + start,
        }
        for name in ("lane_left", "lane_right", "road_left", "road_right"):
            row[f"path.{name}"] = frame.table(name, stations)
        far = motion.s0 + LONG_GRID_M
        limit = planning_limit(
            frame.on_grid("kappa", far),
            path_l,
            frame.table("speed_limit", far),
            STATION_STEP_M,
        )
        row["path.speed_limit"] = limit[:NUM_STATIONS]
        return row

    def _add_obstacles(
        self, row: dict, number: int, start: int, frame: LaneFrame, motion: Motion
    ) -> None:
        """Boxes of everybody else, stop lines and the destination; nearest N."""
        smooth = self.tracks[number]
        clock = (smooth.first_frame + start) / self.rate + TIMES_S.astype(np.float64)
        seen = (self._first <= clock[-1] * self.rate) & (
            self._last >= clock[0] * self.rate
        )
        seen[number] = False
        lines = line_obstacles(frame, smooth.track, self.signals, clock, motion)
        room = NUM_OBSTACLES - len(lines)
        others = np.flatnonzero(seen)
        near, boxes = self._boxes(row, self.view(frame), others, clock, motion, room)
        end = len(lines) + min(len(near), room)
        for name in BOX:
            table = np.zeros((NUM_OBSTACLES, TIMES_S.size), boxes[name].dtype)
            for slot, line in enumerate(lines):
                table[slot] = line[name]
            table[len(lines) : end] = boxes[name]
            row[f"obstacles.{name}"] = table
        kind = np.zeros(NUM_OBSTACLES, np.int32)
        kind[: len(lines)] = [line["kind"] for line in lines]
        kind[len(lines) : end] = self._kind[near[:room]]
        row["obstacles.kind"] = kind
        for name in ("a", "l_dot"):
            row[f"obstacles.{name}"] = np.zeros(NUM_OBSTACLES)
            row[f"obstacles.{name}"][len(lines) : end] = boxes[name]
        # for the labels only: what demands the stop is not stored
        is_light = np.zeros(NUM_OBSTACLES, bool)
        is_light[: len(lines)] = [line["is_light"] for line in lines]
        row["obstacles.is_light"] = is_light
        # for the check of the labels only: whose box it is, -1: nobody's
        row["obstacles.track"] = np.full(NUM_OBSTACLES, -1)
        row["obstacles.track"][len(lines) : end] = near[:room]
        row["num_bodies"] = len(near)

    def _boxes(
        self,
        row: dict,
        view: FrameTracks,
        others: np.ndarray,
        clock: np.ndarray,
        motion: Motion,
        room: int,
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Other road users in view as boxes at the T times.

        Returns:
          (near, boxes): numbers of all tracks in view, the most relevant first, and
          `BOX` [k, T] of the first k <= room of them.
        """
        frames = clock * self.rate - self._first[others, None]  # [n, T]
        last = (self._last - self._first)[others, None]
        valid = (frames >= -1e-6) & (frames <= last + 1e-6)
        at = np.clip(frames, 0.0, last)
        low = np.minimum(at.astype(int), np.maximum(last - 1, 0))
        share = np.where(last > 0, at - low, 0.0)
        s, l, tilt, speed = view.at(self._offset[others, None] + low, share)
        s = s - motion.s0
        seen = valid & (s > -VIEW_BEHIND_M) & (s < GRID_M[-1])
        seen &= np.abs(l - motion.l[0]) < VIEW_BESIDE_M
        # where a road meets itself, the nearest station jumps
        seen &= np.abs(speed) < MAX_SPEED_MPS
        half = 0.5 * (self._size[others, 1] + row["ego.width"])
        apart = relevance_distance(s, l, seen, half, motion.v0, row["path.l"])
        order = np.argsort(apart, kind="stable")
        order = order[np.isfinite(apart[order])]
        most = order[:room]
        s, l, tilt = s[most], l[most], tilt[most]
        along, across = np.abs(np.cos(tilt)), np.abs(np.sin(tilt))
        length, width = self._size[others[most]].T[..., None]
        half_s = 0.5 * (length * along + width * across)
        half_l = 0.5 * (length * across + width * along)
        # acceleration and lateral speed at the planning frame, over +-1 sample
        of = others[most]
        frame = np.rint(clock[0] * self.rate).astype(int) - self._first[of]
        last = self._last[of] - self._first[of]
        before, after = (np.clip(frame + step, 0, last) for step in (-1, 1))
        low, high = (view.table[self._offset[of] + at] for at in (before, after))
        change = (high - low) / (np.maximum(after - before, 1) / self.rate)[:, None]
        return others[order], {
            "s_lower": s - half_s,
            "s_upper": s + half_s,
            "l_lower": l - half_l,
            "l_upper": l + half_l,
            "speed": speed[most],
            "valid": seen[most],
            "a": change[:, 3],
            "l_dot": change[:, 1],
        }

    def _missing(self, frame: LaneFrame, start: int, number: int) -> np.ndarray:
        """Return station and offset [g, T, 2] of agents missing from the file."""
        smooth, missing = self.tracks[number], self.recording.missing_agents
        if frame.chain not in self._missing_views:
            views = self._missing_views[frame.chain] = []
            for agent in missing:
                count = int((agent.t1 - agent.t0) * self.rate) + 2
                share = np.linspace(0.0, 1.0, min(count, MAX_MISSING_POINTS))
                x, y = (
                    low + share * (high - low)
                    for low, high in zip(agent.start, agent.end, strict=True)
                )
                times = agent.t0 + share * (agent.t1 - agent.t0)
                views.append((times, *project(frame, x, y)))
        clock = (smooth.first_frame + start) / self.rate + TIMES_S
        s0 = self.view(frame).s[number][start]
        found = np.empty((len(missing), TIMES_S.size, 2))
        for row, (times, s, l) in zip(
            found, self._missing_views[frame.chain], strict=True
        ):
            row[:, 0] = np.interp(clock, times, s) - s0
            row[:, 1] = np.interp(clock, times, l)
        return found


# ------------------------------------------------------- rows -> a Demonstration


def stack_scenes(rows: list[dict]) -> Scene:
    """Return scenes [n, ...] from flat rows; floats become float32."""

    def leaf(name: str) -> Any:  # noqa: ANN401
        values = np.array([row[name] for row in rows])
        return values.astype(np.float32) if values.dtype.kind == "f" else values

    def node(kind: type, prefix: str) -> Any:  # noqa: ANN401
        names = kind.__dataclass_fields__
        return kind(**{name: leaf(f"{prefix}.{name}") for name in names})

    return Scene(
        ego=node(Ego, "ego"),
        path=node(Path, "path"),
        obstacles=node(Obstacles, "obstacles"),
        time_valid=leaf("time_valid"),
        tags=leaf("tags"),
    )


_complete = jax.jit(jax.vmap(trajectory_from_positions))


def human_trajectories(scene: Scene, s: np.ndarray, l: np.ndarray) -> Trajectory:
    """The humans' Trajectories [n, T] through the operator shared with candidates."""
    count = s.shape[0]
    parts = []
    for start in range(0, count, CHUNK):
        index = np.minimum(np.arange(start, start + CHUNK), count - 1)
        chunk = jax.tree.map(lambda x, index=index: x[index], scene)
        full = _complete(chunk, s[index], l[index])
        keep = min(CHUNK, count - start)
        parts.append(jax.tree.map(lambda x, keep=keep: np.asarray(x)[:keep], full))
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def assemble(
    rows: list[dict], *, vehicles: list[int], groups: list[int], recording: int
) -> Demonstration:
    """Return one batched Demonstration of a recording's rows.

    Args:
      rows: at least one row as made by `collect.Collector`.
      vehicles: number of the ego's vehicle inside the dataset, per row.
      groups: number of the vehicle-disjoint group, per row.
      recording: number of the recording inside the dataset.

    Returns:
      Demonstration with numpy leaves [n, ...].
    """
    scene = stack_scenes(rows)

    def column(name: str, dtype: type) -> Any:  # noqa: ANN401
        return np.array([row[name] for row in rows], dtype)

    s, l = column("human.s", np.float32), column("human.l", np.float32)
    numbers: dict[str, Any] = {
        "vehicle": np.array(vehicles, np.int32),
        "recording": np.full(len(rows), recording, np.int32),
        "group": np.array(groups, np.int32),
    }
    return Demonstration(
        scene=scene,
        human=human_trajectories(scene, s, l),
        decisions=column("decisions", np.int32),
        future_s=column("future_s", np.float32),
        s_at_5s=column("s_at_5s", np.float32),
        frame=column("frame", np.int32),
        **numbers,
    )
