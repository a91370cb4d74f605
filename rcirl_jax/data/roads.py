"""Lanes of a log without a map, estimated from all of its tracks together.

Positions of drivers in one lane pile up on its middle. A lane is therefore a ridge of
the density of driven positions: from a place that many passed, it is traced both ways
along the mean direction of travel, and moved at each step to the weighted mean of the
positions across it (mean shift, Comaniciu and Meer 2002). Drivers who change lanes lie
between ridges and are outvoted, so that their paths make no lanes. Traced lanes are
smoothed as far as the positions allow, get their widths from the distance to the lane
beside them, and are cut into pieces where a neighbour begins or ends. Where one lane
ends, the lane on which its drivers go on is its successor.
"""

import dataclasses
import itertools
from collections.abc import Collection, Sequence

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import KDTree

from rcirl_jax.types import Kind, Lane, Track

STEP_M = 1.0  # m between samples of a track and points of a lane
SMOOTH_S = 0.8  # s, window over a track's positions
BASE_M = 3.0  # m to both sides over which a direction is taken
MOVING_MPS = 0.5  # m/s; below it positions only jitter
MAX_TRACKS = 1500  # tracks that are looked at, evenly over the log
WIDTH_M = 3.5  # m of a lane, where nothing tells it
WIDTHS_M = (2.4, 5.0)  # m between the middles of lanes that adjoin
KERNEL_M = 0.6  # m, spread of the weights across a lane
REACH_M = 1.3  # m across, beyond which a position says nothing of a lane
ALONG_M = 3.0  # m along a lane, likewise
SAME_WAY = np.cos(np.deg2rad(25.0))  # cosine of directions that are one way
COVERED = 0.45  # of a lane's width: positions nearer to a lane need no other
JOIN_M = 1.2  # m between lanes that have become one
BLEND_M = 24.0  # m in which a lane that joins another comes onto its middle
TAPER_M = 60.0  # m, likewise of one that ends beside it
PARALLEL_M = 15.0  # m, shortest way that lanes run side by side
PARALLEL = (0.75, 1.35)  # of a lane's width between the middles of lanes side by side
SPREAD_M = 0.36  # m that their distance varies by at most over PARALLEL_M
DRIFT_M = 0.2  # m nearer to the neighbour, from which a lane's end drifts onto it
DRIFTS_M = 100.0  # m of a lane's end that may
SHORTEST_M = (25.0, 15.0, 3.0)  # m of a lane that joins others at so many ends
MIN_PIECE_M = 15.0  # m, shortest piece that a neighbour's begin or end makes
EXTRA_M = 20.0  # m of lane beyond the first and last position
PIECE_M = 400.0  # m, longest piece
SMOOTHING_M = (30.0, 20.0, 14.0, 10.0, 7.0, 5.0, 3.5, 2.5)  # m, spreads that are tried
MOST_SHIFT_M = 0.12  # m that smoothing may move a lane
SURE = 0.9  # share of the way driven on lanes, below which they are doubtful
VOTES = 0.25  # share of a lane's drivers that makes a successor

