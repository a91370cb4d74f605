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
    driver_of,
    given_path,
    human_motion,
)
from rcirl_jax.data.scenes.tracks import SmoothTrack, smooth_track, steady_tracks
from rcirl_jax.geometry.limits import LOOK_AHEAD_M, planning_limit
from rcirl_jax.geometry.relevance import relevance_distance
from rcirl_jax.sampling.kinematics import trajectory_from_positions
from rcirl_jax.types import Demonstration, Ego, Kind, Obstacles, Path, Recording, Scene
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
# m, the scene's station grid and as far beyond it as its speed limits look
LONG_GRID_M = np.arange(0.0, GRID_M[-1] + LOOK_AHEAD_M + 1e-6, STATION_STEP_M)
# fields of an obstacle, their value in an empty slot, and their type
OBSTACLES = {
    **dict.fromkeys(("s_lower", "s_upper", "l_lower", "l_upper"), (0.0, np.float64)),
    **dict.fromkeys(("speed", "a", "l_dot"), (0.0, np.float64)),
    **{"valid": (False, np.bool_), "kind": (0, np.int32)},
    **{"is_light": (False, np.bool_), "track": (-1, np.int64)},
}
LABELLED_AT_ONCE = 64  # scenes
CHUNK = 512  # scenes per device call; padded, so that it compiles once
VIEWS_BYTES = 256 * 2**20  # of tracks kept in the frames of chains


