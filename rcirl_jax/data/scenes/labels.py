"""Automatic labels: the human's decision per obstacle and the scene's tags.

The decision is read from the station-time graph with the human's own s(t) as
the profile (Apollo's SpeedDecider rules, with the recorded drive in place of a
planned one): an obstacle that blocks the driver's path is above or below the
profile when it first blocks it.

A recorded drive shows what a plan does not. Recorded positions jitter, so a
standing car is "not moving towards the ego" within a tolerance. And the path is
the driver's own: a lead that is overtaken by a lane change blocks it at first,
below the profile, and yet ends up above it.
`evaluation.labels.traffic` measures these rules on drivers whose state is known.

Shapes: [S] scenes side by side, [N] obstacles, [T] times, [P] stations of the path.
All functions work on any leading axes, so on one scene without [S] as well.
"""

from collections.abc import Sequence

import numpy as np

from rcirl_jax.types import NUM_TAGS, Decision, Kind, Tag
from rcirl_jax.units import STATION_STEP_M, TIMES_S

LATERAL_BUFFER_M = 0.2  # m, as in features.relations
NUDGE_RANGE_M = 3.0  # m, as in features.relations
FOLLOW_ONSET_S = 0.5  # s, Apollo: a followed car blocks from the start
FOLLOW_DURATION_S = 2.0  # s, Apollo: and for at least this long
NUDGE_SPEED_MPS = 2.0  # m/s faster than the obstacle to count as passing it
MOVING_MPS = 2.0  # m/s
STANDING_MPS = 0.5  # m/s
CRUISE_MPS = 5.0  # m/s
CRUISE_RANGE_MPS = 1.5  # m/s of change while cruising
TURN_RAD = np.deg2rad(30.0)  # rad of heading change along the path
CUT_IN_M = 0.5  # m sideways, at least, of who cuts in; position noise is less
STOP_REACH_M = 12.0  # m from the line within which standing is a stop at it
# what the labels are read from
FIELDS = (
    *(f"obstacles.{bound}" for bound in ("s_lower", "s_upper", "l_lower", "l_upper")),
    *("obstacles.speed", "obstacles.valid", "obstacles.kind", "human.s", "human.l"),
    *("path.l", "path.kappa", "path.lane_left", "path.lane_right"),
    *("ego.length", "ego.width", "time_valid"),
)
IS_LIGHT = "obstacles.is_light"  # [N]; a row without it takes every stop for a light


def add_labels(rows: Sequence[dict]) -> None:
    """Add `decisions` [N] and `tags` [G] to the rows of scenes, in place."""
    if not rows:
        return
    names = (*FIELDS, IS_LIGHT) if IS_LIGHT in rows[0] else FIELDS
    decisions, tags = labels_of(
        {name: np.array([row[name] for row in rows]) for name in names}
    )
    for row, own_decisions, own_tags in zip(rows, decisions, tags, strict=True):
        row["decisions"], row["tags"] = own_decisions, own_tags


def labels_of(scenes: dict) -> tuple[np.ndarray, np.ndarray]:
    """Decisions [S, N] and tags [S, G] of scenes, `FIELDS` with a leading [S]."""
    blocks = blocking(scenes) & scenes["time_valid"][..., None, :]
    speed = np.gradient(scenes["human.s"], TIMES_S, axis=-1)
    decisions = _decide(scenes, blocks, speed)
    return decisions, _tags(scenes, decisions, blocks, speed)


def _at(values: np.ndarray, index: np.ndarray) -> np.ndarray:
    """The values [..., k] at one index [...] of their last axis."""
    return np.take_along_axis(values, index[..., None], axis=-1)[..., 0]


def _of_obstacles(value: np.ndarray) -> np.ndarray:
    """One number per scene [...] beside numbers per obstacle and time [..., N, T]."""
    return np.asarray(value)[..., None, None]


def _middle(scenes: dict, axis: str) -> np.ndarray:
    """[..., N, T] m, centres of the boxes along `axis`, "s" or "l"."""
    lower, upper = (scenes[f"obstacles.{axis}_{end}"] for end in ("lower", "upper"))
    return 0.5 * (lower + upper)


