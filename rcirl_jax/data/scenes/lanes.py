"""The lane graph of a recording: matching, chains of lanes, Frenet frames.

A chain is the sequence of lanes a driver follows: the lane at the planning
frame, its predecessors behind and, at every fork ahead, the branch the driver
took. Its centre line is the scene's reference line. Where the last lane ends beside
one that goes on, so does the reference line, as far from that lane as before: a
driver who merges changes lanes in one frame. Scenes of many drivers share a chain,
so everything that depends on it alone is computed once.
"""

import collections
import dataclasses
from collections.abc import Iterable, Mapping

import numpy as np
from scipy.spatial import KDTree

from rcirl_jax.geometry.frenet import (
    ReferenceLine,
    project_points,
    reference_line_from_polyline,
)
from rcirl_jax.types import Lane, Recording

BEHIND_M = 100.0  # m of chain kept behind the lane at the planning frame
AHEAD_M = 400.0  # m of chain kept beyond that lane
MAX_HEADING_GAP = np.deg2rad(60.0)  # rad, a car heads along its lane within this
SAME_PLACE_M = 1.0  # m, points of lanes that are nearer lie on each other
MATCH_NEIGHBOURS = 12  # nearest centre points looked at per position
TURN_M = 20.0  # m in which a line that goes on turns along the lane beside it
CLOSING_M = 60.0  # m in which the room of a lane that has ended closes
LINE_STEP_M = 1.0  # m, grid of the reference line
LINE_SIZES = (256, 512, 1024, 2048, 4096)  # static sizes; few compilations


@dataclasses.dataclass(frozen=True, kw_only=True)
class LaneFrame:
    """A chain's reference line with its lane tables along the station."""

    chain: tuple[str, ...]
    line: ReferenceLine
    length: float  # m, of the chain
    heading: np.ndarray  # [M] rad on the LINE_STEP_M grid, unwrapped
    kappa: np.ndarray  # [M] 1/m on the LINE_STEP_M grid
    station: np.ndarray  # [q] m, stations of the tables below
    speed_limit: np.ndarray  # [q] m/s
    lane_left: np.ndarray  # [q] m
    lane_right: np.ndarray  # [q] m, negative
    road_left: np.ndarray  # [q] m
    road_right: np.ndarray  # [q] m, negative
    # (station m, lane) of every stop line on the chain
    stop_lines: tuple[tuple[float, Lane], ...]

    def table(self, name: str, stations: np.ndarray) -> np.ndarray:
        """Return one of the lane tables at stations [m]."""
        return np.interp(stations, self.station, getattr(self, name))

    def on_grid(self, name: str, stations: np.ndarray) -> np.ndarray:
        """`heading` or `kappa` at stations [m]."""
        values = getattr(self, name)
        return np.interp(stations, np.arange(values.size) * LINE_STEP_M, values)