# a track, and for each sample the log's own number of the lane, "" where it has none
Numbered = tuple[Track, np.ndarray]


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Samples:
    """Driven positions every STEP_M along all tracks."""

    place: np.ndarray  # [n, 2] m
    way: np.ndarray  # [n, 2] unit vector of travel
    track: np.ndarray  # [n] number of the track
    label: np.ndarray  # [n] the log's own lane, "" where it has none
    tree: KDTree

    def around(
        self, place: np.ndarray, way: np.ndarray, label: str
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns numbers, m along, m to the left of samples that go the same way."""
        near = np.array(self.tree.query_ball_point(place, ALONG_M + REACH_M), int)
        gap = self.place[near] - place
        along, left = gap @ way, gap @ [-way[1], way[0]]
        kept = (self.way[near] @ way > SAME_WAY) & (np.abs(along) < ALONG_M)
        kept &= np.abs(left) < REACH_M
        if label:
            kept &= self.label[near] == label
        return near[kept], along[kept], left[kept]


@dataclasses.dataclass(kw_only=True)
class _Ridge:
    """A traced lane, points every STEP_M or so in driving direction."""

    name: str
    label: str  # of the samples that it is made of, "": all
    line: np.ndarray  # [m, 2] m
    # number of the ridge that its first, last point joins; -1: none
    ends: list[int]
    support: float = 0.0  # tracks along it, in the middle


def _samples(
    tracks: Sequence[Track], labels: Sequence[np.ndarray] | None
) -> _Samples | None:
    vehicles = [n for n, track in enumerate(tracks) if track.kind == Kind.VEHICLE]
    if len(vehicles) > MAX_TRACKS:
        chosen = np.linspace(0, len(vehicles) - 1, MAX_TRACKS).round().astype(int)
        vehicles = [vehicles[n] for n in chosen]
    places, ways, owners, names = [], [], [], []
    for n in vehicles:
        track = tracks[n]
        place, way, rows = _thinned(track)
        if len(place) < 3:
            continue
        places.append(place)
        ways.append(way)
        owners.append(np.full(len(place), n))
        names.append(labels[n][rows] if labels else np.full(len(place), ""))
    if not places:
        return None
    place = np.concatenate(places)
    return _Samples(
        place=place,
        way=np.concatenate(ways),
        track=np.concatenate(owners),
        label=np.concatenate(names).astype(str),
        tree=KDTree(place),
    )


def _thinned(track: Track) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns smoothed positions [n, 2] every STEP_M of way, directions, and rows."""
    points = np.stack([track.x, track.y], axis=1)
    if len(points) < 5:
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, int)
    step = float(np.median(np.diff(track.t)))
    window = min(max(round(SMOOTH_S / step), 5), len(points))
    window -= 1 - window % 2
    # takes a quarter of a second, which other commands need not wait for
    from scipy.signal import savgol_filter

    smooth = np.asarray(savgol_filter(points, window, 2, axis=0))
    moves = np.hypot(*np.diff(smooth, axis=0).T) * (track.speed[1:] > MOVING_MPS)
    arc = np.append(0.0, np.cumsum(moves))
    if arc[-1] < 3.0 * STEP_M:
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, int)
    rows = np.unique(arc, return_index=True)[1]
    at = np.arange(0.0, arc[-1], STEP_M)

    def placed(s: np.ndarray) -> np.ndarray:
        s = np.clip(s, 0.0, arc[-1])
        return np.stack([np.interp(s, arc[rows], smooth[rows, n]) for n in (0, 1)], 1)

    chord = placed(at + BASE_M) - placed(at - BASE_M)
    way = chord / np.maximum(np.hypot(*chord.T), 1e-9)[:, None]
    last = np.searchsorted(arc[rows], at, side="right") - 1
    return placed(at), way, rows[last]


