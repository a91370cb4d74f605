"""Labels of single-file platoons, where nobody overtakes, nudges or changes lane.

As in the OpenACC recordings: cars follow each other round a test track without a
map, positions are those of receivers whose errors wander. The truth is the order of
the cars, which never changes.
"""

import collections

import numpy as np

from rcirl_jax.data.formats.paths import path_lanes
from rcirl_jax.data.scenes.collect import Collector
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.synthetic.drivers import free_acceleration, interaction
from rcirl_jax.types import Decision, Kind, Recording, Tag, Track

CARS = 6
SECONDS, RATE_HZ = 120.0, 10.0
LENGTH_M, WIDTH_M, LANE_M = 4.7, 1.9, 3.5
RADIUS_M, STRAIGHT_M = 80.0, 300.0  # of the track: two straights and two bends
HEADWAY_S, JAM_GAP_M, ACCELERATION_MPS2, BRAKING_MPS2 = 1.2, 3.0, 1.5, 2.0
GNSS_ERROR_M = 0.7  # m, sd of a receiver's error, without a base station
GNSS_PERIODS_S = (15.0, 60.0)  # s, in which it wanders
# what a platoon has none of
NEVER = (Decision.OVERTAKE, Decision.YIELD, Decision.NUDGE_LEFT, Decision.NUDGE_RIGHT)
NEVER_TAGS = (Tag.OVERTAKING, Tag.YIELDING, Tag.NUDGING, Tag.CUT_IN, Tag.LANE_CHANGE)


def measure_platoons(count: int, seed: int = 0) -> dict:
    """Labels of `count` platoons, as an import would make them.

    Returns:
      JSON-ready: scenes, and how often each label that a platoon cannot have was made.
    """
    found: collections.Counter[str] = collections.Counter()
    scenes = 0
    for number in range(count):
        made = platoon(np.random.default_rng((seed, number)))
        for row in Collector(made, CollectConfig(require_speed_change=False)).scenes():
            scenes += 1
            found.update(Decision(d).name.lower() for d in row["decisions"])
            found.update(t.name.lower() for t in NEVER_TAGS if row["tags"][t])
    names = [label.name.lower() for label in (*NEVER, *NEVER_TAGS)]
    return {
        "platoons": count,
        "scenes": scenes,
        "follow": found["follow"],
        "never": {name: found[name] for name in names},
    }


def platoon(rng: np.random.Generator) -> Recording:
    """A platoon round the track, the first car at changing speeds."""
    s, v = _driven(rng)
    x, y, heading = _on_track(s)
    tracks = []
    for car in range(CARS):
        dx, dy = _wander(s.shape[0], rng)
        tracks.append(
            Track(
                id=str(car),
                kind=Kind.VEHICLE,
                length=LENGTH_M,
                width=WIDTH_M,
                t=np.arange(s.shape[0]) / RATE_HZ,
                x=x[:, car] + dx,
                y=y[:, car] + dy,
                heading=heading[:, car],
                speed=v[:, car],
            )
        )
    return Recording(
        name="platoon",
        source="simulated",
        licence="none",
        rate_hz=RATE_HZ,
        tracks=tuple(tracks),
        lanes=path_lanes(tracks, LANE_M, None),
    )


def _wander(steps: int, rng: np.random.Generator) -> np.ndarray:
    """[2, n] m, errors of the positions in x and y: three sines of equal size."""
    periods = rng.uniform(*GNSS_PERIODS_S, (2, 3, 1))
    phases = rng.uniform(0.0, 2.0 * np.pi, (2, 3, 1))
    clock = np.arange(steps) / RATE_HZ
    waves = np.sin(2.0 * np.pi * clock / periods + phases)
    return GNSS_ERROR_M * np.sqrt(2.0 / 3.0) * waves.sum(axis=1)


def _driven(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Stations [n, cars] m and speeds [n, cars] m/s of IDM followers."""
    steps, dt = int(SECONDS * RATE_HZ), 1.0 / RATE_HZ
    wish = np.repeat(rng.uniform(4.0, 16.0, steps // 100 + 1), 100)[:steps]
    s = -np.arange(CARS) * 25.0
    v = np.full(CARS, 10.0)
    found_s, found_v = np.empty((2, steps, CARS))
    for step in range(steps):
        found_s[step], found_v[step] = s, v
        gap = np.append(np.inf, s[:-1] - s[1:] - LENGTH_M)
        leader = np.append(0.0, v[:-1])
        desired = np.append(wish[step], np.full(CARS - 1, 18.0))
        a = free_acceleration(
            v, desired, np.array(ACCELERATION_MPS2), np.array(BRAKING_MPS2)
        ) - interaction(
            v,
            gap,
            leader,
            np.array(ACCELERATION_MPS2),
            np.array(BRAKING_MPS2),
            HEADWAY_S,
            JAM_GAP_M,
        )
        v = np.maximum(v + np.clip(a, -6.0, ACCELERATION_MPS2) * dt, 0.0)
        s = s + v * dt
    return found_s, found_v


def _on_track(s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, y [m] and heading [rad] of stations on the oval."""
    bend = np.pi * RADIUS_M
    lap = 2.0 * (STRAIGHT_M + bend)
    turns, place = np.divmod(s, lap)
    back, place = np.divmod(place, STRAIGHT_M + bend)
    angle = np.maximum(place - STRAIGHT_M, 0.0) / RADIUS_M
    x = np.minimum(place, STRAIGHT_M) + RADIUS_M * np.sin(angle)
    y = RADIUS_M * (1.0 - np.cos(angle))
    x = np.where(back > 0, STRAIGHT_M - x, x)
    y = np.where(back > 0, 2.0 * RADIUS_M - y, y)
    return x, y, angle + np.pi * back + 2.0 * np.pi * turns
