"""Which scenes are kept: each reason to drop one has a name and is counted."""

import numpy as np

from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.scenes.motion import Motion
from rcirl_jax.types import Kind
from rcirl_jax.units import DT_S

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


def reject_motion(row: dict, motion: Motion, config: CollectConfig) -> str | None:
    """The first reason to drop a scene for how its human drives, or None.

    Asked before anybody else is looked at: where traffic flows this drops most.

    Args:
      row: the scene's flat arrays, without obstacles.
      motion: the human's motion.
      config: which filters are on.
    """
    valid = row["time_valid"]
    if _far_from_road(row, motion, valid):
        return "far_from_road"
    if _too_noisy(motion, valid):
        return "too_noisy"
    if config.require_speed_change and _keeps_speed(motion, valid):
        return "no_speed_change"
    return None


def reject(
    row: dict, motion: Motion, config: CollectConfig, ghosts: np.ndarray
) -> str | None:
    """The first reason to drop a scene for who else is there, or None.

    Args:
      row: the scene's flat arrays.
      motion: the human's motion, kept by `reject_motion`.
      config: which filters are on.
      ghosts: [g, T, 2] station and offset of cars missing from the file.
    """
    if config.require_obstacles and row["num_bodies"] == 0:
        return "no_obstacles"
    if _overlaps(row, motion, row["time_valid"]):
        return "overlapping_boxes"
    if follows_ghost(row, motion, ghosts):
        return "follows_missing_car"
    return None


def _far_from_road(row: dict, motion: Motion, valid: np.ndarray) -> bool:
    grid = np.arange(row["path.road_left"].size) * 2.0
    left = np.interp(motion.s, grid, row["path.road_left"])
    right = np.interp(motion.s, grid, row["path.road_right"])
    out = (motion.l > left + OFF_ROAD_M) | (motion.l < right - OFF_ROAD_M)
    return bool(np.any(out & valid))


def _speeds(motion: Motion, valid: np.ndarray) -> np.ndarray:
    return np.diff(motion.s)[valid[1:]] / DT_S


def _keeps_speed(motion: Motion, valid: np.ndarray) -> bool:
    speeds = np.append(_speeds(motion, valid), motion.v0)
    return bool(np.ptp(speeds) < MIN_SPEED_CHANGE_MPS)


def _too_noisy(motion: Motion, valid: np.ndarray) -> bool:
    a = np.diff(_speeds(motion, valid)) / DT_S
    j = np.diff(a) / DT_S
    return bool(
        np.any(np.abs(a) > MAX_ACCELERATION_MPS2)
        or np.any(np.abs(j) > MAX_JERK_MPS3)
        or abs(motion.a0) > MAX_ACCELERATION_MPS2
    )


def _overlaps(row: dict, motion: Motion, valid: np.ndarray) -> bool:
    half_length, half_width = 0.5 * row["ego.length"], 0.5 * row["ego.width"]
    gap = np.maximum(
        row["obstacles.s_lower"] - motion.s - half_length,
        motion.s - half_length - row["obstacles.s_upper"],
    )
    lateral = np.maximum(
        row["obstacles.l_lower"] - motion.l - half_width,
        motion.l - half_width - row["obstacles.l_upper"],
    )
    kind = row["obstacles.kind"][:, None]
    body = row["obstacles.valid"] & (kind >= Kind.VEHICLE) & (kind <= Kind.STATIC)
    depth = np.maximum(gap, lateral)
    return bool(np.any(body & valid & (depth < -OVERLAP_M)))


def follows_ghost(row: dict, motion: Motion, ghosts: np.ndarray) -> bool:
    """Whether a missing car drives in the ego's lane with nobody in between."""
    for ghost in ghosts:
        ahead = (ghost[:, 0] > motion.s) & (
            np.abs(ghost[:, 1] - motion.l) < SAME_LANE_M
        )
        if not ahead[: ahead.size // 2].any():
            continue
        middle = 0.5 * (row["obstacles.s_lower"] + row["obstacles.s_upper"])
        lateral = 0.5 * (row["obstacles.l_lower"] + row["obstacles.l_upper"])
        between = (
            row["obstacles.valid"]
            & (middle > motion.s)
            & (middle < ghost[:, 0])
            & (np.abs(lateral - motion.l) < SAME_LANE_M)
        ).any(axis=0)
        if np.any(ahead & ~between & row["time_valid"]):
            return True
    return False