class _Tracer:
    """Finds the ridges of samples."""

    def __init__(self, samples: _Samples, width: float, fewest: int) -> None:
        self.samples, self.width, self.fewest = samples, width, fewest
        self.ridges: list[_Ridge] = []
        self.points, self.ways = np.zeros((0, 2)), np.zeros((0, 2))
        self.owner = np.zeros(0, int)  # ridge of each point

    def nearest(self, place: np.ndarray, way: np.ndarray) -> tuple[int, float]:
        """Returns the ridge nearest to a place, the same way, and how far it is, m."""
        if not len(self.points):
            return -1, np.inf
        apart = np.hypot(*(self.points - place).T)
        apart = np.where(self.ways @ way > SAME_WAY, apart, np.inf)
        n = int(np.argmin(apart))
        return int(self.owner[n]), float(apart[n])

    def settled(
        self, place: np.ndarray, way: np.ndarray, label: str, rounds: int = 1
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """Moves a place across to the ridge; returns it, the way, and tracks."""
        number = 0
        for _ in range(rounds):
            near, _along, left = self.samples.around(place, way, label)
            number = np.unique(self.samples.track[near]).size
            if number < self.fewest:
                return place, way, number
            weight = np.exp(-0.5 * (left / KERNEL_M) ** 2)
            mean = weight @ self.samples.way[near]
            place = place + (weight @ left / weight.sum()) * np.array([-way[1], way[0]])
            way = mean / max(float(np.hypot(*mean)), 1e-9)
        return place, way, number

    def trace(
        self, place: np.ndarray, way: np.ndarray, label: str, sense: float
    ) -> tuple[list[np.ndarray], list[int], int]:
        """Follows a ridge ahead or back: points, tracks, number of the one it joins."""
        points, counts = [], []
        begin = place
        while len(points) < 20_000:
            place, way, number = self.settled(place + sense * STEP_M * way, way, label)
            if number < self.fewest:
                return points, counts, -1
            joined, apart = self.nearest(place, way)
            if apart < JOIN_M:
                return points, counts, joined
            if len(points) > 20 and np.hypot(*(place - begin)) < STEP_M:
                return points, counts, len(self.ridges)  # a circle closes
            points.append(place)
            counts.append(number)
        return points, counts, -1

    def add(self, place: np.ndarray, way: np.ndarray, label: str) -> bool:
        """Traces the ridge through a place; False if it is no lane of its own."""
        place, way, number = self.settled(place, way, label, 8)
        if number < self.fewest:
            return False
        if self.nearest(place, way)[1] < COVERED * self.width:
            return False
        own = len(self.ridges)
        ahead, after, last = self.trace(place, way, label, 1.0)
        back, before, first = [], [], own
        if last != own:
            back, before, first = self.trace(place, way, label, -1.0)
        line = np.array([*back[::-1], place, *ahead])
        if (len(line) - 1) * STEP_M < SHORTEST_M[(first >= 0) + (last >= 0)]:
            return False
        if len(self.points):
            pairs = zip(line, _ways(line), strict=True)
            apart = [self.nearest(*pair)[1] for pair in pairs]
            if np.median(apart) < 0.65 * self.width:
                return False
        again = sum(ridge.label == label for ridge in self.ridges)
        name = label + (f"-{again}" if again else "") if label else f"lane-{again}"
        support = float(np.median([*before, number, *after]))
        ridge = _Ridge(
            name=name, label=label, line=line, ends=[first, last], support=support
        )
        self.ridges.append(ridge)
        self.points = np.concatenate([self.points, line])
        self.ways = np.concatenate([self.ways, _ways(line)])
        self.owner = np.concatenate([self.owner, np.full(len(line), own)])
        return True

    def run(self) -> None:
        """Finds all ridges, those that most drive on first."""
        samples = self.samples
        open_ = np.ones(len(samples.place), bool)
        octant = (
            np.round(np.arctan2(*samples.way.T[::-1]) / (np.pi / 4)).astype(int) % 8
        )
        _, names = np.unique(samples.label, return_inverse=True)
        cell = np.floor(samples.place).astype(int)
        cell -= cell.min(axis=0)
        size = cell.max(axis=0) + 1
        key = ((cell[:, 0] * size[1] + cell[:, 1]) * 8 + octant) * (names.max() + 1)
        _, key = np.unique(key + names, return_inverse=True)
        while True:
            counts = np.bincount(key[open_], minlength=key.max() + 1)
            best = int(np.argmax(counts))
            if counts[best] < self.fewest:
                return
            inside = np.flatnonzero((key == best) & open_)
            way = samples.way[inside].mean(axis=0)
            way /= max(float(np.hypot(*way)), 1e-9)
            place = samples.place[inside].mean(axis=0)
            added = self.add(place, way, str(samples.label[inside[0]]))
            open_[inside] = False
            if added:
                line = self.ridges[-1].line
                apart, at = _query(line, samples.place, COVERED * self.width)
                near = np.flatnonzero(np.isfinite(apart))
                same = np.sum(_ways(line)[at[near]] * samples.way[near], axis=1)
                same = same > SAME_WAY
                open_[near[same]] = False


def _query(
    line: np.ndarray, places: np.ndarray, reach: float = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Returns how far m each place is from a line's points, and which is nearest."""
    apart, at = KDTree(line).query(places, distance_upper_bound=reach)
    return np.asarray(apart), np.asarray(at)


def _ways(line: np.ndarray) -> np.ndarray:
    """Unit vectors [m, 2] along a line."""
    step = np.gradient(line, axis=0)
    return step / np.maximum(np.hypot(*step.T), 1e-9)[:, None]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns the sine between unit vectors [.., 2], above 0 where b is to the left."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _arc(line: np.ndarray) -> np.ndarray:
    return np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))


def _evenly(line: np.ndarray, step: float = STEP_M) -> np.ndarray:
    arc = _arc(line)
    at = np.linspace(0.0, arc[-1], max(round(arc[-1] / step), 2) + 1)
    return np.stack([np.interp(at, arc, x) for x in line.T], axis=1)


