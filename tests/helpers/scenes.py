"""Random and hand-made scenes for tests (numpy in, jax scenes out)."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.sampling import sample, trajectory_from_positions
from rcirl_jax.types import (
    NUM_TAGS,
    Demonstration,
    Ego,
    Kind,
    Obstacles,
    Path,
    Scene,
    Trajectory,
)
from rcirl_jax.units import NUM_OBSTACLES, NUM_STATIONS, NUM_TIMES, TIMES_S

N, P, T = NUM_OBSTACLES, NUM_STATIONS, NUM_TIMES

# as one program: its hundreds of operations one by one take half a minute to compile
sampled = jax.jit(sample, static_argnums=2)
# to the bit what operations one by one give, as one program: none is fused with another
unfused = functools.partial(
    jax.jit, compiler_options={"xla_disable_hlo_passes": "fusion"}
)


def _f(value):
    return jnp.asarray(value, jnp.float32)


def scene(
    *, v=13.0, a=0.0, l=0.0, boxes=(), kappa=0.0, speed_limit=25.0, num_valid=T,
    path_l=0.0,
):  # fmt: skip
    """A straight three-lane road; `boxes` are dicts of s, l, speed, kind, ..."""
    shape = (N, T)
    arrays = {
        name: np.zeros(shape) for name in ("s_lower", "s_upper", "l_lower", "l_upper")
    }
    speed, valid = np.zeros(shape), np.zeros(shape, bool)
    kind = np.zeros(N, np.int32)
    for slot, box in enumerate(boxes):
        centre = box["s"] + box.get("speed", 0.0) * TIMES_S
        half_s, half_l = 0.5 * box.get("length", 4.5), 0.5 * box.get("width", 1.8)
        for axis, middle, half in (
            ("s", centre, half_s),
            ("l", box.get("l", 0.0), half_l),
        ):
            arrays[f"{axis}_lower"][slot] = middle - half
            arrays[f"{axis}_upper"][slot] = middle + half
        speed[slot] = box.get("speed", 0.0)
        valid[slot] = box.get("valid", True)
        kind[slot] = box.get("kind", Kind.VEHICLE)
    full = lambda value: jnp.broadcast_to(_f(value), (P,))  # noqa: E731
    return Scene(
        ego=Ego(
            s=_f(0.0), l=_f(l), dl=_f(0.0), ddl=_f(0.0), v=_f(v), a=_f(a),
            length=_f(4.9), width=_f(2.0),
        ),
        path=Path(
            kappa=full(kappa), l=full(path_l), speed_limit=full(speed_limit),
            lane_left=full(1.8), lane_right=full(-1.8), road_left=full(5.4),
            road_right=full(-5.4),
        ),
        obstacles=Obstacles(
            **{name: _f(table) for name, table in arrays.items()},
            speed=_f(speed),
            valid=jnp.asarray(valid),
            kind=jnp.asarray(kind),
            a=jnp.zeros(kind.shape),
            l_dot=jnp.zeros(kind.shape),
        ),
        time_valid=jnp.arange(T) < num_valid,
        tags=jnp.zeros(NUM_TAGS, bool),
    )  # fmt: skip


def random_scene(seed):
    """A busy random scene: bends, all kinds, gaps in validity."""
    rng = np.random.default_rng(seed)
    boxes = []
    for _ in range(rng.integers(0, N + 1)):
        kind = Kind(rng.integers(1, 7))
        line = kind in (Kind.STOP, Kind.VIRTUAL)
        box = {"kind": kind, "s": rng.uniform(-40.0, 120.0)}
        box["l"] = 0.0 if line else rng.uniform(-6.0, 6.0)
        box["speed"] = 0.0 if kind >= Kind.STATIC else rng.uniform(-3.0, 20.0)
        box["length"] = 0.0 if line else rng.uniform(0.5, 12.0)
        box["width"] = 40.0 if line else rng.uniform(0.5, 2.5)
        boxes.append({**box, "valid": rng.uniform(size=T) < 0.8})
    made = scene(
        v=rng.uniform(0.0, 25.0),
        a=rng.uniform(-2.0, 2.0),
        l=rng.uniform(-1.0, 1.0),
        boxes=boxes,
        speed_limit=rng.uniform(8.0, 30.0),
        num_valid=int(rng.integers(11, T + 1)),
    )
    stations = np.arange(P) * 2.0
    bend = rng.uniform(-0.03, 0.03) * np.sin(stations / rng.uniform(20.0, 60.0))
    path_l = rng.uniform(-1.5, 1.5) * np.sin(stations / 80.0)
    return made.replace(path=made.path.replace(kappa=_f(bend), l=_f(path_l)))


def random_positions(seed, made):
    """Stations and offsets [T] of some drive in the scene."""
    rng = np.random.default_rng([seed, 1])
    speeds = np.abs(float(made.ego.v) + np.cumsum(rng.normal(0.0, 0.5, T)))
    steps = np.diff(TIMES_S, prepend=0.0) * speeds
    return _f(np.cumsum(steps)), _f(rng.uniform(-2, 2) * np.sin(TIMES_S / 3.0))


def batch(scenes):
    """Stack scenes along a new leading axis."""
    return jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *scenes)


def demonstration(seed):
    """A demonstration with a random human in a random scene (numpy leaves)."""
    made = random_scene(seed)
    human: Trajectory = trajectory_from_positions(made, *random_positions(seed, made))
    rows = Demonstration(
        scene=made,
        human=human,
        decisions=jnp.zeros(N, jnp.int32),
        future_s=_f(TIMES_S[int(made.time_valid.sum()) - 1]),
        s_at_5s=_f(0.0),
        vehicle=jnp.asarray(seed, jnp.int32),
        recording=jnp.asarray(0, jnp.int32),
        group=jnp.asarray(seed % 4, jnp.int32),
        frame=jnp.asarray(seed, jnp.int32),
    )
    return jax.tree.map(np.asarray, rows)
