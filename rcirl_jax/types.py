"""All core types on one page.

Axis legend, used everywhere: `B` batch of scenes, `K` candidates of a scene,
`T` = 18 points on the time axis, `N` = 16 obstacle slots, `P` = 128 points of
the station grid, `F` = 21 features, `G` scene tags.

Units are SI and radians. Station `s` [m] runs along the scene's reference line
with `s = 0` at the ego's centre at t = 0; lateral offset `l` [m] is positive to
the left of the reference line; `dl`, `ddl` are derivatives of `l` with respect
to `s`. Positions are those of box centres.

Traced types are `flax.struct.PyTreeNode` with static shapes, written for ONE
scene or ONE trajectory; batching adds leading axes by `vmap`. Host types
(`Track`, `Lane`, ..., `Recording`) are frozen dataclasses of numpy arrays.
"""

import dataclasses
import enum
from collections.abc import Mapping
from typing import Any

import flax.struct
import jax
import numpy as np

from rcirl_jax.units import Kind as Kind


class Decision(enum.IntEnum):
    """The human's dealing with an obstacle over the whole scene."""

    IGNORE = 0
    FOLLOW = 1
    YIELD = 2
    OVERTAKE = 3
    STOP = 4
    NUDGE_LEFT = 5  # the ego passes to the left of the obstacle
    NUDGE_RIGHT = 6


class Tag(enum.IntEnum):
    """Scene tags; index into `Scene.tags`."""

    STOPPING = 0
    STARTING = 1
    CRUISING = 2
    FOLLOWING = 3
    TURNING = 4
    LANE_CHANGE = 5
    YIELDING = 6
    OVERTAKING = 7
    NUDGING = 8
    CUT_IN = 9
    RED_LIGHT = 10
    STANDING = 11
    SIMULATED = 12  # an expert drove it in the simulator, not a person on a road


NUM_TAGS = len(Tag)


# --------------------------------------------------------------------- device


class Ego(flax.struct.PyTreeNode, kw_only=True):
    """The controlled car at t = 0, in the scene's Frenet frame; all scalars."""

    s: jax.Array  # [] m, station of the centre (0 by construction)
    l: jax.Array  # [] m, lateral offset of the centre
    dl: jax.Array  # [] 1, dl/ds
    ddl: jax.Array  # [] 1/m, d2l/ds2
    v: jax.Array  # [] m/s, speed along the reference line, >= 0
    a: jax.Array  # [] m/s^2, acceleration along the reference line
    length: jax.Array  # [] m
    width: jax.Array  # [] m


class Path(flax.struct.PyTreeNode, kw_only=True):
    """The reference line and the given path on the uniform station grid.

    Point p lies at station `p * STATION_STEP_M`. `l` is the given path (the
    paper's case study plans speed along it); it equals the lateral offset of
    the human's own path, continued along the lane after the recording ends.
    """

    kappa: jax.Array  # [P] 1/m, curvature of the reference line, left positive
    l: jax.Array  # [P] m, lateral offset of the given path
    # [P] m/s, what the planner may drive: posted, curve and the way to brake for what
    # comes (`geometry.limits.planning_limit`)
    speed_limit: jax.Array
    lane_left: jax.Array  # [P] m, lateral offset of the ego lane's left bound
    lane_right: jax.Array  # [P] m, of its right bound (negative)
    road_left: jax.Array  # [P] m, of the drivable area's left edge
    road_right: jax.Array  # [P] m, of its right edge


class Obstacles(flax.struct.PyTreeNode, kw_only=True):
    """Everything in the way, as boxes in the Frenet frame at the T times."""

    s_lower: jax.Array  # [N, T] m, station of the rear end
    s_upper: jax.Array  # [N, T] m, station of the front end
    l_lower: jax.Array  # [N, T] m, lateral offset of the right side
    l_upper: jax.Array  # [N, T] m, lateral offset of the left side
    speed: jax.Array  # [N, T] m/s, along the reference line, signed
    valid: jax.Array  # [N, T] bool, known at that time (STOP: demands a stop)
    kind: jax.Array  # [N] int32, `Kind`
    # what is measured at t = 0 and cannot be read from the boxes there
    a: jax.Array  # [N] m/s^2, acceleration along the reference line
    l_dot: jax.Array  # [N] m/s, lateral speed


