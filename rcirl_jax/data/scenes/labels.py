"""Automatic labels: the human's decision per obstacle and the scene's tags.

A decision says what happened, not on which side of a profile an obstacle lay. The
first of these that holds decides:

    line, destination   STOP where the human stands before it
    overtaken           OVERTAKE
    nudged              NUDGE_LEFT or NUDGE_RIGHT
    yields              YIELD
    follows             FOLLOW
    all else            IGNORE

`manoeuvres` defines them; `benchmarks.labels` compares them with scenes that a person
judged.

Shapes: [S] scenes side by side, [N] obstacles, [T] times, [P] stations of the path.
All functions work on any leading axes, so on one scene without [S] as well.
"""

from collections.abc import Sequence

import numpy as np

from rcirl_jax.data.scenes import manoeuvres
from rcirl_jax.data.scenes.manoeuvres import (
    MOVING_MPS,
    STANDING_MPS,
    Meetings,
    human_speed,
    lane_width,
    meetings,
)
from rcirl_jax.types import NUM_TAGS, Decision, Kind, Tag
from rcirl_jax.units import STATION_STEP_M

CRUISE_MPS = 5.0  # m/s
CRUISE_RANGE_MPS = 1.5  # m/s of change while cruising
TURN_RAD = np.deg2rad(30.0)  # rad of heading change along the path
STOP_REACH_M = 12.0  # m from the line within which standing is a stop at it
# what the labels are read from
FIELDS = (*manoeuvres.FIELDS, "path.kappa")
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
    met, speed = meetings(scenes), human_speed(scenes)
    kind = scenes["obstacles.kind"]
    is_line = (kind == Kind.STOP) | (kind == Kind.VIRTUAL)
    # STOP if the human stands before the line (or at the destination)
    half_length = 0.5 * np.asarray(scenes["ego.length"])[..., None, None]
    front = scenes["human.s"][..., None, :] + half_length
    gap = scenes["obstacles.s_lower"] - front
    near = (gap > -2.0) & (gap < STOP_REACH_M)
    stands = ((speed < STANDING_MPS) & scenes["time_valid"])[..., None, :] & near
    to_left = manoeuvres.nudged_to_left(met)
    rules = [
        (is_line, np.where(stands.any(axis=-1), Decision.STOP, Decision.IGNORE)),
        (manoeuvres.overtaken(met), Decision.OVERTAKE),
        (
            manoeuvres.nudged(met),
            np.where(to_left, Decision.NUDGE_LEFT, Decision.NUDGE_RIGHT),
        ),
        (manoeuvres.yields(met), Decision.YIELD),
        (manoeuvres.follows(met), Decision.FOLLOW),
    ]
    holds, labels = zip(*rules, strict=True)
    decisions = np.select(holds, labels, Decision.IGNORE).astype(np.int32)
    return decisions, _tags(scenes, decisions, met, speed)


def _changes_lane(scenes: dict) -> np.ndarray:
    """[...] bool: moves by half a lane's width, towards where the road has a lane.

    Or from there, where it is on that lane at t = 0. Where the road has none,
    positions that wander change no lane.
    """
    valid, l = scenes["time_valid"], scenes["human.l"]
    half = 0.5 * lane_width(scenes)
    found = np.zeros(half.shape, bool)
    for side, name in ((1.0, "left"), (-1.0, "right")):
        lane = side * scenes[f"path.lane_{name}"]
        room = np.max(side * scenes[f"path.road_{name}"] - lane, axis=-1)
        moved = np.where(valid, side * (l - l[..., :1]), 0.0)
        back = (side * l[..., 0] > half) & (np.min(moved, axis=-1) < -half)
        found |= (room > half) & ((np.max(moved, axis=-1) > half) | back)
    return found


def _at(values: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return the values [..., k] at one index [...] of their last axis."""
    return np.take_along_axis(values, index[..., None], axis=-1)[..., 0]


def _tags(
    scenes: dict, decisions: np.ndarray, met: Meetings, speed: np.ndarray
) -> np.ndarray:
    """[..., G] bool."""
    valid, s = scenes["time_valid"], scenes["human.s"]
    end = valid.shape[-1] - 1 - np.argmax(valid[..., ::-1], axis=-1)  # [...]
    early, late = speed[..., 0], _at(speed, end)
    slowest = np.min(np.where(valid, speed, np.inf), axis=-1)
    fastest = np.max(np.where(valid, speed, -np.inf), axis=-1)
    kappa, kind = scenes["path.kappa"], scenes["obstacles.kind"]
    driven = np.arange(kappa.shape[-1]) * STATION_STEP_M <= _at(s, end)[..., None]
    bend = np.abs(np.sum(np.where(driven, kappa, 0.0), axis=-1) * STATION_STEP_M)
    # without `is_light` a stop sign cannot be told from a red light
    light = scenes.get(IS_LIGHT, kind == Kind.STOP) & (kind == Kind.STOP)
    is_red = light & scenes["obstacles.valid"][..., 0]
    found = {
        Tag.STOPPING: (early > MOVING_MPS) & (late < STANDING_MPS),
        Tag.STARTING: (early < STANDING_MPS) & (late > MOVING_MPS),
        Tag.CRUISING: (fastest - slowest < CRUISE_RANGE_MPS) & (slowest > CRUISE_MPS),
        Tag.FOLLOWING: (decisions == Decision.FOLLOW).any(axis=-1),
        Tag.TURNING: bend > TURN_RAD,
        Tag.LANE_CHANGE: _changes_lane(scenes),
        Tag.YIELDING: (decisions == Decision.YIELD).any(axis=-1),
        Tag.OVERTAKING: (decisions == Decision.OVERTAKE).any(axis=-1),
        Tag.NUDGING: (decisions >= Decision.NUDGE_LEFT).any(axis=-1),
        Tag.CUT_IN: manoeuvres.cuts_in(met).any(axis=-1),
        Tag.RED_LIGHT: is_red.any(axis=-1),
        Tag.STANDING: fastest < STANDING_MPS,
    }
    tags = np.zeros((*valid.shape[:-1], NUM_TAGS), bool)
    for tag, holds in found.items():
        tags[..., tag] = holds
    return tags
