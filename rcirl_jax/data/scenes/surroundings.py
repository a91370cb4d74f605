"""Until when all that the human reacts to is recorded.

A lead vehicle that leaves the recorded region, or whose track ends, is not recorded
from then on, but the human still reacts to it. What the human does then cannot be
learned from the recording, so the scene's mask ends there.
"""

import numpy as np

from rcirl_jax.data.scenes.manoeuvres import (
    LATERAL_BUFFER_M,
    MOVING_MPS,
    NUDGE_RANGE_M,
    NUDGE_SPEED_MPS,
)
from rcirl_jax.data.scenes.motion import GRID_M
from rcirl_jax.types import Kind
from rcirl_jax.units import NUM_TIMES, TIMES_S

EARLY_S = 1e-6  # s, by which two times of one sample may differ
SAME_PLACE_M = 2.0  # m, within which a track that begins goes on for one that ended


def surroundings_end(row: dict, ends: np.ndarray) -> float:
    """When the first road user that the human reacts to leaves the record.

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
    """Whether the human reacts to the road user whose track ends; see above.

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
    there[slot] = False
    if (there & _same_place(boxes, slot)).any():
        return False
    there[slot] = True
    middle = 0.5 * (boxes["s_lower"] + boxes["s_upper"])
    path_l = np.interp(middle, GRID_M, row["path.l"])
    aside = np.maximum(boxes["l_lower"] - path_l, path_l - boxes["l_upper"])
    aside -= 0.5 * row["ego.width"]
    on_path = there & (aside < LATERAL_BUFFER_M) & (middle > row["human.s"][now])
    if on_path[slot]:
        return slot == int(np.argmin(np.where(on_path, boxes["s_lower"], np.inf)))
    is_beside = LATERAL_BUFFER_M <= aside[slot] < NUDGE_RANGE_M
    return bool(is_beside) and _is_passed(row, boxes, slot, now)


def _same_place(boxes: dict, slot: int) -> np.ndarray:
    """[N] bool: boxes about where the one in a slot is."""
    near = np.ones(boxes["speed"].shape, bool)
    for axis in ("s", "l"):
        lower, upper = boxes[f"{axis}_lower"], boxes[f"{axis}_upper"]
        middle = 0.5 * (lower + upper)
        near &= np.abs(middle - middle[slot]) < SAME_PLACE_M
    return near


def _is_passed(row: dict, boxes: dict, slot: int, now: int) -> bool:
    """Whether the human passes a slower one, which keeps its speed, from `now` on."""
    human, times = row["human.s"][now:], TIMES_S[now:]
    half, speed = 0.5 * row["ego.length"], boxes["speed"][slot]
    if human.size < 2 or speed < -MOVING_MPS:
        return False
    drives_off = speed * (times - times[0])
    alongside = (human + half > boxes["s_lower"][slot] + drives_off) & (
        human - half < boxes["s_upper"][slot] + drives_off
    )
    faster = np.gradient(human, times) - speed > NUDGE_SPEED_MPS
    return bool(np.any(alongside & faster & (times <= row["future_s"] + EARLY_S)))