class Collector:
    """Cuts one recording into demonstrations; `dropped` counts the reasons.

    A scene is a row: a dict of arrays and numbers, named as the leaves of a
    Demonstration ("path.kappa"), and some that only the next steps need.
    """

    def __init__(self, recording: Recording, config: CollectConfig) -> None:
        # without tracks that flicker; `flicker` counts them
        self.recording, self.flicker = steady_tracks(recording, config)
        self.config, self.rate = config, recording.rate_hz
        self.tracks = [
            smooth_track(track, self.rate, config.smoothing_s)
            for track in self.recording.tracks
        ]
        self.graph = LaneGraph(self.recording)
        self.signals, self.signal_notes = trusted_signals(
            self.recording, config.signal_checks
        )
        self.dropped: collections.Counter[str] = collections.Counter()
        # of the scenes: how many end with their surroundings, times recorded, times cut
        self.ended: collections.Counter[str] = collections.Counter()
        # by chain: all samples in its frame, and the missing agents
        self._views: dict[tuple[str, ...], np.ndarray] = {}
        self._missing_views: dict[tuple[str, ...], list[tuple[np.ndarray, ...]]] = {}
        counts = [track.num_frames for track in self.tracks]
        self._first = np.array([track.first_frame for track in self.tracks])
        self._last = self._first + np.array(counts) - 1
        self._offset = np.cumsum([0, *counts])
        # all samples, track after track
        self._x, self._y, self._heading = (
            np.concatenate([getattr(t, name) for t in self.tracks] or [[]])
            for name in ("x", "y", "heading")
        )
        self._size = np.array([(t.track.length, t.track.width) for t in self.tracks])
        self._kind = np.array([t.track.kind for t in self.tracks], np.int32)

    def own_frames(self, smooth: SmoothTrack) -> slice:
        """Returns the samples of a track that are the recording's, not surroundings.

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
        """Returns whether the log first saw a track inside the recording's own time."""
        if self.recording.scenes_within is None:
            return True
        low, high = self.recording.scenes_within
        return low - 1e-6 <= smooth.track.first_seen_s < high - 1e-6

    def scenes(self) -> Iterator[dict]:
        """Yields rows of one scene each, as flat dicts of numpy arrays."""
        rows = itertools.chain.from_iterable(
            self._scenes_of(number, smooth)
            for number, smooth in enumerate(self.tracks)
            if smooth.track.kind == Kind.VEHICLE
        )
        while some := list(itertools.islice(rows, LABELLED_AT_ONCE)):
            labels.add_labels(some)
            yield from some

    def _scenes_of(self, number: int, smooth: SmoothTrack) -> Iterator[dict]:
        config, rate, track = self.config, self.rate, smooth.track
        first = int(np.ceil(config.min_history_s * rate))
        last = smooth.num_frames - 1 - int(np.ceil(config.min_future_s * rate))
        stride = max(int(round(config.stride_s * rate)), 1)
        # frames of the track before this piece of the log
        before = smooth.first_frame - int(round(track.first_seen_s * rate))
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
        driven: dict[str, tuple[LaneFrame, Driver]] = {}  # by a lane of the chain

        def along(lane: str, start: int) -> dict | str:
            if lane not in driven:
                frame = self.graph.frame(self.graph.chain(lane, visited))
                samples = slice(self._offset[number], self._offset[number + 1])
                s, l = self._view(frame)[samples, :2].T.copy()
                driven[lane] = frame, driver_of(s, l, rate)
            return self._scene(number, start, *driven[lane])

        for start in starts.tolist():
            lane, now = str(lane_ids[start]), (smooth.first_frame + start) / rate
            end = min(now + HORIZON_S, float(track.t[-1]))
            if lane == "":
                row = "off_map"
            elif not track.is_human(now - config.min_history_s, end):
                row = "not_human"
            else:
                row = along(lane, start)
                if row == "far_from_road":
                    # the driver goes over to a lane that then leaves, as an exit does
                    later = lane_ids[start : start + round(HORIZON_S * rate) + 1]
                    again = along(str(later[later != ""][-1]), start)
                    row = row if isinstance(again, str) else again
            if isinstance(row, str):
                self.dropped[row] += 1
                continue
            # times of the recorded future, and those of them without mask
            times = int(np.sum(row["future_s"] + 1e-6 >= TIMES_S))
            cut = times - int(np.sum(row["time_valid"]))
            self.ended.update(shortened=int(cut > 0), times=times, times_cut=cut)
            yield row

    def _view(self, frame: LaneFrame) -> np.ndarray:
        """Returns all samples in the chain's frame, cached for the last chains.

        Station m, offset m, tilt rad (heading minus the line's, unwrapped) and speed
        along the line m/s, [samples, 4].
        """
        if frame.chain in self._views:
            self._views[frame.chain] = self._views.pop(frame.chain)
            return self._views[frame.chain]
        s, l = project(frame, self._x, self._y)
        tilt, speed = self._heading - frame.on_grid("heading", s), 0.0 * s
        for start, end in itertools.pairwise(self._offset.tolist()):
            tilt[start:end] = np.unwrap(tilt[start:end])
            if end - start > 1:
                speed[start:end] = np.gradient(s[start:end]) * self.rate
        table = np.stack([s, l, tilt, speed], axis=1)
        while len(self._views) >= max(VIEWS_BYTES // max(table.nbytes, 1), 1):
            self._views.pop(next(iter(self._views)))
        self._views[frame.chain] = table
        return table

    def _scene(
        self, number: int, start: int, frame: LaneFrame, driver: Driver
    ) -> dict | str:
        """Returns one scene, or the reason why there is none."""
        row = human_motion(driver, start, frame.length)
        if row is None:
            return "off_map"
        smooth = self.tracks[number]
        row |= {"track": number, "frame": smooth.first_frame + start}
        row |= {"ego.length": smooth.track.length, "ego.width": smooth.track.width}
        path_l = given_path(driver, start, row["s0"], frame.length, LONG_GRID_M)
        stations, far = row["s0"] + GRID_M, row["s0"] + LONG_GRID_M
        row["path.kappa"], row["path.l"] = (
            frame.on_grid("kappa", stations),
            path_l[:NUM_STATIONS],
        )
        for name in ("lane_left", "lane_right", "road_left", "road_right"):
            row[f"path.{name}"] = frame.table(name, stations)
        row["path.speed_limit"] = planning_limit(
            frame.on_grid("kappa", far),
            path_l,
            frame.table("speed_limit", far),
            STATION_STEP_M,
        )[:NUM_STATIONS]
        if reason := filters.reject_motion(row, self.config):
            return reason
        self._add_obstacles(row, frame)
        if reason := self._end(row):
            return reason
        return filters.reject(row, self.config, self._missing(row, frame)) or row

    def _end(self, row: dict) -> str | None:
        """Ends the mask where the surroundings end; returns a reason to drop it."""
        now, end = row["frame"] / self.rate, np.inf
        for begin, until in self.tracks[row["track"]].track.leader_missing:
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
        return filters.reject_motion(row, self.config)

    def _add_obstacles(self, row: dict, frame: LaneFrame) -> None:
        """Adds stop lines, the destination and the nearest others as boxes.

        For the labels and their check only: "obstacles.is_light", a light demands the
        stop; "obstacles.track", whose box it is (-1: nobody's); "num_bodies" in view.
        """
        number = row["track"]
        clock = row["frame"] / self.rate + TIMES_S.astype(np.float64)
        seen = (self._first <= clock[-1] * self.rate) & (
            self._last >= clock[0] * self.rate
        )
        seen[number] = False
        lines = line_obstacles(
            frame, self.tracks[number].track, self.signals, row, clock
        )
        near, boxes = self._boxes(
            row,
            self._view(frame),
            np.flatnonzero(seen),
            clock,
            NUM_OBSTACLES - len(lines),
        )
        for name, (rest, dtype) in OBSTACLES.items():
            of = boxes.get(name, np.zeros(len(boxes["track"])))
            made = np.full((NUM_OBSTACLES, *of.shape[1:]), rest, dtype)
            for slot, line in enumerate(lines):
                made[slot] = line.get(name, rest)
            made[len(lines) : len(lines) + len(of)] = of
            row[f"obstacles.{name}"] = made
        row["num_bodies"] = near

    def _boxes(
        self,
        row: dict,
        view: np.ndarray,
        others: np.ndarray,
        clock: np.ndarray,
        room: int,
    ) -> tuple[int, dict[str, np.ndarray]]:
        """Returns the number of road users in view, and the most relevant as boxes.

        Args:
          row: the scene.
          view: [samples, 4] of `_view`.
          others: numbers of tracks at the time.
          clock: [T] s.
          room: boxes at most.

        Returns:
          (number, fields of OBSTACLES, [k] or [k, T] each, k <= room).
        """
        frames = clock * self.rate - self._first[others, None]  # [n, T]
        last = (self._last - self._first)[others, None]
        valid = (frames >= -1e-6) & (frames <= last + 1e-6)
        at = np.clip(frames, 0.0, last)
        low = np.minimum(at.astype(int), np.maximum(last - 1, 0))
        share = np.where(last > 0, at - low, 0.0)[..., None]
        low = self._offset[others, None] + low
        mixed = view[low] * (1.0 - share)
        mixed += view[np.minimum(low + 1, len(view) - 1)] * share
        s, l, tilt, speed = np.moveaxis(mixed, -1, 0)
        s = s - row["s0"]
        seen = valid & (s > -VIEW_BEHIND_M) & (s < GRID_M[-1])
        seen &= np.abs(l - row["ego.l"]) < VIEW_BESIDE_M
        # where a road meets itself, the nearest station jumps
        seen &= np.abs(speed) < MAX_SPEED_MPS
        half = 0.5 * (self._size[others, 1] + row["ego.width"])
        apart = relevance_distance(s, l, seen, half, row["ego.v"], row["path.l"])
        order = np.argsort(apart, kind="stable")
        order = order[np.isfinite(apart[order])]
        most = order[:room]
        s, l, tilt, of = s[most], l[most], tilt[most], others[most]
        along, across = np.abs(np.cos(tilt)), np.abs(np.sin(tilt))
        length, width = self._size[of].T[..., None]
        half_s = 0.5 * (length * along + width * across)
        half_l = 0.5 * (length * across + width * along)
        # acceleration and lateral speed at the planning frame, over +-1 sample
        frame = np.rint(clock[0] * self.rate).astype(int) - self._first[of]
        last = self._last[of] - self._first[of]
        before, after = (np.clip(frame + step, 0, last) for step in (-1, 1))
        low, high = (view[self._offset[of] + at] for at in (before, after))
        change = (high - low) / (np.maximum(after - before, 1) / self.rate)[:, None]
        return order.size, {
            "s_lower": s - half_s,
            "s_upper": s + half_s,
            "l_lower": l - half_l,
            "l_upper": l + half_l,
            "speed": speed[most],
            "valid": seen[most],
            "kind": self._kind[of],
            "a": change[:, 3],
            "l_dot": change[:, 1],
            "track": of,
        }

    def _missing(self, row: dict, frame: LaneFrame) -> np.ndarray:
        """Returns station and offset [g, T, 2] of agents missing from the file."""
        missing = self.recording.missing_agents
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
        clock = row["frame"] / self.rate + TIMES_S
        found = np.empty((len(missing), TIMES_S.size, 2))
        for out, (times, s, l) in zip(
            found, self._missing_views[frame.chain], strict=True
        ):
            out[:, 0] = np.interp(clock, times, s) - row["s0"]
            out[:, 1] = np.interp(clock, times, l)
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
    scene, count = stack_scenes(rows), len(rows)

    def column(name: str, dtype: type) -> Any:  # noqa: ANN401
        return np.array([row[name] for row in rows], dtype)

    s, l = column("human.s", np.float32), column("human.l", np.float32)
    # the humans' trajectories, through the operator shared with candidates
    parts = []
    for start in range(0, count, CHUNK):
        index = np.minimum(np.arange(start, start + CHUNK), count - 1)
        chunk = jax.tree.map(lambda x, index=index: x[index], scene)
        full = _complete(chunk, s[index], l[index])
        keep = min(CHUNK, count - start)
        parts.append(jax.tree.map(lambda x, keep=keep: np.asarray(x)[:keep], full))
    numbers: dict[str, Any] = {
        "vehicle": np.array(vehicles, np.int32),
        "recording": np.full(count, recording, np.int32),
        "group": np.array(groups, np.int32),
    }
    return Demonstration(
        scene=scene,
        human=jax.tree.map(lambda *x: np.concatenate(x), *parts),
        decisions=column("decisions", np.int32),
        future_s=column("future_s", np.float32),
        s_at_5s=column("s_at_5s", np.float32),
        frame=column("frame", np.int32),
        **numbers,
    )
