"""Manoeuvres of the human around an obstacle, by the places of both over time.

Each manoeuvre is something that both boxes did, not a side of a graph:

    overtaken   ahead of the human, later behind it, along the path; in its line
    follows     ahead on the human's path for two seconds, the same way
    yields      comes onto the path ahead, and the human brakes or falls back for it
    nudged      slower, beside; the human moves aside for it within the lane
    cuts_in     changes lane into the gap ahead of the human

"Ahead" and "behind" are of bumper to bumper, "abreast" is neither; all of them hold
while both are recorded. Who is passed in a neighbouring lane is none of these: lines
that move at different speeds do not overtake (Vienna Convention on Road Traffic
1968, article 11.6).

Shapes: any leading axes (scenes), [N] obstacles, [T] times, [P] stations of the path.
"""

import dataclasses

import numpy as np

from rcirl_jax.types import Kind
from rcirl_jax.units import STATION_STEP_M, TIMES_S

LATERAL_BUFFER_M = 0.2  # m beside the human's box that is still its way; features too
LANE_WIDTH_M = (3.0, 4.0)  # m, of the lane at the frame, where a map says less or more
STANDING_MPS = 0.5  # m/s
MOVING_MPS = 2.0  # m/s
# follow: Apollo's SpeedDecider; a followed car blocks from the start
FOLLOW_ONSET_S = 0.5  # s
FOLLOW_DURATION_S = 2.0  # s, at least
CROSSING_M = 2.0  # m to the side, and more than along the path: it crosses
TO_THE_END_S = 1.0  # s, of one that is there until the recording ends
# yield: a reaction to who comes onto the path, and who is near enough to need one
REACTION_S = (1.5, 4.0)  # s before and after it comes: drivers foresee a cut-in
LEAVES_S = 1.0  # s after it has left the path: the reaction time (UN R157: 0.75 s)
BRAKES_MPS2 = 0.4  # m/s^2; rolling without gas is slower by 0.2 to 0.7
BRAKES_MPS = 1.0  # m/s of speed given up
FALLS_BACK_MPS = 0.5  # m/s given up while the gap grows: beyond noise of positions
FALLS_BACK_M = 2.0  # m by which it grows
NEAR_S, NEAR_M = 4.0, 5.0  # s of the human's speed and m to the bumper
OWN_MOVE_M = 0.5  # m sideways, at least, of who comes; position noise is less
# nudge
NUDGE_MOVE_M = 0.4  # m, beyond what drivers drift in their lane
NUDGE_WITHIN_S = 4.0  # s before being abreast
NUDGE_CLEARANCE_M = 1.2  # m; two cars in the middle of 3.5 m lanes leave 1.7 m
NUDGE_RANGE_M = 3.0  # m, as in features.columns
NUDGE_SPEED_MPS = 2.0  # m/s faster than the obstacle to pass it
# cut-in: near as seen from the human (UN R157 looks at 60 m at 130 km/h: 1.7 s)
CUT_IN_S, CUT_IN_M = 3.0, 5.0  # s of the human's speed and m to the bumper
NEXT_LANE = 2.0  # lanes aside, at most, from which one changes into the human's
OVERTAKEN_LINE = 0.6  # lanes aside, at most, of one in the line that the human leaves

# a station that jumps: farther from what the speeds at both ends make of it than
JUMP_M, JUMP_MPS = 10.0, 3.0  # m, and m/s of the time between

