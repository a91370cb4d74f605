"""Automatic collection: Recording -> Demonstrations.

Every recorded car with enough future is an expert. Each planning frame becomes
one Scene in the Frenet frame of the lanes the driver follows, with all others
as obstacles, and the recorded motion as the human Trajectory. What is dropped
is counted by reason.
"""

import collections
from collections.abc import Iterator

import numpy as np

from rcirl_jax.data import filters, labels
from rcirl_jax.data.config import CollectConfig
from rcirl_jax.data.lanes import LaneFrame, LaneGraph, project
from rcirl_jax.data.lines import line_obstacles, trusted_signals
from rcirl_jax.data.motion import (
    GRID_M,
    FrameTracks,
    Motion,
    given_path,
    human_motion,
)
from rcirl_jax.data.smoothing import SmoothTrack, smooth_track
from rcirl_jax.types import Kind, Recording
from rcirl_jax.units import NUM_OBSTACLES, TIMES_S

VIEW_BEHIND_M = 60.0  # m, obstacles farther behind are not collected
VIEW_BESIDE_M = 12.0  # m, obstacles farther beside are not collected


class Collector:
    """Cuts one recording into demonstrations; `dropped` counts the reasons."""

    def __init__(self, recording: Recording, config: CollectConfig) -> None:
        self.recording = recording
        self.config = config
        self.rate = recording.rate_hz
        self.tracks = [
            smooth_track(track, self.rate, config.smoothing_s)
            for track in recording.tracks
        ]
        self.graph = LaneGraph(recording)
        self.signals, self.signal_notes = trusted_signals(recording, self.graph)
        self.dropped: collections.Counter[str] = collections.Counter()
        self._views: dict[tuple[str, ...], FrameTracks] = {}
        counts = [track.num_frames for track in self.tracks]
        self._first = np.array([track.first_frame for track in self.tracks])
        self._last = self._first + np.array(counts) - 1
        self._ends = np.cumsum(counts)[:-1]
        self._x = np.concatenate([t.x for t in self.tracks]) if counts else np.zeros(0)
        self._y = np.concatenate([t.y for t in self.tracks]) if counts else np.zeros(0)

    def scenes(self) -> Iterator[dict]:
        """Rows of one scene each, as flat dicts of numpy arrays."""
        for number, smooth in enumerate(self.tracks):
            if smooth.track.kind == Kind.VEHICLE:
                yield from self._scenes_of(number, smooth)

    def _scenes_of(self, number: int, smooth: SmoothTrack) -> Iterator[dict]:
        config, rate = self.config, self.rate
        first = int(np.ceil(config.min_history_s * rate))
        last = smooth.num_frames - 1 - int(np.ceil(config.min_future_s * rate))
        starts = np.arange(first, last + 1, max(int(round(config.stride_s * rate)), 1))
        if starts.size == 0:
            self.dropped["future_too_short"] += 1
            return
        lane_ids = self.graph.match(smooth.x, smooth.y, smooth.heading)
        visited = list(dict.fromkeys(lane_ids[lane_ids != ""]))
        for start in starts:
            if lane_ids[start] == "":
                self.dropped["off_map"] += 1
                continue
            chain = self.graph.chain(str(lane_ids[start]), visited)
            row = self._scene(number, int(start), self.graph.frame(chain))
            if isinstance(row, str):
                self.dropped[row] += 1
            else:
                yield row

    def view(self, frame: LaneFrame) -> FrameTracks:
        """All tracks in the chain's frame (cached per chain)."""
        if frame.chain not in self._views:
            s, l = project(frame, self._x, self._y)
            heading = np.concatenate([t.heading for t in self.tracks])
            tilt = heading - frame.on_grid("heading", s)
            self._views[frame.chain] = FrameTracks(
                s=np.split(s, self._ends),
                l=np.split(l, self._ends),
                tilt=np.split(tilt, self._ends),
            )
        return self._views[frame.chain]

    def _scene(self, number: int, start: int, frame: LaneFrame) -> dict | str:
        """One scene, or the reason why there is none."""
        view = self.view(frame)
        motion = human_motion(view, number, start, self.rate, frame.length)
        if motion is None:
            return "off_map"
        row = self._ego_and_path(number, start, frame, view, motion)
        self._add_obstacles(row, number, start, frame, view, motion)
        reason = filters.reject(
            row, motion, self.config, self._ghosts(frame, start, number)
        )
        if reason is not None:
            return reason
        labels.add_labels(row)
        return row

    def _ego_and_path(
        self,
        number: int,
        start: int,
        frame: LaneFrame,
        view: FrameTracks,
        motion: Motion,
    ) -> dict:
        smooth = self.tracks[number]
        stations = motion.s0 + GRID_M
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
            "path.l": given_path(view, number, start, motion.s0, frame.length),
            "time_valid": motion.future_s + 1e-6 >= TIMES_S,
            "human.s": motion.s,
            "human.l": motion.l,
            "future_s": motion.future_s,
            "s_at_5s": motion.s_at_5s,
            "track": number,
            "frame": smooth.first_frame + start,
        }
        for name in ("speed_limit", "lane_left", "lane_right", "road_left"):
            row[f"path.{name}"] = frame.table(name, stations)
        row["path.road_right"] = frame.table("road_right", stations)
        return row

    def _add_obstacles(
        self,
        row: dict,
        number: int,
        start: int,
        frame: LaneFrame,
        view: FrameTracks,
        motion: Motion,
    ) -> None:
        """Boxes of everybody else, stop lines and the destination; nearest N."""
        smooth = self.tracks[number]
        clock = (smooth.first_frame + start) / self.rate + TIMES_S.astype(np.float64)
        seen = (self._first <= clock[-1] * self.rate) & (
            self._last >= clock[0] * self.rate
        )
        seen[number] = False
        boxes = [
            self._box(view, int(other), clock, motion) for other in np.flatnonzero(seen)
        ]
        found = [box for box in boxes if box is not None]
        found.sort(key=lambda box: box["relevance"])
        lines = line_obstacles(frame, smooth.track, self.signals, clock, motion)
        chosen = lines + found[: NUM_OBSTACLES - len(lines)]
        shape = (NUM_OBSTACLES, TIMES_S.size)
        for name in ("s_lower", "s_upper", "l_lower", "l_upper", "speed"):
            table = np.zeros(shape)
            for slot, box in enumerate(chosen):
                table[slot] = box[name]
            row[f"obstacles.{name}"] = table
        valid, kind = np.zeros(shape, bool), np.zeros(NUM_OBSTACLES, np.int32)
        for slot, box in enumerate(chosen):
            valid[slot], kind[slot] = box["valid"], box["kind"]
        row["obstacles.valid"], row["obstacles.kind"] = valid, kind
        row["obstacles.is_recorded"] = kind != Kind.NONE
        row["num_bodies"] = len(found)

    def _box(
        self, view: FrameTracks, other: int, clock: np.ndarray, motion: Motion
    ) -> dict | None:
        """One other road user at the T times in the scene's frame, or None."""
        track = self.tracks[other]
        frames = clock * self.rate - track.first_frame
        valid = (frames >= -1e-6) & (frames <= track.num_frames - 1 + 1e-6)
        if not valid.any():
            return None
        index = np.arange(track.num_frames)
        at = np.clip(frames, 0, track.num_frames - 1)
        s = np.interp(at, index, view.s[other]) - motion.s0
        l = np.interp(at, index, view.l[other])
        seen = valid & (s > -VIEW_BEHIND_M) & (s < GRID_M[-1])
        seen &= np.abs(l - motion.l[0]) < VIEW_BESIDE_M
        if not seen.any():
            return None
        tilt = np.interp(at, index, np.unwrap(view.tilt[other]))
        along, across = np.abs(np.cos(tilt)), np.abs(np.sin(tilt))
        length, width = track.track.length, track.track.width
        half_s = 0.5 * (length * along + width * across)
        half_l = 0.5 * (length * across + width * along)
        speed = np.gradient(view.s[other]) * self.rate if index.size > 1 else [0.0]
        coasting = motion.v0 * TIMES_S
        apart = np.abs(s - coasting) + 4.0 * np.abs(l - motion.l[0])
        return {
            "s_lower": s - half_s,
            "s_upper": s + half_s,
            "l_lower": l - half_l,
            "l_upper": l + half_l,
            "speed": np.interp(at, index, speed),
            "valid": seen,
            "kind": int(track.track.kind),
            "relevance": float(np.min(np.where(seen, apart, np.inf))),
        }

    def _ghosts(self, frame: LaneFrame, start: int, number: int) -> np.ndarray:
        """[g, T, 2] station and offset of road users missing from the file."""
        smooth = self.tracks[number]
        clock = (smooth.first_frame + start) / self.rate + TIMES_S
        s0 = self.view(frame).s[number][start]
        rows = []
        for ghost in self.recording.ghosts:
            share = np.clip((clock - ghost.t0) / max(ghost.t1 - ghost.t0, 1e-6), 0, 1)
            x = ghost.start[0] + share * (ghost.end[0] - ghost.start[0])
            y = ghost.start[1] + share * (ghost.end[1] - ghost.start[1])
            s, l = project(frame, x, y)
            rows.append(np.stack([s - s0, l], axis=1))
        return np.array(rows).reshape(-1, TIMES_S.size, 2)
