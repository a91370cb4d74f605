"""Automatic labels: the human's decision per obstacle and the scene's tags.

The decision is read from the station-time graph with the human's own s(t) as
the profile (Apollo's SpeedDecider rules, with the recorded drive in place of a
planned one): an obstacle that blocks the driver's path is above or below the
profile when it first blocks it.

A recorded drive shows what a plan does not. Recorded positions jitter, so a
standing car is "not moving towards the ego" within a tolerance. And the path is
the driver's own: a lead that is overtaken by a lane change blocks it at first,
below the profile, and yet ends up above it.
`evaluation.label_truth` measures these rules on drives of known decisions.
"""

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


def _middle(row: dict, axis: str) -> np.ndarray:
    """[N, T] m, centres of the boxes along `axis`, "s" or "l"."""
    return 0.5 * (row[f"obstacles.{axis}_lower"] + row[f"obstacles.{axis}_upper"])


def _path_at(row: dict, s: np.ndarray) -> np.ndarray:
    """[N, T] m, lateral offset of the driver's own path at stations s."""
    grid = np.arange(row["path.l"].size) * STATION_STEP_M
    return np.interp(s, grid, row["path.l"])


def blocking(row: dict) -> np.ndarray:
    """[N, T] bool: the obstacle's box overlaps the driver's own path laterally."""
    path_l = _path_at(row, _middle(row, "s"))
    reach = 0.5 * row["ego.width"] + LATERAL_BUFFER_M
    beside = np.maximum(
        row["obstacles.l_lower"] - path_l, path_l - row["obstacles.l_upper"]
    )
    kind = row["obstacles.kind"][:, None]
    return row["obstacles.valid"] & (beside < reach) & (kind != Kind.NONE)


def add_labels(row: dict) -> None:
    """Add `decisions` [N] and `tags` [G] to a scene's row in place."""
    blocks = blocking(row) & row["time_valid"]
    speed = np.gradient(row["human.s"], TIMES_S)
    row["decisions"] = decisions = _decide(row, blocks, speed)
    row["tags"] = _tags(row, decisions, blocks, speed)


def _decide(row: dict, blocks: np.ndarray, human: np.ndarray) -> np.ndarray:
    """Labels [N]; `blocks` [N, T], `human` [T] m/s, the driver's speed.

    The first rule that holds decides: lines; the lead that is passed by a lane
    change; who is passed by swerving in the lane; who never blocks; the rest blocks.
    """
    kind = row["obstacles.kind"]
    is_line = (kind == Kind.STOP) | (kind == Kind.VIRTUAL)
    swerve, beside = _swerve_past(row, blocks), _decide_beside(row, human)
    lane = row["path.lane_left"][0] - row["path.lane_right"][0]
    moving = row["obstacles.speed"][:, 0] > STANDING_MPS
    # who is abreast of the driver and yet not hit is beside, whatever the buffer
    never = ~blocks.any(axis=1)
    clear = never | (blocks & _abreast(row)).any(axis=1)
    is_beside = beside != Decision.IGNORE
    rules = [
        (kind == Kind.NONE, Decision.IGNORE),
        (is_line, _decide_line(row, human)),
        ((swerve > max(0.5 * lane, 0.0)) & moving, Decision.OVERTAKE),
        ((swerve > 0.0) & is_beside, beside),
        (clear & (is_beside | never), beside),
    ]
    holds, labels = zip(*rules, strict=True)
    return np.select(holds, labels, _decide_ahead(row, blocks)).astype(np.int32)


def _decide_ahead(row: dict, blocks: np.ndarray) -> np.ndarray:
    """[N] Apollo's rules for what blocks the path: which side of the profile."""
    human, half = row["human.s"], 0.5 * row["ego.length"]
    lower, upper = row["obstacles.s_lower"], row["obstacles.s_upper"]
    slots = np.arange(len(blocks))
    first = np.argmax(blocks, axis=1)
    last = blocks.shape[1] - 1 - np.argmax(blocks[:, ::-1], axis=1)
    behind = lower[slots, first] < human[first]
    came_from_ahead = lower[:, 0] > human[0] + half
    enters_later = (first > 0) & row["obstacles.valid"][:, 0]
    passed = human[last] > upper[slots, last]
    lasts = np.count_nonzero(blocks, axis=1) * (TIMES_S[1] - TIMES_S[0])
    back = STANDING_MPS * (TIMES_S[last] - TIMES_S[first])  # m, as of standing
    same_way = lower[slots, last] >= lower[slots, first] - back
    # who drives out of view or of the recording does not end to be followed
    seen = row["obstacles.valid"] & row["time_valid"]
    to_the_end = last == blocks.shape[1] - 1 - np.argmax(seen[:, ::-1], axis=1)
    to_the_end &= row["obstacles.speed"][slots, last] > MOVING_MPS
    lasts = np.where(to_the_end, TIMES_S[-1], lasts)
    lead = (TIMES_S[first] <= FOLLOW_ONSET_S) & (lasts >= FOLLOW_DURATION_S) & same_way
    return np.select(
        [behind & (came_from_ahead | enters_later), behind, passed, lead],
        [Decision.OVERTAKE, Decision.IGNORE, Decision.OVERTAKE, Decision.FOLLOW],
        Decision.YIELD,
    )


def _swerve_past(row: dict, blocks: np.ndarray) -> np.ndarray:
    """[N] lateral move [m] by which the driver got past who was in the way; else 0.

    In the way: ahead at the frame, within the lateral buffer. A lead
    that turns off is passed too, but then it moved aside, not the driver.
    """
    human, half = row["human.s"], 0.5 * row["ego.length"]
    l = _middle(row, "l")
    aside = np.maximum(
        row["obstacles.l_lower"][:, 0] - row["human.l"][0],
        row["human.l"][0] - row["obstacles.l_upper"][:, 0],
    )
    valid = row["obstacles.valid"] & row["time_valid"]
    ahead = row["obstacles.s_lower"][:, 0] > human[0] + half
    reach = 0.5 * row["ego.width"] + LATERAL_BUFFER_M
    in_the_way = valid[:, 0] & ahead & ((aside < reach) | blocks[:, 0])
    driver = np.abs(row["human.l"] - row["human.l"][0])
    passed = valid & (human - half > row["obstacles.s_upper"])
    passed &= driver > np.abs(l - l[:, :1])
    past = in_the_way & passed.any(axis=1)
    return np.where(past, driver[np.argmax(passed, axis=1)], 0.0)


def _abreast(row: dict) -> np.ndarray:
    """[N, T] bool: beside each other, bumper to bumper."""
    human, half = row["human.s"], 0.5 * row["ego.length"]
    before = row["obstacles.s_lower"] < human + half
    abreast = before & (row["obstacles.s_upper"] > human - half)
    return abreast & row["obstacles.valid"] & row["time_valid"]


def _decide_line(row: dict, human: np.ndarray) -> np.ndarray:
    """[N] STOP if the human stands before the line (or at the destination)."""
    front = row["human.s"] + 0.5 * row["ego.length"]
    gap = row["obstacles.s_lower"] - front
    near = (gap > -2.0) & (gap < STOP_REACH_M)
    stands = (human < STANDING_MPS) & near & row["time_valid"]
    return np.where(stands.any(axis=1), Decision.STOP, Decision.IGNORE)