def _left_of(line: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the nearest point's number and m to the left of it, by place."""
    at = _query(line, places)[1]
    ways = _ways(line)[at]
    gap = places - line[at]
    return at, ways[:, 0] * gap[:, 1] - ways[:, 1] * gap[:, 0]


def _smoothed(line: np.ndarray) -> np.ndarray:
    """Returns a line smoothed as far as that moves it by MOST_SHIFT_M at most."""
    line = _evenly(line)
    ends = 2.0 * line[[0, -1]]
    for spread in SMOOTHING_M:
        pad = min(int(3.0 * spread / STEP_M) + 1, len(line) - 1)
        # both ends are mirrored through themselves, so that they stay
        whole = np.concatenate(
            [ends[0] - line[pad:0:-1], line, ends[1] - line[-2 : -pad - 2 : -1]]
        )
        smooth = gaussian_filter1d(whole, spread / STEP_M, axis=0)[
            pad : pad + len(line)
        ]
        if np.max(np.abs(_left_of(smooth, line)[1])) < MOST_SHIFT_M:
            return smooth
    return line


def _refined(ridge: _Ridge, samples: _Samples) -> None:
    """Moves a ridge to the median of the positions of those who drive along it."""
    for _ in range(2):
        line = _evenly(ridge.line)
        apart, at = _query(line, samples.place, 2.0 * REACH_M)
        near = np.flatnonzero(np.isfinite(apart))
        ways, at = _ways(line), at[near]
        gap, way = samples.place[near] - line[at], ways[at]
        left = way[:, 0] * gap[:, 1] - way[:, 1] * gap[:, 0]
        along = np.sum(way * samples.way[near], axis=1)
        kept = (np.abs(left) < REACH_M) & (along > np.cos(np.deg2rad(6.0)))
        if ridge.label:
            kept &= samples.label[near] == ridge.label
        at, left = at[kept], left[kept]
        order = np.argsort(at, kind="stable")
        at, left = at[order], left[order]
        low = np.searchsorted(at, np.arange(len(line)) - 4)
        high = np.searchsorted(at, np.arange(len(line)) + 5)
        shift = np.array(
            [
                np.median(left[a:b]) if b > a else 0.0
                for a, b in zip(low, high, strict=True)
            ]
        )
        shift = gaussian_filter1d(shift, 4.0, mode="nearest")
        moved = line + shift[:, None] * np.stack([-ways[:, 1], ways[:, 0]], axis=1)
        ridge.line = _smoothed(moved)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Link:
    """The end of one ridge that leads into another, or the start that leaves it."""

    ridge: int
    is_end: bool
    other: int
    at: int  # point of the other where the two are one


def _led_onto(ridge: _Ridge, is_end: bool, target: np.ndarray, blend: float) -> int:
    """Leads an end of a ridge's line onto the middle of another, within `blend` m.

    Returns:
      The target's point at which the two are one.
    """
    sense = 1 if is_end else -1
    line, target = ridge.line[::sense], target[::sense]
    (begin,), (left,) = _left_of(target, line[-1:])
    slope = float(_cross(_ways(target)[begin], _ways(line)[-1]))
    if left * slope < 0.0:  # as long as it takes at the angle at which they meet
        blend = float(np.clip(2.0 * abs(left / slope), SHORTEST_M[2], blend))
    last = min(begin + round(blend / STEP_M), len(target) - 1)
    share = np.linspace(0.0, 1.0, last - begin + 1)[1:, None]
    ways = _ways(target)[begin + 1 : last + 1]
    normal = np.stack([-ways[:, 1], ways[:, 0]], axis=1)
    rest = left * (1.0 - share * share * (3.0 - 2.0 * share))
    onto = target[begin + 1 : last + 1] + rest * normal
    ridge.line = np.concatenate([line, onto])[::sense]
    return int(last if is_end else len(target) - 1 - last)


def _ends_beside(
    ridge: _Ridge, is_end: bool, target: np.ndarray, width: float, samples: _Samples
) -> bool:
    """Ends a ridge beside another one if the two run side by side before.

    Where it drifts onto the other, drivers change lanes: from there it goes along the
    other, as far as some still drive on it and EXTRA_M beyond.

    Returns:
      False if the two do not run side by side; then nothing is changed.
    """
    sense = 1 if is_end else -1
    line, target = ridge.line[::sense], target[::sense]
    first = max(len(line) - round((DRIFTS_M + PARALLEL_M) / STEP_M), 0)
    at, left = _left_of(target, line[first:])
    is_beside = (at > 0) & (at < len(target) - 1)
    is_beside &= np.sum(_ways(target)[at] * _ways(line)[first:], axis=1) > np.cos(0.15)
    low, high = PARALLEL[0] * width, PARALLEL[1] * width
    is_beside &= (np.abs(left) > low) & (np.abs(left) < high)
    size = round(PARALLEL_M / STEP_M)
    for end in range(len(at), size - 1, -1):  # the last way side by side
        begin = end - size
        if is_beside[begin:end].all() and np.ptp(left[begin:end]) < SPREAD_M:
            break
    else:
        return False
    others = np.flatnonzero(~is_beside[:begin])
    begin = int(others[-1]) + 1 if others.size else 0
    gap = float(np.median(left[begin:end]))
    if np.any(np.abs(left[end:]) > high):  # it leaves the other
        return False
    close = is_beside[begin:] & (np.abs(left[begin:] - gap) < DRIFT_M)
    end = begin + np.flatnonzero(close)[-1] + 1
    onto = slice(at[end - 1] + 1, at[end - 1] + 1 + round(2.0 * DRIFTS_M / STEP_M))
    ways = _ways(target)[onto]
    back = np.exp(-np.arange(len(ways)) / 10.0)[:, None]
    normal = np.stack([-ways[:, 1], ways[:, 0]], axis=1)
    beyond = target[onto] + (gap + (left[end - 1] - gap) * back) * normal
    beyond = beyond[: _driven(beyond, sense * ways, samples) + round(EXTRA_M / STEP_M)]
    ridge.line = _smoothed(np.concatenate([line[: first + end], beyond])[::sense])
    return True


def _driven(line: np.ndarray, ways: np.ndarray, samples: _Samples) -> int:
    """Returns the number of a line's first points that two or more drive along."""
    if not len(line):
        return 0
    apart, at = _query(line, samples.place, JOIN_M)
    near = np.flatnonzero(np.isfinite(apart))
    near = near[np.sum(ways[at[near]] * samples.way[near], axis=1) > SAME_WAY]
    size = round(2.0 * ALONG_M / STEP_M)
    there = np.unique(np.stack([at[near] // size, samples.track[near]]), axis=1)[0]
    alone = np.bincount(there, minlength=len(line) // size + 1) < 2
    return size * int(np.argmax(alone)) if alone.any() else len(line)


def _on(
    ridges: Sequence[_Ridge], samples: _Samples, width: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the ridge [n] that each sample is on, -1: none, and its point there."""
    points = np.concatenate([ridge.line for ridge in ridges])
    ways = np.concatenate([_ways(ridge.line) for ridge in ridges])
    sizes = [len(ridge.line) for ridge in ridges]
    owner = np.repeat(np.arange(len(ridges)), sizes)
    number = np.concatenate([np.arange(size) for size in sizes])
    count = min(8, len(points))
    apart, at = KDTree(points).query(samples.place, k=count)
    apart, at = apart.reshape(-1, count), at.reshape(-1, count)
    same = np.einsum("nkc,nc->nk", ways[at], samples.way) > SAME_WAY
    cost = np.where(same & (apart < 0.5 * width), apart, np.inf)
    best = np.argmin(cost, axis=1)
    rows = np.arange(len(at))
    found = np.isfinite(cost[rows, best])
    at = at[rows, best]
    return np.where(found, owner[at], -1), number[at]


def _votes(
    ridges: Sequence[_Ridge],
    number: int,
    is_end: bool,
    samples: _Samples,
    on: tuple[np.ndarray, np.ndarray],
) -> int:
    """Returns the ridge on which drivers go on beyond an end; -1: on none."""
    ridge, at = on
    size = len(ridges[number].line)
    near = at >= size - 40.0 / STEP_M if is_end else at < 40.0 / STEP_M
    drivers = np.unique(samples.track[(ridge == number) & near])
    went = []
    for driver in drivers:
        rows = np.flatnonzero(samples.track == driver)
        rows = rows if is_end else rows[::-1]
        own = np.flatnonzero(ridge[rows] == number)
        later = ridge[rows[own[-1] + 1 :]]
        later = later[later >= 0]
        went += later[:1].tolist()
    if len(went) < max(2.0, VOTES * len(drivers)):
        return -1
    return int(np.bincount(went).argmax())


def _beyond_a_gap(ridges: Sequence[_Ridge], number: int) -> int:
    """Returns the ridge that begins straight ahead of a ridge's end; -1: none."""
    line = ridges[number].line
    way = _ways(line)[-1]
    for other, ridge in enumerate(ridges):
        gap = ridge.line[0] - line[-1]
        along, across = float(gap @ way), float(_cross(way, gap))
        turned = float(_ways(ridge.line)[0] @ way)
        is_ahead = 0.0 < along < TAPER_M and abs(across) < JOIN_M + 0.05 * along
        if other != number and is_ahead and turned > np.cos(0.1):
            return other
    return -1


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Beside:
    """The ridges beside each point of one, to the left and to the right."""

    ridge: np.ndarray  # [2, m] number; -1: none
    point: np.ndarray  # [2, m] of that ridge
    apart: np.ndarray  # [2, m] m; inf: none


def _beside(ridges: Sequence[_Ridge], width: float) -> list[_Beside]:
    """Returns the neighbours of every ridge: the same way, a width apart or so."""
    found = []
    for number, ridge in enumerate(ridges):
        ways, size = _ways(ridge.line), len(ridge.line)
        names, points = np.full((2, size), -1), np.zeros((2, size), int)
        apart = np.full((2, size), np.inf)
        for other, their in enumerate(ridges):
            if other == number:
                continue
            gap, at = _query(their.line, ridge.line, 1.6 * width)
            near = np.flatnonzero((gap > 0.6 * width) & np.isfinite(gap))
            if not near.size:
                continue
            at, line = at[near], ridges[other].line
            same = np.sum(_ways(line)[at] * ways[near], axis=1) > np.cos(0.15)
            toward = line[at] - ridge.line[near]
            left = ways[near, 0] * toward[:, 1] - ways[near, 1] * toward[:, 0]
            same &= np.abs(left) > 0.95 * gap[near]  # beside, not ahead
            for side, is_there in ((0, left > 0.0), (1, left < 0.0)):
                rows = near[same & is_there]
                better = gap[rows] < apart[side, rows]
                rows = rows[better]
                names[side, rows], apart[side, rows] = other, gap[rows]
                points[side, rows] = at[same & is_there][better]
        found.append(_Beside(ridge=names, point=points, apart=apart))
    return found


def _spacing(beside: Sequence[_Beside]) -> float:
    """Returns m between the middles of lanes that adjoin; NaN where none do."""
    apart = np.concatenate([x.apart[np.isfinite(x.apart)] for x in beside])
    return float(np.median(apart)) if apart.size else np.nan


def _changes(beside: _Beside) -> list[int]:
    """Returns the points where a neighbour begins or ends for good."""
    found = []
    for names in beside.ridge:
        runs = [0, *(np.flatnonzero(np.diff(names)) + 1).tolist(), len(names)]
        # a neighbour lost for less than MIN_PIECE_M is not lost
        long = [
            (a, names[a])
            for a, b in itertools.pairwise(runs)
            if (b - a) * STEP_M >= MIN_PIECE_M
        ]
        found += [a for (_, x), (a, y) in itertools.pairwise(long) if x != y]
    return found


def _on_those(
    ridges: Sequence[_Ridge], ended: Collection[int], width: float
) -> set[int]:
    """Returns the ridges that lie on a longer one of `ended`: strays of its drivers."""
    found = set()
    for number, ridge in enumerate(ridges):
        for other in {*ended} - {number}:
            line = ridges[other].line
            if len(line) <= len(ridge.line):
                continue
            apart, at = _query(line, ridge.line)
            same = np.sum(_ways(line)[at] * _ways(ridge.line), axis=1) > SAME_WAY
            if np.median(np.where(same, apart, np.inf)) < 0.65 * width:
                found.add(number)
    return found


def _connected(
    ridges: list[_Ridge], samples: _Samples, width: float
) -> tuple[set[tuple[int, bool]], list[_Link]]:
    """Leads the lines of ridges onto those that follow, or ends them beside these.

    Returns:
      (ridges that end beside another, and whether it is their end; the links).
    """
    spacing = _spacing(_beside(ridges, width))
    apart = width if np.isnan(spacing) else float(np.clip(spacing, *WIDTHS_M))
    on, known = _on(ridges, samples, width), [ridge.line for ridge in ridges]
    found = [dataclasses.replace(ridge) for ridge in ridges]
    ended: set[tuple[int, bool]] = set()
    leads: list[tuple[int, bool, int, float]] = []
    for number, ridge in enumerate(found):
        for is_end in (True, False):
            other, blend = ridge.ends[is_end], BLEND_M
            if other < 0:
                other, blend = _votes(found, number, is_end, samples, on), TAPER_M
            beyond = _beyond_a_gap(found, number) if is_end else -1
            if other >= 0 and other != number:
                own = dataclasses.replace(ridges[number])
                if _ends_beside(own, is_end, known[other], apart, samples):
                    other = beyond
                    if beyond < 0:
                        ridges[number].line = own.line
                        ended.add((number, is_end))
            elif other < 0:
                other = beyond
            if other >= 0:
                leads.append((number, is_end, other, blend))
    if short := _on_those(ridges, {number for number, _ in ended}, apart):
        kept = [number for number in range(len(found)) if number not in short]
        new = {old: number for number, old in enumerate(kept)}
        ridges[:] = [
            dataclasses.replace(found[n], ends=[new.get(x, -1) for x in found[n].ends])
            for n in kept
        ]
        return _connected(ridges, samples, width)
    known = [ridge.line for ridge in ridges]
    joins = []
    for number, is_end, other, blend in leads:
        if other == number:  # a circle
            place = known[number][0 if is_end else -1]
        else:
            at = _led_onto(ridges[number], is_end, known[other], blend)
            place = known[other][at]
        joins.append(place)
    links = []
    for (number, is_end, other, _), place in zip(leads, joins, strict=True):
        at = int(_query(ridges[other].line, place)[1])
        links.append(_Link(ridge=number, is_end=is_end, other=other, at=at))
    return ended, links


def _pieces(
    ridges: Sequence[_Ridge],
    beside: Sequence[_Beside],
    links: Sequence[_Link],
    ended: Collection[tuple[int, bool]],
    width: float,
    limit: float | None,
) -> tuple[Lane, ...]:
    """Cuts ridges where others join, leave, begin or end beside them: lanes."""
    last = [len(ridge.line) - 1 for ridge in ridges]
    fixed = [
        {link.at for link in links if link.other == n} | {0, end}
        for n, end in enumerate(last)
    ]

    def cut(number: int, at: int) -> None:
        """Cuts a ridge unless it is cut near there, and those beside it likewise."""
        if min(abs(at - x) for x in fixed[number]) * STEP_M >= MIN_PIECE_M:
            fixed[number].add(at)
            beside_too(number, at)

    def beside_too(number: int, at: int) -> None:
        own = beside[number]
        for other, point in zip(own.ridge[:, at], own.point[:, at], strict=True):
            if other >= 0:
                cut(int(other), int(point))

    for number in range(len(ridges)):
        for at in sorted(fixed[number] - {0, last[number]}):
            beside_too(number, at)
        steps = range(0, last[number], round(PIECE_M / STEP_M))
        for at in [*_changes(beside[number]), *steps]:
            cut(number, at)
    cuts = [sorted(some) for some in fixed]

    def name(number: int, piece: int) -> str:
        only = len(cuts[number]) == 2
        return ridges[number].name + ("" if only else f".{piece}")

    def piece_at(number: int, point: int) -> str:
        inner = cuts[number][1:-1]
        return name(number, int(np.searchsorted(inner, point, side="right")))

    lanes = []
    for number, ridge in enumerate(ridges):
        own = beside[number]
        gaps = np.where(np.isfinite(own.apart), own.apart, width)
        half = 0.5 * np.stack([gaussian_filter1d(x, 5.0, mode="nearest") for x in gaps])
        mine = cuts[number]
        for piece, (a, b) in enumerate(itertools.pairwise(mine)):
            successors = [name(number, piece + 1)] if b != mine[-1] else []
            for link in links:
                if link.is_end and link.ridge == number and b == mine[-1]:
                    successors.append(piece_at(link.other, link.at))
                if not link.is_end and link.other == number and link.at == b:
                    successors.append(name(link.ridge, 0))
            names: list[str | None] = []
            for side in (0, 1):
                there = own.ridge[side, a : b + 1]
                known = there[there >= 0]
                if known.size < 0.6 * there.size:
                    names.append(None)
                    continue
                most = int(np.bincount(known).argmax())
                rows = a + np.flatnonzero(there == most)
                point = own.point[side, rows[len(rows) // 2]]
                names.append(piece_at(most, int(point)))
            line, widths = ridge.line[a : b + 1], half[:, a : b + 1]
            closed = {*ended} | {(link.ridge, link.is_end) for link in links}
            free = [
                a == 0 and (number, False) not in closed,
                b == mine[-1] and (number, True) not in closed,
            ]
            line, widths = _longer(line, widths, *free)
            lanes.append(
                Lane(
                    id=name(number, piece),
                    centre=line,
                    left_width=widths[0],
                    right_width=widths[1],
                    speed_limit=limit,
                    successors=tuple(dict.fromkeys(successors)),
                    left=names[0],
                    right=names[1],
                    width_assumed=None in names,
                )
            )
    return tuple(lanes)


def _longer(
    line: np.ndarray, widths: np.ndarray, before: bool, after: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Extends a lane straight by EXTRA_M, so that nobody ends at its very end."""
    back = min(len(line) - 1, round(10.0 / STEP_M))
    parts, half = [line], [widths]
    if before:
        way = line[0] - line[back]
        parts.insert(0, line[:1] + EXTRA_M * way / np.hypot(*way))
        half.insert(0, widths[:, :1])
    if after:
        way = line[-1] - line[-1 - back]
        parts.append(line[-1:] + EXTRA_M * way / np.hypot(*way))
        half.append(widths[:, -1:])
    return np.concatenate(parts), np.concatenate(half, axis=1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Roads:
    """Lanes that were found, and how well they explain the log."""

    lanes: tuple[Lane, ...]
    explained: float  # share of the way driven that lies on one of them
    width: float  # m between lanes that adjoin, NaN where none do
    is_numbered: bool = False  # they are made of the log's lane numbers too
    files: int = 1  # of whose tracks they are made

    def explains(self, tracks: Sequence[Track]) -> float:
        """Returns the share of the way driven by tracks that lies on the lanes."""
        samples = _samples(tracks, None)
        if samples is None or not self.lanes:
            return 0.0
        ridges = [
            _Ridge(name=x.id, label="", line=_evenly(x.centre), ends=[-1, -1])
            for x in self.lanes
        ]
        width = WIDTH_M if np.isnan(self.width) else self.width
        return float(np.mean(_on(ridges, samples, width)[0] >= 0))

    def moved(self, by: np.ndarray) -> "Roads":
        """Returns the same in another frame.

        Args:
          by: [2] m, added to every place.
        """
        lanes = [dataclasses.replace(x, centre=x.centre + by) for x in self.lanes]
        return dataclasses.replace(self, lanes=tuple(lanes))

    @property
    def note(self) -> str:
        """Says what was found, in a line, and what to do where that is not enough."""
        names = {lane.id.rpartition(".")[0] for lane in self.lanes}
        apart = "" if np.isnan(self.width) else f", {self.width:.1f} m apart"
        given = "only numbers of lanes" if self.is_numbered else "no lanes"
        of = " and their numbers" if self.is_numbered else ""
        of += f" of {self.files} files" if self.files > 1 else ""
        remedy = "" if self.explained >= SURE else "; give lanes where they are wrong"
        return (
            f"{given} given; {len(names)} estimated from all tracks{of}{apart}; "
            f"{self.explained:.0%} of the way driven lies on them{remedy}"
        )


def roads_of_sites(
    files: Sequence[Sequence[Numbered]], *, width: float = WIDTH_M, limit: float | None
) -> list[Roads]:
    """Estimates lanes from all files of one site together, in one frame.

    Files are of one site if the lanes of the one with most driving explain the others.

    Args:
      files: of each the tracks, and for each the lane numbers of the log.
      width: m, as of `roads_from_tracks`.
      limit: m/s, likewise.

    Returns:
      The roads of each file's site.
    """

    def roads_of(members: Sequence[int]) -> Roads:
        driven = [one for number in members for one in files[number]]
        tracks, labels = [x for x, _ in driven], [label for _, label in driven]
        return roads_from_tracks(tracks, width=width, limit=limit, labels=labels)

    order = sorted(range(len(files)), key=lambda n: -sum(x.t.size for x, _ in files[n]))
    sites: list[tuple[list[int], Roads]] = []
    for number in order:
        for members, roads in sites:
            if roads.explains([track for track, _ in files[number]]) >= SURE:
                members.append(number)
                break
        else:
            sites.append(([number], roads_of([number])))
    found: dict[int, Roads] = {}
    for members, alone in sites:
        roads = roads_of(members) if len(members) > 1 else alone
        found |= dict.fromkeys(members, dataclasses.replace(roads, files=len(members)))
    return [found[number] for number in range(len(files))]


def roads_from_tracks(
    tracks: Sequence[Track],
    *,
    width: float = WIDTH_M,
    limit: float | None = None,
    labels: Sequence[np.ndarray] | None = None,
) -> Roads:
    """Estimates the lanes that vehicles drove on.

    Args:
      tracks: all of a site, in m; others than vehicles make no lanes.
      width: m of a lane that has none beside it.
      limit: m/s of every lane, or None.
      labels: for each track [n] texts, the log's own number of the lane; "" where it
        says none. Lanes then have these names, and are made of these positions.

    Returns:
      The lanes, each with its neighbours and successors.
    """
    samples = _samples(tracks, labels)
    if samples is None:
        return Roads(lanes=(), explained=0.0, width=np.nan)
    fewest = 2 if np.unique(samples.track).size >= 20 else 1
    tracer = _Tracer(samples, width, fewest)
    tracer.run()
    ridges = tracer.ridges
    if not ridges:
        return Roads(lanes=(), explained=0.0, width=np.nan)
    for ridge in ridges:
        _refined(ridge, samples)
    ended, links = _connected(ridges, samples, width)
    beside = _beside(ridges, width)
    spacing = _spacing(beside)
    found = width if np.isnan(spacing) else float(np.clip(spacing, *WIDTHS_M))
    on, _ = _on(ridges, samples, found)
    return Roads(
        lanes=_pieces(ridges, beside, links, ended, found, limit),
        explained=float(np.mean(on >= 0)),
        width=spacing,
        is_numbered=bool(np.any(samples.label != "")),
    )