class Scene(flax.struct.PyTreeNode, kw_only=True):
    """One planning frame: all that a candidate is judged against."""

    ego: Ego
    path: Path
    obstacles: Obstacles
    time_valid: jax.Array  # [T] bool, inside the recorded future; a prefix
    tags: jax.Array  # [G] bool, `Tag`


class Trajectory(flax.struct.PyTreeNode, kw_only=True):
    """A motion of the ego on the time axis `TIMES_S`."""

    s: jax.Array  # [T] m
    v: jax.Array  # [T] m/s, ds/dt
    a: jax.Array  # [T] m/s^2
    j: jax.Array  # [T] m/s^3
    l: jax.Array  # [T] m
    dl: jax.Array  # [T] 1, dl/ds
    ddl: jax.Array  # [T] 1/m, d2l/ds2


class Candidates(flax.struct.PyTreeNode, kw_only=True):
    """K sampled trajectories of one scene; every leaf of `trajectory` is [K, T]."""

    trajectory: Trajectory
    feasible: jax.Array  # [K] bool, inside the vehicle's limits
    family: jax.Array  # [K] int32, index into `sampling.FAMILIES`


class CandidateInfo(flax.struct.PyTreeNode, kw_only=True):
    """The facts about trajectories of B scenes that losses know besides values."""

    # m, the positive's mean distance to the recorded human; 0 unless it is the
    # nearest candidate
    human_distance: jax.Array  # [B]
    human_collides: jax.Array  # [B] bool, of the positive; a recorded curve's is False
    distance: jax.Array  # [B, K] m, the candidates' to the recorded human
    collides: jax.Array  # [B, K] bool, meets a body at a valid time
    breaks_rule: jax.Array  # [B, K] share of times over the limit; 1: ran a line
    # log of the proposal's density at each trajectory, up to a constant per scene
    human_density: jax.Array  # [B]
    density: jax.Array  # [B, K]
    # the own cost, negated and in its unit, where V is a residual on it; else 0
    human_own: jax.Array  # [B]
    own: jax.Array  # [B, K]


class Demonstration(flax.struct.PyTreeNode, kw_only=True):
    """A scene, what the human did in it, and the labels."""

    scene: Scene
    human: Trajectory
    decisions: jax.Array  # [N] int32, `Decision` per obstacle
    future_s: jax.Array  # [] s, length of the recorded future, <= 8
    s_at_5s: jax.Array  # [] m, the human's station at exactly t = 5 s
    vehicle: jax.Array  # [] int32, vehicle number inside the dataset
    recording: jax.Array  # [] int32, recording number inside the dataset
    group: jax.Array  # [] int32, vehicle-disjoint group number
    frame: jax.Array  # [] int32, frame number inside the recording


class Normaliser(flax.struct.PyTreeNode, kw_only=True):
    """x = (clip(f, lower, upper) - location) / scale, per feature."""

    lower: jax.Array  # [F] in the feature's unit
    upper: jax.Array  # [F]
    location: jax.Array  # [F]
    scale: jax.Array  # [F] > 0


# the reward's parameters, raw or effective: Flax's tree {"gamma", "point", ...} of
# `reward.network.RewardModel`
RewardParams = Mapping[str, Any]


# ----------------------------------------------------------------------- host


