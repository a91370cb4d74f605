"""Filters of scenes, and the time they last; each reason to drop one is counted.

A lead vehicle that leaves the recorded region, or whose track ends, is not recorded
from then on, but the human still reacts to it. What the human does then cannot be
learned from the recording, so the scene's mask ends there.
"""

import numpy as np

from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.scenes.manoeuvres import (
    LATERAL_BUFFER_M,
    MOVING_MPS,
    NUDGE_RANGE_M,
    NUDGE_SPEED_MPS,
)
from rcirl_jax.data.scenes.motion import GRID_M
from rcirl_jax.types import Kind
from rcirl_jax.units import DT_S, NUM_TIMES, TIMES_S

REASONS = {
    "future_too_short": "the track ends before the minimum future (per track)",
    "off_map": "the car is on no lane, or leaves the mapped stations",
    "not_human": "an automation drives, or nobody knows who does",
    "far_from_road": "the human departs from the drivable area",
    "too_noisy": "accelerations no car can do remain after smoothing",
    "no_speed_change": "the human keeps the speed (the paper's second filter)",
    "no_obstacles": "nobody else is near (the paper's first filter)",
    "overlapping_boxes": "the human's box overlaps another's",
    "follows_missing_car": "the leader is missing from the file",
    "surroundings_end": "someone the human reacts to leaves the record too early",
}

# what to do where too much is dropped for a reason
REMEDIES = {
    "future_too_short": "a lower --min_future, or longer recordings",
    "off_map": "look at map and traffic with `rcirl inspect`: one frame?",
    "not_human": "look at how the log says who drives (columns.automated)",
    "far_from_road": "look at the lanes' widths with `rcirl inspect`",
    "too_noisy": "a longer --smoothing",
    "no_speed_change": "--keep_steady",
    "no_obstacles": "--keep_free_road",
    "overlapping_boxes": "look at the sizes and headings of the boxes",
    "follows_missing_car": "a log with the missing leaders",
    "surroundings_end": "a lower --min_surroundings",
}

MIN_SPEED_CHANGE_MPS = 0.5  # m/s over the scene
MAX_ACCELERATION_MPS2 = 6.0  # m/s^2, beyond a road car's usual grip use
MAX_JERK_MPS3 = 15.0  # m/s^3
OFF_ROAD_M = 1.0  # m beyond the drivable area's edge
OVERLAP_M = 0.3  # m of penetration taken as more than noise
SAME_LANE_M = 2.0  # m of lateral difference within which one follows
EARLY_S = 1e-6  # s, by which two times of one sample may differ
SAME_PLACE_M = 2.0  # m, within which a track that begins goes on for one that ended


def reject_motion(row: dict, config: CollectConfig) -> str | None:
    """Returns the first reason to drop a scene for how its human drives, or None.

    Asked before anybody else is looked at: where traffic flows this drops most.
    """
    valid, s, l = row["time_valid"], row["human.s"], row["human.l"]
    left = np.interp(s, GRID_M, row["path.road_left"])
    right = np.interp(s, GRID_M, row["path.road_right"])
    out = (l > left + OFF_ROAD_M) | (l < right - OFF_ROAD_M)
    if np.any(out & valid):
        return "far_from_road"
    speeds = np.diff(s)[valid[1:]] / DT_S
    a = np.diff(speeds) / DT_S
    if (
        np.any(np.abs(a) > MAX_ACCELERATION_MPS2)
        or np.any(np.abs(np.diff(a) / DT_S) > MAX_JERK_MPS3)
        or abs(row["ego.a"]) > MAX_ACCELERATION_MPS2
    ):
        return "too_noisy"
    change = np.ptp(np.append(speeds, row["ego.v"]))
    if config.require_speed_change and change < MIN_SPEED_CHANGE_MPS:
        return "no_speed_change"
    return None