class LaneGraph:
    """Lanes of one recording with matching and chain building."""

    def __init__(self, recording: Recording) -> None:
        self.lanes = {lane.id: lane for lane in recording.lanes}
        self.default_limit = recording.default_speed_limit
        self.predecessors: dict[str, list[str]] = {name: [] for name in self.lanes}
        for lane in recording.lanes:
            for successor in lane.successors:
                if successor in self.predecessors:
                    self.predecessors[successor].append(lane.id)
        points, headings, owners = [], [], []
        for lane in recording.lanes:
            arc = _arc(lane.centre)  # a point about every metre of it
            grid = np.linspace(0.0, arc[-1], max(int(arc[-1]) + 1, 2))
            dense = np.stack([np.interp(grid, arc, x) for x in lane.centre.T], axis=1)
            direction = np.gradient(dense, axis=0)
            points.append(dense)
            headings.append(np.arctan2(direction[:, 1], direction[:, 0]))
            owners += [len(points) - 1] * len(dense)
        self._owner = np.array(owners, int)
        self._names = np.array(list(self.lanes), object)
        half = [max(x.left_width.max(), x.right_width.max()) for x in recording.lanes]
        self._reach = np.array(half, float) + 0.5
        self._heading = np.concatenate(headings) if headings else np.zeros(0)
        self._points = np.concatenate(points) if points else np.zeros((0, 2))
        self._tree = KDTree(self._points) if len(self._points) else None
        self._lengths = {
            lane.id: float(_arc(lane.centre)[-1]) for lane in recording.lanes
        }
        self._frames: dict[tuple[str, ...], LaneFrame] = {}
        self._lines: dict[str, int] = {}  # filled by `lines`

    def match(self, x: np.ndarray, y: np.ndarray, heading: np.ndarray) -> np.ndarray:
        """Lane id per position of one track ("" where the car is on none).

        The nearest lane centre among those that head the car's way, no farther
        than the lane's half width plus half a metre. Where lanes lie on each
        other (the branches of a fork), the one that the track is on most of the
        time.
        """
        if self._tree is None:
            return np.full(x.shape, "", object)
        count = min(MATCH_NEIGHBOURS, len(self._points))
        distance, index = self._tree.query(np.stack([x, y], 1), k=count)
        distance, index = distance.reshape(-1, count), index.reshape(-1, count)
        gap = np.abs(_wrap(self._heading[index] - heading[:, None]))
        owners, rows = self._owner[index], np.arange(len(x))
        on = (gap < MAX_HEADING_GAP) & (distance <= self._reach[owners])
        cost = np.where(on, distance, np.inf)
        best = np.argmin(cost, axis=1)
        found = on[rows, best]
        often = np.bincount(owners[rows, best][found], minlength=len(self.lanes))
        # points of other lanes that lie where the nearest point lies
        here = self._points[index[rows, best]]
        apart = np.hypot(*(self._points[index] - here[:, None]).transpose(2, 0, 1))
        together = on & (apart <= SAME_PLACE_M)
        best = np.argmax(np.where(together, often[owners], -1), axis=1)
        return np.where(found, self._names[owners[rows, best]], "")

    def chain(
        self, start: str, visited: Iterable[str] | Mapping[str, int]
    ) -> tuple[str, ...]:
        """Return the chain through lane `start` for a driver on these lanes.

        `visited` may name a lane as often as the driver was seen on it: at a fork
        that counts.
        """
        seen = collections.Counter(visited)
        ahead = [start]
        travelled = 0.0
        while travelled < AHEAD_M:
            options = [s for s in self.lanes[ahead[-1]].successors if s in self.lanes]
            following = self._pick(options, ahead[-1], seen, forward=True)
            if following is None or following in ahead:
                break
            ahead.append(following)
            travelled += self._lengths[following]
        behind: list[str] = []
        travelled = 0.0
        while travelled < BEHIND_M:
            first = behind[0] if behind else start
            before = self._pick(self.predecessors[first], first, seen, forward=False)
            if before is None or before in ahead or before in behind:
                break
            behind.insert(0, before)
            travelled += self._lengths[before]
        return tuple(behind + ahead)

    def _pick(
        self, options: list[str], here: str, seen: Mapping[str, int], forward: bool
    ) -> str | None:
        """The option visited most; else one with a visited neighbour; else straight."""
        if not options:
            return None
        most = max(options, key=lambda name: seen.get(name, 0))
        if most in seen:
            return most
        for name in options:
            lane = self.lanes[name]
            if lane.left in seen or lane.right in seen:
                return name
        end = -1 if forward else 0
        here_heading = _end_heading(self.lanes[here].centre, end)

        def bend(name: str) -> float:
            other = _end_heading(self.lanes[name].centre, end)
            return float(np.abs(_wrap(np.array(other - here_heading))))

        return min(options, key=bend)

    def lines(self) -> Mapping[str, int]:
        """Returns the number of the line that each lane is a piece of (cached).

        A lane goes on in its straightest successor, unless that goes on for another.
        """
        if not self._lines:
            after, before = {}, {}
            for name, lane in self.lanes.items():
                options = [x for x in lane.successors if x in self.lanes]
                after[name] = self._pick(options, name, {}, forward=True)
                options = self.predecessors[name]
                before[name] = self._pick(options, name, {}, forward=False)
            for number, name in enumerate(self.lanes):
                here = name
                while here is not None and here not in self._lines:
                    self._lines[here] = number
                    there = after[here]
                    here = there if there and before[there] == here else None
                here = before[name]
                while here and here not in self._lines and after[here] == name:
                    self._lines[here] = number
                    name, here = here, before[here]
        return self._lines

    def lines_beside(self, line: int) -> frozenset[int]:
        """Returns the numbers of the lines of which a piece is beside one of a line."""
        lines = self.lines()
        pieces = [self.lanes[name] for name, number in lines.items() if number == line]
        beside = (x for lane in pieces for x in (lane.left, lane.right))
        return frozenset(lines[x] for x in beside if x and x in lines) - {line}

    def follows(self, before: Iterable[str], after: Iterable[str]) -> bool:
        """Returns whether one of the lanes leads into one of those after."""
        after = {*after}
        leads = (x for name in before for x in self.lanes[name].successors)
        return not after.isdisjoint(leads)

    def frame(self, chain: tuple[str, ...]) -> LaneFrame:
        """Return the Frenet frame of a chain (cached)."""
        if chain in self._frames:
            return self._frames[chain]
        lanes = [self.lanes[name] for name in chain]
        behind, ahead = self._beyond(lanes[0], -1), self._beyond(lanes[-1], 1)
        parts = [behind, *(lane.centre for lane in lanes), ahead]
        points = np.concatenate(parts)
        length = float(_arc(points)[-1])
        size = next((n for n in LINE_SIZES if n > length + 1), LINE_SIZES[-1])
        line = reference_line_from_polyline(points, size=size, step=LINE_STEP_M)
        station = np.maximum.accumulate(_project(line, points)[0])
        limits = [lane.speed_limit or self.default_limit for lane in lanes]
        counts = [len(part) for part in parts]
        limits = np.repeat([limits[0], *limits, limits[-1]], counts)
        edges = {}
        for side in ("left", "right"):
            own = np.concatenate([getattr(x, f"{side}_width") for x in lanes])
            own = np.pad(own, (counts[0], counts[-1]), mode="edge")
            extra = [self._beside(lane, side) for lane in lanes]
            extra = np.repeat([extra[0], *extra, extra[-1]], counts)
            edges[side] = own, own + extra - self._closed(lanes, side, parts)
        (left, road_left), (right, road_right) = edges["left"], edges["right"]
        stops = [
            (float(_project(line, lane.stop_line.mean(axis=0)[None])[0][0]), lane)
            for lane in lanes
            if lane.stop_line is not None
        ]
        self._frames[chain] = LaneFrame(
            chain=chain,
            line=line,
            length=length,
            heading=np.unwrap(np.asarray(line.heading, np.float64)),
            kappa=np.asarray(line.kappa, np.float64),
            station=station,
            speed_limit=limits.astype(np.float64),
            lane_left=left,
            lane_right=-right,
            road_left=road_left,
            road_right=-road_right,
            stop_lines=tuple(stops),
        )
        return self._frames[chain]

    def _beyond(self, lane: Lane, sense: int) -> np.ndarray:
        """Returns points [k, 2] m along the lane beside one that ends or begins.

        Args:
          lane: the last of a chain, or the first.
          sense: 1: beyond its end, -1: before its start.
        """
        follows = lane.successors if sense > 0 else self.predecessors[lane.id]
        found = np.zeros((0, 2))
        if any(name in self.lanes for name in follows):
            return found
        end = lane.centre[::sense][-1]
        back = int(np.searchsorted(_arc(lane.centre[::-sense]), TURN_M))
        before = lane.centre[::-sense][min(back, len(lane.centre) - 1)]
        for beside in (lane.left, lane.right):
            if beside not in self.lanes:
                continue
            names = self.chain(beside, ())
            line = np.concatenate([self.lanes[name].centre for name in names])[::sense]
            arc = _arc(line)
            at = int(np.argmin(np.hypot(*(line - end).T)))
            s = np.arange(arc[at], min(arc[-1], arc[at] + AHEAD_M), LINE_STEP_M)
            if len(s) < 3 or len(s) <= len(found):
                continue
            place = np.stack([np.interp(s, arc, x) for x in line.T], axis=1)
            along = np.gradient(place, axis=0)
            along /= np.maximum(np.hypot(*along.T), 1e-9)[:, None]
            normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
            gone, off = s - s[0], float((end - place[0]) @ normal[0])
            # how the two come nearer over the last metres
            was = int(np.argmin(np.hypot(*(line - before).T)))
            turned = np.gradient(line, axis=0)[was] @ [[0.0, 1.0], [-1.0, 0.0]]
            turned = (before - line[was]) @ turned / max(np.hypot(*turned), 1e-9)
            slope = float(np.clip((off - turned) / TURN_M, -0.1, 0.1))
            off = off + slope * TURN_M * (1.0 - np.exp(-gone / TURN_M))
            # the nearest point may lie a little behind the end
            found = (place + off[:, None] * normal)[2:]
        return found[::sense]

    def _closed(
        self, lanes: list[Lane], side: str, parts: list[np.ndarray]
    ) -> np.ndarray:
        """Returns m by which the road is narrower on a side, where a lane has ended.

        `parts` are points of the line before the chain, of its `lanes`, and beyond.
        """
        found = [np.zeros(len(part)) for part in parts]
        for lane, number in ((lanes[0], 0), (lanes[-1], -1)):
            if len(parts[number]) and getattr(lane, side) not in self.lanes:
                end = -1 if number else 0
                width = lane.left_width[end] + lane.right_width[end]
                gone = _arc(parts[number] if number else parts[number][::-1])
                share = np.minimum(gone / CLOSING_M, 1.0)
                found[number] = width * (share if number else share[::-1])
        return np.concatenate(found)

    def _beside(self, lane: Lane, side: str) -> float:
        """Return width [m] of all same-direction lanes on one side."""
        total, name, seen = 0.0, getattr(lane, side), {lane.id}
        while name in self.lanes and name not in seen:
            seen.add(name)
            other = self.lanes[name]
            total += float(np.median(other.left_width + other.right_width))
            name = getattr(other, side)
        return total


def _project(line: ReferenceLine, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    s, l = project_points(line, points)
    return np.asarray(s, np.float64), np.asarray(l, np.float64)


def project(frame: LaneFrame, x: np.ndarray, y: np.ndarray) -> tuple:
    """Return station and lateral offset [m] of positions in the chain's frame."""
    return _project(frame.line, np.stack([x, y], axis=1))


def _arc(points: np.ndarray) -> np.ndarray:
    steps = np.hypot(*np.diff(points, axis=0).T)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _end_heading(points: np.ndarray, end: int) -> float:
    step = points[-1] - points[-2] if end == -1 else points[1] - points[0]
    return float(np.arctan2(step[1], step[0]))


def _wrap(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi
