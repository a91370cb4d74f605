"""Scenes drawn at random, many at once, with every flag that F knows.

Numbers lie on grids of a sixteenth, so that edges touch and distances tie, but where
a scene is drawn `smooth`. Leaves are numpy, with a leading axis of scenes.
"""

import numpy as np

from rcirl_jax.types import NUM_TAGS, Ego, Kind, Obstacles, Path, Scene
from rcirl_jax.units import DT_S, NUM_OBSTACLES, NUM_STATIONS, NUM_TIMES, TIMES_S

N, P, T = NUM_OBSTACLES, NUM_STATIONS, NUM_TIMES
GRID = 16.0  # numbers a metre


def scenes(rng, count):
    """Scenes [count]: empty or crowded, straight or bent, with lines, limits, masks."""
    smooth = rng.random(count) < 0.5
    ego = _ego(rng, count)
    number = rng.choice([0, 1, 3, 8, N], count)
    slots = np.arange(N) < number[:, None]
    made = Scene(
        ego=ego,
        path=_path(rng, count),
        obstacles=_obstacles(rng, slots),
        time_valid=np.arange(T) < rng.choice([1, 2, 3, 7, 12, T, T, T], count)[:, None],
        tags=np.zeros((count, NUM_TAGS), bool),
    )
    return _as_float32(made, smooth)


def candidates(rng, made, each):
    """Stations and offsets [count, each, T]: at rest, braking, steady, speeding."""
    count = len(made.ego.v)
    shape = (count, each, T)
    kinds = rng.integers(0, 4, (count, each, 1))
    v0 = np.asarray(made.ego.v, float)[:, None, None]
    change = np.cumsum(rng.normal(0.0, 0.5, shape), axis=2)
    braking = -rng.uniform(0.5, 6.0, (count, each, 1)) * TIMES_S
    shapes = [-v0 * np.ones(shape), braking, np.zeros(shape), change]
    speed = np.maximum(v0 + np.choose(kinds, shapes), 0.0)
    s = np.concatenate([np.zeros((count, each, 1)), speed[..., :-1]], axis=2)
    s = np.cumsum(s * DT_S, axis=2)
    swing = rng.uniform(-3.0, 3.0, (count, each, 1))
    ego_l = np.asarray(made.ego.l, float)[:, None, None]
    l = ego_l + swing * np.sin(TIMES_S / rng.uniform(1.0, 4.0, (count, each, 1)))
    coarse = rng.random((count, 1, 1)) < 0.3
    s, l = (np.where(coarse, np.round(x * GRID) / GRID, x) for x in (s, l))
    return s.astype(np.float32), l.astype(np.float32)


def _ego(rng, count):
    draw = lambda low, high: rng.uniform(low, high, count)  # noqa: E731
    return Ego(
        s=np.zeros(count),
        l=draw(-2.0, 2.0),
        dl=draw(-0.2, 0.2),
        ddl=draw(-0.05, 0.05),
        v=np.where(rng.random(count) < 0.15, 0.0, draw(0.0, 35.0)),
        a=draw(-4.0, 3.0),
        length=draw(3.5, 12.0),
        width=draw(1.6, 2.6),
    )


def _path(rng, count):
    stations = np.arange(P) * 2.0
    draw = lambda low, high: rng.uniform(low, high, (count, 1))  # noqa: E731
    bends = draw(-0.06, 0.06) * np.sin(stations / draw(10.0, 80.0) + draw(0.0, 6.0))
    straight = rng.random((count, 1)) < 0.3
    steps = np.cumsum(rng.random((count, P)) < 0.03, axis=1)  # where the limit changes
    limits = np.take_along_axis(rng.uniform(3.0, 36.0, (count, P)), steps, axis=1)
    flat = np.ones((count, P))
    return Path(
        kappa=np.where(straight, 0.0, bends),
        l=draw(-2.0, 2.0) * np.sin(stations / draw(15.0, 90.0)) + draw(-1.0, 1.0),
        speed_limit=limits,
        lane_left=1.8 * flat,
        lane_right=-1.8 * flat,
        road_left=5.4 * flat,
        road_right=-5.4 * flat,
    )


def _obstacles(rng, slots):
    count = len(slots)
    shape = (count, N)
    draw = lambda low, high: rng.uniform(low, high, shape)  # noqa: E731
    kind = np.where(slots, rng.integers(1, 7, shape), Kind.NONE)
    line = kind >= Kind.STOP
    moves = (kind >= Kind.VEHICLE) & (kind < Kind.STATIC)
    speed = np.where(moves, draw(-5.0, 30.0), 0.0)[..., None]
    speed = np.maximum(
        speed + moves[..., None] * draw(-2.0, 2.0)[..., None] * TIMES_S, -9
    )
    s = draw(-60.0, 150.0)[..., None] + np.cumsum(speed * DT_S, axis=2)
    s = np.where(line[..., None], draw(-10.0, 120.0)[..., None], s)
    l = draw(-8.0, 8.0)[..., None] + draw(-1.0, 1.0)[..., None] * TIMES_S
    l = np.where(line[..., None], 0.0, l)
    half_s = np.where(line, 0.05 * rng.integers(0, 2, shape), draw(0.2, 9.0))[..., None]
    half_l = np.where(line, 20.0, draw(0.2, 1.4))[..., None]
    return Obstacles(
        s_lower=s - half_s,
        s_upper=s + half_s,
        l_lower=l - half_l,
        l_upper=l + half_l,
        speed=speed * np.ones(T),
        valid=_seen(rng, shape) & slots[..., None],
        kind=kind.astype(np.int32),
        a=np.zeros(shape),
        l_dot=np.zeros(shape),
    )


def _seen(rng, shape):
    """When obstacles are there: always, with gaps, until or from some time on."""
    which = rng.integers(0, 4, shape)[..., None]
    at = rng.integers(0, T + 1, shape)[..., None]
    gaps = rng.random((*shape, T)) < 0.7
    always = np.ones((*shape, T), bool)
    return np.choose(which, [always, gaps, np.arange(T) < at, np.arange(T) >= at])


def _as_float32(made, smooth):
    """Floats as float32; on the grid where a scene is not smooth."""

    def of(x):
        if x.dtype.kind != "f":
            return x
        each = smooth.reshape(-1, *[1] * (x.ndim - 1))
        return np.where(each, x, np.round(x * GRID) / GRID).astype(np.float32)

    coarse = made.replace(
        ego=Ego(**{k: of(v) for k, v in vars(made.ego).items()}),
        obstacles=Obstacles(**{k: of(v) for k, v in vars(made.obstacles).items()}),
    )
    path = {k: v.astype(np.float32) for k, v in vars(made.path).items()}
    return coarse.replace(path=Path(**path))