def reject(row: dict, config: CollectConfig, missing: np.ndarray) -> str | None:
    """Returns the first reason to drop a scene for who else is there, or None.

    Args:
      row: the scene's flat arrays, kept by `reject_motion`.
      config: which filters are on.
      missing: [g, T, 2] station and offset of agents missing from the file.
    """
    if config.require_obstacles and row["num_bodies"] == 0:
        return "no_obstacles"
    half_length, half_width = 0.5 * row["ego.length"], 0.5 * row["ego.width"]
    s, l = row["human.s"], row["human.l"]
    gap = np.maximum(
        row["obstacles.s_lower"] - s - half_length,
        s - half_length - row["obstacles.s_upper"],
    )
    lateral = np.maximum(
        row["obstacles.l_lower"] - l - half_width,
        l - half_width - row["obstacles.l_upper"],
    )
    kind = row["obstacles.kind"][:, None]
    body = row["obstacles.valid"] & (kind >= Kind.VEHICLE) & (kind <= Kind.STATIC)
    if np.any(body & row["time_valid"] & (np.maximum(gap, lateral) < -OVERLAP_M)):
        return "overlapping_boxes"
    # a missing agent drives in the ego's lane, nobody in between
    for agent in missing:
        ahead = (agent[:, 0] > s) & (np.abs(agent[:, 1] - l) < SAME_LANE_M)
        if not ahead[: ahead.size // 2].any():
            continue
        middle = 0.5 * (row["obstacles.s_lower"] + row["obstacles.s_upper"])
        lateral = 0.5 * (row["obstacles.l_lower"] + row["obstacles.l_upper"])
        between = (
            row["obstacles.valid"]
            & (middle > s)
            & (middle < agent[:, 0])
            & (np.abs(lateral - l) < SAME_LANE_M)
        ).any(axis=0)
        if np.any(ahead & ~between & row["time_valid"]):
            return "follows_missing_car"
    return None


# ----------------------------------------------------------------- surroundings


def surroundings_end(row: dict, ends: np.ndarray) -> float:
    """Returns when the first road user that the human reacts to leaves the record.

    At the end of its track it matters if it is the nearest one ahead on the human's
    own path, or one beside it that the human is about to pass (`labels`: nudge).
    Road users that were passed, left the path or are hidden by a nearer one do not
    count, nor does a track that another one continues in the same place.

    Args:
      row: the scene's flat arrays, without labels.
      ends: [N] s after the planning frame, end of the track in each slot; inf where
        there is none.

    Returns:
      Seconds after the planning frame; inf if the surroundings outlast the human.
    """
    for slot in np.argsort(ends, kind="stable").tolist():
        end = float(ends[slot])
        if end >= row["future_s"] - EARLY_S:
            break
        if _matters(row, slot, end):
            return end
    return np.inf


def _matters(row: dict, slot: int, end: float) -> bool:
    """Returns whether the human reacts to the road user whose track ends; see above.

    Judged at the next time of the axis: until then it drives on at its last speed.
    """
    now = int(np.searchsorted(TIMES_S, end + EARLY_S))
    valid = row["obstacles.valid"]
    if now in (0, NUM_TIMES) or not valid[slot, now - 1]:
        return False
    boxes = {
        name: row[f"obstacles.{name}"][:, now].copy()
        for name in ("s_lower", "s_upper", "l_lower", "l_upper", "speed")
    }
    speed = boxes["speed"][slot]
    for name in ("s_lower", "s_upper"):
        boxes[name][slot] += speed * (TIMES_S[now] - end)
    kind = row["obstacles.kind"]
    there = valid[:, now] & (kind >= Kind.VEHICLE) & (kind <= Kind.STATIC)
    middle = 0.5 * (boxes["s_lower"] + boxes["s_upper"])
    lateral = 0.5 * (boxes["l_lower"] + boxes["l_upper"])
    same = np.abs(middle - middle[slot]) < SAME_PLACE_M
    same &= np.abs(lateral - lateral[slot]) < SAME_PLACE_M
    there[slot] = False
    if (there & same).any():
        return False
    there[slot] = True
    path_l = np.interp(middle, GRID_M, row["path.l"])
    aside = np.maximum(boxes["l_lower"] - path_l, path_l - boxes["l_upper"])
    aside -= 0.5 * row["ego.width"]
    on_path = there & (aside < LATERAL_BUFFER_M) & (middle > row["human.s"][now])
    if on_path[slot]:
        return slot == int(np.argmin(np.where(on_path, boxes["s_lower"], np.inf)))
    if not LATERAL_BUFFER_M <= aside[slot] < NUDGE_RANGE_M:
        return False
    # beside: whether the human passes the slower one, at its speed, from `now` on
    human, times = row["human.s"][now:], TIMES_S[now:]
    half = 0.5 * row["ego.length"]
    if human.size < 2 or speed < -MOVING_MPS:
        return False
    drives_off = speed * (times - times[0])
    alongside = (human + half > boxes["s_lower"][slot] + drives_off) & (
        human - half < boxes["s_upper"][slot] + drives_off
    )
    faster = np.gradient(human, times) - speed > NUDGE_SPEED_MPS
    return bool(np.any(alongside & faster & (times <= row["future_s"] + EARLY_S)))
