"""Recordings made by hand: cars on a straight road of three lanes."""

import dataclasses

import numpy as np

from rcirl_jax.data.scenes.collect import Collector
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.types import Kind, Lane, Recording, Track

WIDTH = 3.6  # m, of a lane
NO_FILTER = CollectConfig(require_obstacles=False, require_speed_change=False)
SERIES = ("t", "x", "y", "heading", "speed")


def lane(name, x, y, limit=25.0, **more):
    """A lane along points; x and y in m."""
    half = np.full(np.shape(x), WIDTH / 2)
    return Lane(
        id=name,
        centre=np.stack([x, y * np.ones_like(x)], 1),
        left_width=half,
        right_width=half,
        speed_limit=limit,
        **more,
    )


def road(stop_line=None, signals=(), length=500.0):
    """Lanes "left", "mid" (y = 0) and "right" along x; a stop line across at x [m]."""
    names, lanes = ("left", "mid", "right"), []
    for i, name in enumerate(names):
        y = (1 - i) * WIDTH
        ends = [[stop_line, y + side] for side in (1.8, -1.8)]
        links = {
            "left": names[i - 1] if i else None,
            "right": names[i + 1] if i < 2 else None,
            "stop_line": None if stop_line is None else np.array(ends),
        }
        x = np.arange(0.0, length + 1.0, 5.0)
        lanes.append(lane(name, x, y, **links, signal_ids=signals))
    return tuple(lanes)


def car(name, s, y=0.0, seconds=12.0, kind=Kind.VEHICLE, **more):
    """A track from callables of time s(t), y(t)."""
    t = np.arange(0.0, seconds + 1e-9, 0.1)
    x = np.asarray(s(t), float) * np.ones_like(t)
    y = (y(t) if callable(y) else y) * np.ones_like(t)
    vx, vy = np.gradient(x, t), np.gradient(y, t)
    heading = np.arctan2(vy, np.maximum(vx, 1e-3))
    return Track(
        id=name,
        kind=kind,
        length=4.5,
        width=1.8,
        t=t,
        x=x,
        y=y,
        heading=np.where(np.hypot(vx, vy) > 0.3, heading, 0.0),
        speed=np.hypot(vx, vy),
        **more,
    )


def part(track, begin=-np.inf, end=np.inf, name=None):
    """The samples of a track within a time [s], as a track of its own."""
    inside = (track.t >= begin - 1e-6) & (track.t <= end + 1e-6)
    series = {one: getattr(track, one)[inside] for one in SERIES}
    return dataclasses.replace(track, id=name or track.id, **series)


def recording(*tracks, lanes=None, **more):
    """Cars on a road, at 10 Hz."""
    about = {"name": "hand", "source": "test", "licence": "none", "rate_hz": 10.0}
    return Recording(**about, tracks=tracks, lanes=lanes or road(), **more)


def steady(start, v=12.0):
    """Stations at one speed [m/s] from a place [m]."""
    return lambda t: start + v * t


def speeding_up(start, v=12.0, a=0.3):
    """Stations of even acceleration [m/s^2] from a place [m] and a speed [m/s]."""
    return lambda t: start + v * t + 0.5 * a * t**2


def smooth_step(t, start, duration):
    """0 before `start` [s], 1 after `duration` [s] more."""
    u = np.clip((t - start) / duration, 0.0, 1.0)
    return u**3 * (10 - 15 * u + 6 * u**2)


def first_scene(made, ego="ego", config=NO_FILTER):
    """The first scene of the ego, or the counted drop reasons."""
    collector = Collector(made, config)
    number = [track.id for track in made.tracks].index(ego)
    rows = [row for row in collector.scenes() if row["track"] == number]
    return rows[0] if rows else dict(collector.dropped)