@dataclasses.dataclass(frozen=True, kw_only=True)
class Track:
    """One recorded road user. Arrays share the length n; t strictly increases.

    Positions are box centres in local metres (float64), heading in radians,
    counter-clockwise from +x.
    """

    id: str
    kind: Kind
    length: float  # m
    width: float  # m
    t: np.ndarray  # [n] s, float64
    x: np.ndarray  # [n] m, float64
    y: np.ndarray  # [n] m, float64
    heading: np.ndarray  # [n] rad, float64
    speed: np.ndarray  # [n] m/s, float64, as recorded
    # where the driver wants to end, if the log says so: (x, y) m
    destination: tuple[float, float] | None = None
    # s, when the log first saw it, where that is before t[0] (a log read in pieces)
    seen_since: float | None = None
    # s, (begin, end) of times at which no human drove, or nobody knows who did
    automated: tuple[tuple[float, float], ...] = ()
    # the log does not say length and width, and what they are taken for is a guess
    size_assumed: bool = False
    # s, (begin, end) of times at which the log names a leader of this driver that it
    # does not hold
    leader_missing: tuple[tuple[float, float], ...] = ()

    def is_human(self, begin: float, end: float) -> bool:
        """True if a human drove all the time from begin to end [s]."""
        return not any(low < end and begin < high for low, high in self.automated)

    @property
    def first_seen_s(self) -> float:
        """Returns the time [s] at which the log first saw it."""
        return float(self.t[0]) if self.seen_since is None else self.seen_since


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lane:
    """One lane: a polyline with widths and what is known of it."""

    id: str
    centre: np.ndarray  # [m, 2] m, float64, in driving direction
    left_width: np.ndarray  # [m] m, from centre to left bound, > 0
    right_width: np.ndarray  # [m] m, from centre to right bound, > 0
    speed_limit: float | None  # m/s, None where the log does not say
    successors: tuple[str, ...] = ()
    left: str | None = None  # neighbour in the same driving direction
    right: str | None = None
    stop_line: np.ndarray | None = None  # [2, 2] m, end points
    signal_ids: tuple[str, ...] = ()  # signals that govern the stop line
    stop_sign: bool = False  # the stop line demands a stop at any time
    # the log does not say the widths, and what they are taken for is a guess
    width_assumed: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class OpenRoads:
    """Lanes that a log does not give: they are estimated from what was driven.

    The recorder stood still, so that other recordings may show the same roads.
    """

    width: float  # m of a lane that has none beside it
    limit: float | None = None  # m/s of every lane, None where the log does not say
    why: str = ""  # no lanes are given, in words
    # for each track [n] texts, the log's own number of the lane; none: it has none
    labels: tuple[np.ndarray, ...] | None = None
    # of recordings of one file that surely show one place
    place: str = ""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Signal:
    """A traffic light as intervals of one colour each.

    `state[i]` holds from `start[i]` to `start[i + 1]` (the last to the end).
    """

    id: str
    start: np.ndarray  # [m] s, increasing, start[0] <= first track time
    state: tuple[str, ...]  # "red" | "yellow" | "green" | "off"
    is_recorded: bool = True  # False: a schedule written by a converter


@dataclasses.dataclass(frozen=True, kw_only=True)
class MissingAgent:
    """A road user known to be missing from the file (CommonRoad's ego).

    Its motion is bracketed by a start and an end; between them a straight
    line in time is assumed.
    """

    t0: float  # s
    t1: float  # s
    start: tuple[float, float]  # m
    end: tuple[float, float]  # m


@dataclasses.dataclass(frozen=True, kw_only=True)
class RowCounts:
    """Rows of a table that an importer read, and those of them that it dropped."""

    read: int = 0
    unreadable: int = 0  # a cell that cannot be read, or a needed one that is empty
    repeated: int = 0  # equal to another
    doubled: int = 0  # one road user, twice in one frame


@dataclasses.dataclass(frozen=True, kw_only=True)
class Recording:
    """One log, importer-independent. What every importer must produce."""

    name: str  # unique inside a dataset, e.g. the file's stem
    source: str  # where the data come from, for provenance
    licence: str  # licence of the DATA, not of this code
    rate_hz: float  # sampling rate of the tracks
    tracks: tuple[Track, ...]
    lanes: tuple[Lane, ...]
    signals: tuple[Signal, ...] = ()
    missing_agents: tuple[MissingAgent, ...] = ()
    # vehicle-disjoint group of the whole recording; None: grouped by time block
    group: str | None = None
    default_speed_limit: float = 29.06  # m/s, where a lane has none (65 mph)
    notes: tuple[str, ...] = ()  # shown in the quality report
    # of the table behind it, counted once where a file holds several recordings
    rows: RowCounts = dataclasses.field(default=RowCounts(), compare=False)
    # a piece of a log too long for memory: the log's name, and the times [s] from
    # the first to before the second at which scenes begin; tracks reach beyond
    piece_of: str | None = None
    scenes_within: tuple[float, float] | None = None
    # s on the log's own clock at t = 0, and m to add to places, where files of one
    # stream can be told by them; None: the log has no clock
    start_s: float | None = dataclasses.field(default=None, compare=False)
    origin: tuple[float, float] = dataclasses.field(default=(0.0, 0.0), compare=False)
    # lanes that are still to be estimated, of this and others
    open_roads: OpenRoads | None = dataclasses.field(default=None, compare=False)
    # share in (0, 1] of its input that is read after it, where the importer knows;
    # for the progress bar only, no part of what was recorded
    progress: float | None = dataclasses.field(default=None, compare=False)
    # why nothing of it is read, where such recordings are left out; "" otherwise
    refused: str = ""
