"""Planning frames from what a car measures: metres, seconds, radians, Cartesian.

    scene = scene_from(
        ego=Car(x=3.0, y=0.2, heading=0.0, speed=12.0, length=4.9, width=2.1),
        centre_line=CentreLine(points=[[0, 0], [300, 0]], speed_limit=13.9),
        obstacles=[Body(x=40, y=0, heading=0.0, speed=8.0, length=4.5, width=1.8)],
        signals=[Signal(x=80, y=0, state="red")],
    )

The scene is what the simulator's observer makes of the same moment, so that a reward
reads what it learned from: the eight most relevant bodies with a future, the nearest
line that demands a stop, the destination. The frame: x and y of any one Cartesian
frame, heading counter-clockwise from its x axis. In C++: rcirl/scene_builder.hpp.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.export.own_planner.inputs import (
    Body,
    Car,
    CentreLine,
    Signal,
    check,
    check_numbers,
    check_radians,
    table,
)
from rcirl_jax.export.own_planner.line_frame import LineFrame, Parts, extents
from rcirl_jax.geometry.frenet import project_points
from rcirl_jax.planner.prediction import most_relevant, obstacles_of
from rcirl_jax.types import NUM_TAGS, Obstacles, Scene
from rcirl_jax.units import NUM_TIMES, TIMES_S


def scene_from(
    *,
    ego: Car,
    centre_line: CentreLine,
    obstacles: Sequence[Body] = (),
    signals: Sequence[Signal] = (),
    predictions: Sequence[Any] | None = None,
    path: Any = None,  # noqa: ANN401
    destination: tuple[float, float] | None = None,
) -> Scene:
    """Build the planning frame of one moment; `plain_scene` makes it plain numbers.

    Args:
      ego: the car that is planned for.
      centre_line: of its lane.
      obstacles: the others, in any order; the eight most relevant count.
      signals: stop lines of the lane; the nearest ahead that demands a stop counts.
      predictions: for each obstacle its future as rows (t, x, y, heading) in s, m and
        rad, t from 0 on and rising; after the last row it is not there. None: the
        package's own prediction, which is what training scenes hold by default.
      path: [m, 2] m, the path along which speed is planned; None: the centre line.
      destination: (x, y) m where the ego's centre shall come to rest.

    Raises:
      InputError: names the field, its value and what was expected.

    Examples:
        >>> from rcirl_jax import Body, Car, CentreLine
        >>> scene = rcirl_jax.scene_from(
        ...     ego=Car(x=3.0, y=0.2, heading=0.0, speed=12.0, length=4.9, width=2.1),
        ...     centre_line=CentreLine(points=[[0, 0], [300, 0]], speed_limit=13.9),
        ...     obstacles=[Body(x=40, y=0, heading=0, speed=8, length=4.5, width=1.8)],
        ... )
        >>> candidates = rcirl_jax.sample_candidates(scene)
        >>> reward = rcirl_jax.load_weights("weights.msgpack")
        >>> rcirl_jax.score_candidates(reward, scene, candidates).shape
        (122,)
    """
    check_numbers("ego", ego)
    frame = LineFrame(centre_line, (ego.x, ego.y))
    points = frame.points(ego, obstacles, signals, destination)
    parts = frame.parts(
        *project_points(frame.line, points), ego, obstacles, signals, path
    )
    scene = _scene_of(parts)
    if predictions is None:
        return scene
    futures = _futures(frame, obstacles, predictions, float(parts.station))
    first = most_relevant(parts.bodies, parts.ego, parts.path)
    return scene.replace(obstacles=_with_futures(scene.obstacles, futures, first))


def scene_of(parts: Parts) -> Scene:
    """Build the planning frame of one moment; pure, so that `vmap` makes many."""
    return Scene(
        ego=parts.ego,
        path=parts.path,
        obstacles=obstacles_of(
            parts.bodies, parts.wall, parts.goal, parts.ego, parts.path
        ),
        time_valid=jnp.ones(NUM_TIMES, bool),
        tags=jnp.zeros(NUM_TAGS, bool),
    )


_scene_of = jax.jit(scene_of)


def _futures(
    frame: LineFrame, others: Sequence[Body], predictions: Sequence[Any], s0: float
) -> dict[str, np.ndarray]:
    """Return boxes of given futures at the T times; all [M, T]."""
    if len(predictions) != len(others):
        raise InputError(
            f"scene_from: predictions: {len(predictions)}: expected {len(others)}, one "
            "for each obstacle"
        )
    names = ("s_lower", "s_upper", "l_lower", "l_upper", "speed", "valid")
    found = {name: np.zeros((len(others), NUM_TIMES)) for name in names}
    ones = np.ones(NUM_TIMES)
    for n, (body, given) in enumerate(zip(others, predictions, strict=True)):
        name = f"predictions[{n}]"
        t, x, y, heading = table(name, given, 4).T
        check(
            f"{name}: t", t, t[0] <= 1e-6 and np.all(np.diff(t) > 0), "from 0 s, rising"
        )
        check_radians(f"{name}: heading", float(heading[np.argmax(np.abs(heading))]))
        s, l = frame.project(np.stack([x, y], axis=1))
        tilt = np.unwrap(frame.tilt(s, heading))
        s = s - s0
        rate = np.gradient(s, t) if t.size > 1 else body.speed * np.cos(tilt)
        s, l, tilt, rate = (np.interp(TIMES_S, t, z) for z in (s, l, tilt, rate))
        half_s, half_l = extents(body.length * ones, body.width * ones, tilt)
        boxes = (
            s - half_s,
            s + half_s,
            l - half_l,
            l + half_l,
            rate,
            t[-1] + 1e-6 >= TIMES_S,
        )
        for key, values in zip(names, boxes, strict=True):
            found[key][n] = values
    return found


def _with_futures(seen: Obstacles, futures: dict, first: jax.Array) -> Obstacles:
    """Return obstacles with the given futures instead of predicted ones."""
    count = len(futures["speed"])
    leaves = {}
    for name, values in futures.items():
        table = np.array(getattr(seen, name))
        for slot, body in enumerate(np.asarray(first).tolist()):
            if body < count:
                table[slot] = values[body]
        leaves[name] = jnp.asarray(table)
    return seen.replace(**leaves)