def _decide_beside(row: dict, human: np.ndarray) -> np.ndarray:
    """[N] NUDGE if the human drives past a slower one within the nudge range.

    Oncoming traffic is slower as well; it is met, not nudged.
    """
    speed, human_l = row["obstacles.speed"], row["human.l"]
    lower, upper = row["obstacles.l_lower"], row["obstacles.l_upper"]
    gap = np.maximum(lower - human_l, human_l - upper) - 0.5 * row["ego.width"]
    slower = (human - speed > NUDGE_SPEED_MPS) & (speed > -MOVING_MPS)
    passes = _abreast(row) & (gap < NUDGE_RANGE_M) & slower
    at = np.argmax(passes, axis=1)
    to_left = human_l[at] > _middle(row, "l")[np.arange(len(at)), at]
    side = np.where(to_left, Decision.NUDGE_LEFT, Decision.NUDGE_RIGHT)
    return np.where(passes.any(axis=1), side, Decision.IGNORE)


def _cuts_in(row: dict, blocks: np.ndarray) -> bool:
    """Somebody enters the path ahead, along the road, by moving sideways.

    A crossing road user moves across more than along; a car that comes to block
    because the driver changes lane does not move sideways itself.
    """
    s, l = _middle(row, "s"), _middle(row, "l")
    kind, valid = row["obstacles.kind"][:, None], row["obstacles.valid"]
    body = (kind >= Kind.VEHICLE) & (kind <= Kind.STATIC)
    ahead = row["obstacles.s_lower"] > row["human.s"]
    later = blocks & ahead & body & (TIMES_S > FOLLOW_ONSET_S)
    enters = later[:, 1:] & ~blocks[:, :-1] & valid[:, :-1]
    along = np.diff(s, axis=1) > np.abs(np.diff(l, axis=1))
    rows, first = np.arange(len(s)), np.argmax(valid, axis=1)
    path_l = _path_at(row, s)
    own = np.abs(l - l[rows, first][:, None])
    drivers = np.abs(path_l - path_l[rows, first][:, None])
    moves = np.max(np.where(valid, own, 0.0), axis=1, keepdims=True) > CUT_IN_M
    return bool(np.any(enters & along & (moves & (own > drivers))[:, 1:]))


def _tags(
    row: dict, decisions: np.ndarray, blocks: np.ndarray, human: np.ndarray
) -> np.ndarray:
    valid = row["time_valid"]
    speed = human[valid]
    s, l = row["human.s"][valid], row["human.l"][valid]
    grid = np.arange(row["path.kappa"].size) * STATION_STEP_M
    driven = grid <= s[-1]
    bend = np.abs(np.sum(row["path.kappa"][driven]) * STATION_STEP_M)
    lane = row["path.lane_left"][0] - row["path.lane_right"][0]
    kind = row["obstacles.kind"]
    tags = np.zeros(NUM_TAGS, bool)
    tags[Tag.STOPPING] = speed[0] > MOVING_MPS and speed[-1] < STANDING_MPS
    tags[Tag.STARTING] = speed[0] < STANDING_MPS and speed[-1] > MOVING_MPS
    tags[Tag.CRUISING] = np.ptp(speed) < CRUISE_RANGE_MPS and speed.min() > CRUISE_MPS
    tags[Tag.FOLLOWING] = np.any(decisions == Decision.FOLLOW)
    tags[Tag.TURNING] = bend > TURN_RAD
    tags[Tag.LANE_CHANGE] = np.max(np.abs(l - l[0])) > 0.5 * lane
    tags[Tag.YIELDING] = np.any(decisions == Decision.YIELD)
    tags[Tag.OVERTAKING] = np.any(decisions == Decision.OVERTAKE)
    tags[Tag.NUDGING] = np.any(decisions >= Decision.NUDGE_LEFT)
    tags[Tag.CUT_IN] = _cuts_in(row, blocks)
    # without `is_light` a stop sign cannot be told from a red light
    light = row.get("obstacles.is_light", kind == Kind.STOP) & (kind == Kind.STOP)
    stop = light[:, None] & row["obstacles.valid"]
    tags[Tag.RED_LIGHT] = stop[:, 0].any()
    tags[Tag.STANDING] = speed.max() < STANDING_MPS
    return tags