BOUNDS = ("s_lower", "s_upper", "l_lower", "l_upper")
# what manoeuvres are read from
FIELDS = (
    *(f"obstacles.{name}" for name in (*BOUNDS, "speed", "valid", "kind")),
    *("human.s", "human.l", "path.l", "path.lane_left", "path.lane_right"),
    *("path.road_left", "path.road_right"),
    *("ego.length", "ego.width", "time_valid"),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Meetings:
    """The place of each obstacle [..., N] beside the human at each time [..., N, T]."""

    seen: np.ndarray  # bool, a body that is recorded, as the human is
    ahead: np.ndarray  # bool, bumper before bumper
    behind: np.ndarray  # bool
    abreast: np.ndarray  # bool
    blocks: np.ndarray  # bool, on the human's own path, at the obstacle's station
    aside: np.ndarray  # m from the human's box to the obstacle's, across; < 0: overlap
    to_left: np.ndarray  # bool, the obstacle is to the left of the human
    gap: np.ndarray  # m from the human's front bumper to the obstacle's rear one
    s: np.ndarray  # m, the obstacle's middle
    l: np.ndarray  # m
    path_l: np.ndarray  # m, the human's own path at the obstacle's station
    on_road: np.ndarray  # bool, its middle is on a lane that goes the human's way
    speed: np.ndarray  # m/s, of the obstacle along the path
    human_l: np.ndarray  # [..., 1, T] m
    human_speed: np.ndarray  # [..., 1, T] m/s
    human_seen: np.ndarray  # [..., 1, T] bool, the human is recorded
    lane: np.ndarray  # [..., 1, 1] m, width of the lane at the frame
    human_off: np.ndarray  # [..., 1, T] m, the human's box beyond the frame's lane

    @property
    def half_lane(self) -> np.ndarray:
        """[..., 1, 1] m."""
        return 0.5 * self.lane

    @property
    def on_path(self) -> np.ndarray:
        """[..., N, T] bool, ahead on the human's own path, its middle in that lane."""
        in_lane = np.abs(self.l - self.path_l) < self.half_lane
        return self.blocks & self.ahead & in_lane

    def in_line(self, lanes: float) -> np.ndarray:
        """[..., N, T] bool, its middle within so many lanes beside the human's."""
        return self.seen & (np.abs(self.l - self.human_l) < lanes * self.lane)


def human_speed(scenes: dict) -> np.ndarray:
    """[..., T] m/s."""
    return np.gradient(scenes["human.s"], TIMES_S, axis=-1)


def meetings(scenes: dict) -> Meetings:
    """Return all obstacles beside the human; `scenes` has `FIELDS`."""
    s_lower, s_upper, l_lower, l_upper = (scenes[f"obstacles.{x}"] for x in BOUNDS)
    kind = scenes["obstacles.kind"]
    human_s, human_l = (scenes[f"human.{x}"][..., None, :] for x in ("s", "l"))
    half_length, half_width = (
        0.5 * np.asarray(scenes[f"ego.{x}"])[..., None, None]
        for x in ("length", "width")
    )
    body = (kind >= Kind.VEHICLE) & (kind <= Kind.STATIC)
    seen = scenes["obstacles.valid"] & scenes["time_valid"][..., None, :]
    seen = seen & body[..., None]
    ahead = seen & (s_lower > human_s + half_length)
    behind = seen & (s_upper < human_s - half_length)
    s, l = 0.5 * (s_lower + s_upper), 0.5 * (l_lower + l_upper)
    path_l = _path_at(scenes["path.l"], s)
    lane = lane_width(scenes)[..., None, None]
    return Meetings(
        seen=seen,
        ahead=ahead,
        behind=behind,
        abreast=seen & ~ahead & ~behind,
        blocks=seen & blocking(scenes),
        aside=np.maximum(l_lower - human_l, human_l - l_upper) - half_width,
        to_left=l > human_l,
        gap=s_lower - human_s - half_length,
        s=s,
        l=l,
        path_l=path_l,
        on_road=(l < _path_at(scenes["path.road_left"], s))
        & (l > _path_at(scenes["path.road_right"], s)),
        speed=scenes["obstacles.speed"],
        human_l=human_l,
        human_speed=human_speed(scenes)[..., None, :],
        human_seen=scenes["time_valid"][..., None, :],
        lane=lane,
        human_off=np.abs(human_l) + half_width - 0.5 * lane,
    )


def blocking(scenes: dict) -> np.ndarray:
    """[..., N, T] bool: the obstacle's box overlaps the human's own path laterally."""
    s_lower, s_upper, l_lower, l_upper = (scenes[f"obstacles.{x}"] for x in BOUNDS)
    path_l = _path_at(scenes["path.l"], 0.5 * (s_lower + s_upper))
    reach = 0.5 * np.asarray(scenes["ego.width"])[..., None, None] + LATERAL_BUFFER_M
    beside = np.maximum(l_lower - path_l, path_l - l_upper)
    is_there = (scenes["obstacles.kind"] != Kind.NONE)[..., None]
    return scenes["obstacles.valid"] & (beside < reach) & is_there


def lane_width(scenes: dict) -> np.ndarray:
    """[...] m, of the lane at the frame."""
    width = scenes["path.lane_left"][..., 0] - scenes["path.lane_right"][..., 0]
    return np.clip(width, *LANE_WIDTH_M)


def _path_at(path: np.ndarray, s: np.ndarray) -> np.ndarray:
    """[..., N, T] m, of a number [..., P] along the human's path at stations s.

    Linear between the stations of the path, constant beyond its ends.
    """
    shape, last = s.shape, path.shape[-1] - 1
    place = np.clip(s / STATION_STEP_M, 0.0, last).reshape(*path.shape[:-1], -1)
    before = np.minimum(place.astype(np.int64), last - 1)
    low, high = (
        np.take_along_axis(path, index, axis=-1) for index in (before, before + 1)
    )
    return (low + (place - before) * (high - low)).reshape(shape)


def at(values: np.ndarray, index: np.ndarray) -> np.ndarray:
    """[..., N], the values [..., N or 1, T] at one time `index` [..., N] of each."""
    wide = np.broadcast_to(values, (*index.shape, values.shape[-1]))
    return np.take_along_axis(wide, index[..., None], axis=-1)[..., 0]


def first(holds: np.ndarray) -> np.ndarray:
    """[..., N] index of the first time at which it holds; 0 where it never does."""
    return np.argmax(holds, axis=-1)


def last(holds: np.ndarray) -> np.ndarray:
    """[..., N] index of the last time at which it holds; the end where never."""
    return holds.shape[-1] - 1 - np.argmax(holds[..., ::-1], axis=-1)


def _around(index: np.ndarray, before_s: float, after_s: float) -> np.ndarray:
    """[..., N, T] bool, times from `before_s` before to `after_s` after an index."""
    apart = TIMES_S - TIMES_S[index][..., None]
    return (apart >= -before_s) & (apart <= after_s)


# ------------------------------------------------------------------ manoeuvres


def overtaken(m: Meetings) -> np.ndarray:
    """[..., N] bool: ahead, later behind, and in the human's line before or after.

    It moves the same way, and is at most a lane aside when it is passed: who has
    turned off by then, crosses or comes towards the human is not overtaken.
    """
    passed = m.behind & np.logical_or.accumulate(m.ahead, axis=-1)
    before = m.on_path | (m.ahead & m.in_line(OVERTAKEN_LINE))
    after = m.behind & m.in_line(0.5)
    beside = at(m.aside, first(passed)) < m.lane[..., 0]
    moves = at(m.speed, first(passed)) > STANDING_MPS
    moves |= at(m.speed, last(m.ahead)) > MOVING_MPS
    in_line = (before | after).any(axis=-1)
    return passed.any(axis=-1) & in_line & beside & moves & _drove(m, passed)


def _drove(m: Meetings, passed: np.ndarray) -> np.ndarray:
    """[..., N] bool: drove from ahead to behind, at the speed that it has.

    Where a road meets itself, the nearest station of one far ahead is behind.
    """
    end = first(passed)
    until = m.ahead & (TIMES_S[end][..., None] > TIMES_S)
    begin = last(until)
    seconds = TIMES_S[end] - TIMES_S[begin]
    way = 0.5 * (at(m.speed, begin) + at(m.speed, end)) * seconds
    off = np.abs(at(m.s, end) - at(m.s, begin) - way)
    return np.asarray(off < JUMP_M + JUMP_MPS * seconds)


def follows(m: Meetings) -> np.ndarray:
    """[..., N] bool: ahead on the path or in the line for long enough, the same way.

    A standing body goes the same way within the jitter of its positions. An obstacle
    that leaves the view or the recording still counts as followed.
    """
    there = m.on_path | (m.ahead & m.in_line(0.5))
    begin, end = first(there), last(there)
    seconds = np.count_nonzero(there, axis=-1) * (TIMES_S[1] - TIMES_S[0])
    to_the_end = end == last(m.seen)
    to_the_end &= (seconds >= TO_THE_END_S) | is_lead(m)
    along = at(m.s, end) - at(m.s, begin)
    across = np.abs(at(m.l - m.path_l, end) - at(m.l - m.path_l, begin))
    same_way = along >= -STANDING_MPS * (TIMES_S[end] - TIMES_S[begin])
    same_way &= ~((across > CROSSING_M) & (across > along))
    lasts = (seconds >= FOLLOW_DURATION_S) | to_the_end
    return there.any(axis=-1) & lasts & same_way


def is_lead(m: Meetings) -> np.ndarray:
    """[..., N] bool: ahead on the path from the start."""
    at_start = TIMES_S <= FOLLOW_ONSET_S
    return np.asarray((m.blocks & m.ahead & at_start).any(axis=-1))


def comes(m: Meetings, seconds: float, metres: float) -> np.ndarray:
    """[..., N] bool: comes onto the path as the nearest ahead, and near.

    It moves towards the path itself, by more than the path moves towards it, and from
    a lane beside or by more than a lane: positions that wander on a single lane
    do not come. Nor does who is ahead from the start. Near is a gap below `seconds`
    of the human's speed and `metres`.
    """
    there = m.blocks & m.ahead
    index, begin, end = first(there), first(m.seen), last(m.on_path)
    gaps = np.where(there, m.gap, np.inf)
    is_nearest = at(m.gap, index) <= at(np.min(gaps, axis=-2, keepdims=True), index)
    near = at(m.gap, index) < seconds * at(m.human_speed, index) + metres
    own, path = (np.abs(at(x, end) - at(x, begin)) for x in (m.l, m.path_l))
    offset = np.abs(m.l - m.path_l)
    towards = at(offset, end) < at(offset, begin) - OWN_MOVE_M
    moves = (own > path) & towards
    moves &= at(m.on_road, begin) | (own > m.lane[..., 0])
    return m.on_path.any(axis=-1) & ~is_lead(m) & moves & is_nearest & near


def yields(m: Meetings) -> np.ndarray:
    """[..., N] bool: the human reacts to one that comes onto the path ahead.

    The reaction is braking, or a speed given up while the gap grows, from shortly
    before it comes until it has left the path.
    """
    there = m.blocks & m.ahead
    index = first(there)
    leaves = TIMES_S[last(there)][..., None] + LEAVES_S
    window = _around(index, *REACTION_S) & (leaves >= TIMES_S) & m.human_seen
    before = np.where(window, m.human_speed, -np.inf)
    given_up = np.maximum.accumulate(before, axis=-1) - m.human_speed
    given_up = np.max(np.where(window, given_up, 0.0), axis=-1)
    slowing = np.gradient(m.human_speed, TIMES_S, axis=-1)
    braking = -np.min(np.where(window, slowing, np.inf), axis=-1)
    brakes = (given_up >= BRAKES_MPS) & (braking >= BRAKES_MPS2)
    gap = np.where(there & window, m.gap, -np.inf)
    grows = np.max(gap, axis=-1) - at(m.gap, index) >= FALLS_BACK_M
    falls_back = grows & (given_up >= FALLS_BACK_MPS)
    return comes(m, NEAR_S, NEAR_M) & (brakes | falls_back)


def nudged(m: Meetings) -> np.ndarray:
    """[..., N] bool: the human moves aside for a slower one that it passes.

    From where it was before, in its lane, it would have passed with less than the
    clearance. A change of lane is no nudge, but round a standing body. Oncoming
    traffic is met, not passed.
    """
    slower = m.human_speed - m.speed > NUDGE_SPEED_MPS
    passes = m.abreast & (m.aside < NUDGE_RANGE_M) & slower & (m.speed > -MOVING_MPS)
    index = first(passes)
    near = _around(index, NUDGE_WITHIN_S, 0.0) & m.human_seen
    side = np.where(at(m.to_left, index), 1.0, -1.0)[..., None]
    away = -side * m.human_l  # m, from the obstacle's side of the road
    base = np.where(near, away, np.inf)
    move = np.max(np.where(passes, away, -np.inf), axis=-1) - np.min(base, axis=-1)
    clearance = at(m.aside, index) - at(away, index) + np.min(base, axis=-1)
    aside = (move >= NUDGE_MOVE_M) & (clearance < NUDGE_CLEARANCE_M)
    from_lane = at(m.human_off, np.argmin(base, axis=-1)) < LATERAL_BUFFER_M
    changes = np.max(np.where(m.human_seen, np.abs(m.human_l), 0.0), axis=-1)
    in_lane = from_lane & (changes < m.half_lane[..., 0])
    stands = at(m.speed, index) < STANDING_MPS
    return passes.any(axis=-1) & aside & (in_lane | stands)


def nudged_to_left(m: Meetings) -> np.ndarray:
    """[..., N] bool: the human passes to the left of it."""
    return ~at(m.to_left, first(m.abreast))


def cuts_in(m: Meetings) -> np.ndarray:
    """[..., N] bool: changes lane into the gap ahead of the human.

    Its middle crosses from the next lane into the human's, by moving sideways itself
    by half a lane, and less across than along the road.
    """
    offset = np.abs(m.l - m.path_l)
    enters = m.on_path & np.logical_or.accumulate(offset >= m.half_lane, axis=-1)
    index, begin, end = first(enters), first(m.seen), last(m.on_path)
    own = np.abs(at(m.l, end) - at(m.l, begin))
    before = m.seen & (TIMES_S[index][..., None] >= TIMES_S)
    from_next = ~(before & (offset > NEXT_LANE * m.lane)).any(axis=-1)
    along = at(m.s, index) - at(m.s, begin) > np.abs(at(m.l, index) - at(m.l, begin))
    changes = (own > m.half_lane[..., 0]) & from_next & along
    return enters.any(axis=-1) & changes & comes(m, CUT_IN_S, CUT_IN_M)