def _path_at(scenes: dict, s: np.ndarray) -> np.ndarray:
    """[..., N, T] m, lateral offset of the driver's own path at stations s.

    Linear between the stations of the path, constant beyond its ends.
    """
    path = scenes["path.l"]
    shape, last = s.shape, path.shape[-1] - 1
    place = np.clip(s / STATION_STEP_M, 0.0, last).reshape(*path.shape[:-1], -1)
    before = np.minimum(place.astype(np.int64), last - 1)
    low, high = (
        np.take_along_axis(path, index, axis=-1) for index in (before, before + 1)
    )
    return (low + (place - before) * (high - low)).reshape(shape)


def blocking(scenes: dict) -> np.ndarray:
    """[..., N, T] bool: the obstacle's box overlaps the driver's own path laterally."""
    path_l = _path_at(scenes, _middle(scenes, "s"))
    beside = np.maximum(
        scenes["obstacles.l_lower"] - path_l, path_l - scenes["obstacles.l_upper"]
    )
    is_there = (scenes["obstacles.kind"] != Kind.NONE)[..., None]
    return scenes["obstacles.valid"] & (beside < _reach(scenes)) & is_there


def _reach(scenes: dict) -> np.ndarray:
    """[..., 1, 1] m beside the driver's middle within which a box is in the way."""
    return _of_obstacles(0.5 * scenes["ego.width"] + LATERAL_BUFFER_M)


def _seen(scenes: dict) -> np.ndarray:
    """[..., N, T] bool: the obstacle and the driver are recorded."""
    return scenes["obstacles.valid"] & scenes["time_valid"][..., None, :]


def _human(scenes: dict, axis: str) -> np.ndarray:
    """[..., 1, T] m, the driver's stations or offsets beside those of obstacles."""
    return scenes[f"human.{axis}"][..., None, :]


def _half_length(scenes: dict) -> np.ndarray:
    """[..., 1, 1] m."""
    return _of_obstacles(0.5 * scenes["ego.length"])


def _decide(scenes: dict, blocks: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Labels [..., N]; `blocks` [..., N, T], `speed` [..., T] m/s of the driver.

    The first rule that holds decides: lines; the lead that is passed by a lane
    change; who is passed by swerving in the lane; who never blocks; the rest blocks.
    """
    kind = scenes["obstacles.kind"]
    is_line = (kind == Kind.STOP) | (kind == Kind.VIRTUAL)
    swerve, beside = _swerve_past(scenes, blocks), _decide_beside(scenes, speed)
    moving = scenes["obstacles.speed"][..., 0] > STANDING_MPS
    # who is abreast of the driver and yet not hit is beside, whatever the buffer
    never = ~blocks.any(axis=-1)
    clear = never | (blocks & _abreast(scenes)).any(axis=-1)
    is_beside = beside != Decision.IGNORE
    change = np.maximum(0.5 * _lane_width(scenes), 0.0)[..., None]
    rules = [
        (kind == Kind.NONE, Decision.IGNORE),
        (is_line, _decide_line(scenes, speed)),
        ((swerve > change) & moving, Decision.OVERTAKE),
        ((swerve > 0.0) & is_beside, beside),
        (clear & (is_beside | never), beside),
    ]
    holds, labels = zip(*rules, strict=True)
    return np.select(holds, labels, _decide_ahead(scenes, blocks)).astype(np.int32)


def _lane_width(scenes: dict) -> np.ndarray:
    """[...] m, of the lane at the frame."""
    return scenes["path.lane_left"][..., 0] - scenes["path.lane_right"][..., 0]


def _decide_ahead(scenes: dict, blocks: np.ndarray) -> np.ndarray:
    """[..., N] Apollo's rules for what blocks the path: which side of the profile."""
    human, half = scenes["human.s"], _half_length(scenes)[..., 0]
    lower, upper = scenes["obstacles.s_lower"], scenes["obstacles.s_upper"]
    end = blocks.shape[-1] - 1
    first = np.argmax(blocks, axis=-1)
    last = end - np.argmax(blocks[..., ::-1], axis=-1)
    # the driver's stations at those times of each obstacle
    human_first, human_last = (
        np.take_along_axis(human, at, axis=-1) for at in (first, last)
    )
    lower_first, lower_last = _at(lower, first), _at(lower, last)
    behind = lower_first < human_first
    came_from_ahead = lower[..., 0] > human[..., :1] + half
    enters_later = (first > 0) & scenes["obstacles.valid"][..., 0]
    passed = human_last > _at(upper, last)
    lasts = np.count_nonzero(blocks, axis=-1) * (TIMES_S[1] - TIMES_S[0])
    back = STANDING_MPS * (TIMES_S[last] - TIMES_S[first])  # m, as of standing
    same_way = lower_last >= lower_first - back
    # who drives out of view or of the recording does not end to be followed
    to_the_end = last == end - np.argmax(_seen(scenes)[..., ::-1], axis=-1)
    to_the_end &= _at(scenes["obstacles.speed"], last) > MOVING_MPS
    lasts = np.where(to_the_end, TIMES_S[-1], lasts)
    lead = (TIMES_S[first] <= FOLLOW_ONSET_S) & (lasts >= FOLLOW_DURATION_S) & same_way
    return np.select(
        [behind & (came_from_ahead | enters_later), behind, passed, lead],
        [Decision.OVERTAKE, Decision.IGNORE, Decision.OVERTAKE, Decision.FOLLOW],
        Decision.YIELD,
    )


def _swerve_past(scenes: dict, blocks: np.ndarray) -> np.ndarray:
    """[..., N] m, the driver's move sideways to get past who was in the way; else 0.

    In the way: ahead at the frame, within the lateral buffer. A lead
    that turns off is passed too, but then it moved aside, not the driver.
    """
    human, human_l = _human(scenes, "s"), _human(scenes, "l")
    half, l = _half_length(scenes), _middle(scenes, "l")
    aside = np.maximum(
        scenes["obstacles.l_lower"][..., 0] - human_l[..., 0],
        human_l[..., 0] - scenes["obstacles.l_upper"][..., 0],
    )
    seen = _seen(scenes)
    ahead = scenes["obstacles.s_lower"][..., 0] > (human + half)[..., 0]
    near = aside < _reach(scenes)[..., 0]
    in_the_way = seen[..., 0] & ahead & (near | blocks[..., 0])
    driver = np.abs(human_l - human_l[..., :1])
    passed = seen & (human - half > scenes["obstacles.s_upper"])
    passed &= driver > np.abs(l - l[..., :1])
    past = in_the_way & passed.any(axis=-1)
    move = np.take_along_axis(driver[..., 0, :], np.argmax(passed, axis=-1), axis=-1)
    return np.where(past, move, 0.0)


def _abreast(scenes: dict) -> np.ndarray:
    """[..., N, T] bool: beside each other, bumper to bumper."""
    human, half = _human(scenes, "s"), _half_length(scenes)
    before = scenes["obstacles.s_lower"] < human + half
    return before & (scenes["obstacles.s_upper"] > human - half) & _seen(scenes)


def _decide_line(scenes: dict, speed: np.ndarray) -> np.ndarray:
    """[..., N] STOP if the human stands before the line (or at the destination)."""
    front = _human(scenes, "s") + _half_length(scenes)
    gap = scenes["obstacles.s_lower"] - front
    near = (gap > -2.0) & (gap < STOP_REACH_M)
    stands = ((speed < STANDING_MPS) & scenes["time_valid"])[..., None, :] & near
    return np.where(stands.any(axis=-1), Decision.STOP, Decision.IGNORE)


def _decide_beside(scenes: dict, human: np.ndarray) -> np.ndarray:
    """[..., N] NUDGE if the human drives past a slower one within the nudge range.

    Oncoming traffic is slower as well; it is met, not nudged.
    """
    speed, human_l = scenes["obstacles.speed"], _human(scenes, "l")
    lower, upper = scenes["obstacles.l_lower"], scenes["obstacles.l_upper"]
    half_width = _of_obstacles(0.5 * scenes["ego.width"])
    gap = np.maximum(lower - human_l, human_l - upper) - half_width
    slower = (human[..., None, :] - speed > NUDGE_SPEED_MPS) & (speed > -MOVING_MPS)
    passes = _abreast(scenes) & (gap < NUDGE_RANGE_M) & slower
    to_left = _at(human_l > _middle(scenes, "l"), np.argmax(passes, axis=-1))
    side = np.where(to_left, Decision.NUDGE_LEFT, Decision.NUDGE_RIGHT)
    return np.where(passes.any(axis=-1), side, Decision.IGNORE)


def _cuts_in(scenes: dict, blocks: np.ndarray) -> np.ndarray:
    """[...] bool: somebody enters the path ahead, along the road, by moving sideways.

    A crossing road user moves across more than along; a car that comes to block
    because the driver changes lane does not move sideways itself.
    """
    s, l = _middle(scenes, "s"), _middle(scenes, "l")
    kind, valid = scenes["obstacles.kind"][..., None], scenes["obstacles.valid"]
    body = (kind >= Kind.VEHICLE) & (kind <= Kind.STATIC)
    ahead = scenes["obstacles.s_lower"] > _human(scenes, "s")
    later = blocks & ahead & body & (TIMES_S > FOLLOW_ONSET_S)
    enters = later[..., 1:] & ~blocks[..., :-1] & valid[..., :-1]
    along = np.diff(s, axis=-1) > np.abs(np.diff(l, axis=-1))
    first, path_l = np.argmax(valid, axis=-1), _path_at(scenes, s)
    own = np.abs(l - _at(l, first)[..., None])
    drivers = np.abs(path_l - _at(path_l, first)[..., None])
    moves = np.max(np.where(valid, own, 0.0), axis=-1, keepdims=True) > CUT_IN_M
    cuts = enters & along & (moves & (own > drivers))[..., 1:]
    return cuts.any(axis=(-2, -1))


def _tags(
    scenes: dict, decisions: np.ndarray, blocks: np.ndarray, speed: np.ndarray
) -> np.ndarray:
    """[..., G] bool."""
    valid, s, l = scenes["time_valid"], scenes["human.s"], scenes["human.l"]
    end = valid.shape[-1] - 1 - np.argmax(valid[..., ::-1], axis=-1)  # [...]
    early, late = speed[..., 0], _at(speed, end)
    slowest = np.min(np.where(valid, speed, np.inf), axis=-1)
    fastest = np.max(np.where(valid, speed, -np.inf), axis=-1)
    kappa, kind = scenes["path.kappa"], scenes["obstacles.kind"]
    driven = np.arange(kappa.shape[-1]) * STATION_STEP_M <= _at(s, end)[..., None]
    bend = np.abs(np.sum(np.where(driven, kappa, 0.0), axis=-1) * STATION_STEP_M)
    aside = np.max(np.where(valid, np.abs(l - l[..., :1]), 0.0), axis=-1)
    # without `is_light` a stop sign cannot be told from a red light
    light = scenes.get(IS_LIGHT, kind == Kind.STOP) & (kind == Kind.STOP)
    is_red = light & scenes["obstacles.valid"][..., 0]
    found = {
        Tag.STOPPING: (early > MOVING_MPS) & (late < STANDING_MPS),
        Tag.STARTING: (early < STANDING_MPS) & (late > MOVING_MPS),
        Tag.CRUISING: (fastest - slowest < CRUISE_RANGE_MPS) & (slowest > CRUISE_MPS),
        Tag.FOLLOWING: (decisions == Decision.FOLLOW).any(axis=-1),
        Tag.TURNING: bend > TURN_RAD,
        Tag.LANE_CHANGE: aside > 0.5 * _lane_width(scenes),
        Tag.YIELDING: (decisions == Decision.YIELD).any(axis=-1),
        Tag.OVERTAKING: (decisions == Decision.OVERTAKE).any(axis=-1),
        Tag.NUDGING: (decisions >= Decision.NUDGE_LEFT).any(axis=-1),
        Tag.CUT_IN: _cuts_in(scenes, blocks),
        Tag.RED_LIGHT: is_red.any(axis=-1),
        Tag.STANDING: fastest < STANDING_MPS,
    }
    tags = np.zeros((*valid.shape[:-1], NUM_TAGS), bool)
    for tag, holds in found.items():
        tags[..., tag] = holds
    return tags
