"""Moments of traffic drawn at random, as people give them to `scene_from`."""

import numpy as np

from rcirl_jax.export.own_planner.inputs import (
    BODY_KINDS,
    STATES,
    Body,
    Car,
    CentreLine,
    Signal,
)

# the order of the C++ header's states
CPP_STATES = ("red", "stop", "yellow", "green", "off")
assert set(CPP_STATES) == set(STATES)


def drawn(seed):
    """Keyword arguments of `scene_from`: a bent lane, traffic, lines, a path."""
    rng = np.random.default_rng(seed)
    draw = rng.uniform
    arc = np.cumsum(draw(1.0, 12.0, 60))
    turn = draw(-0.015, 0.015) * np.sin(arc / draw(30.0, 90.0)) + draw(-0.004, 0.004)
    heading = draw(-3.0, 3.0) + np.cumsum(turn * np.diff(arc, prepend=0.0))
    steps = np.diff(arc, prepend=0.0)[:, None]
    steps = steps * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    points = draw(-5000.0, 5000.0, 2) + np.cumsum(steps, axis=0)
    along = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    left = along[:, ::-1] * [-1.0, 1.0]

    def place(ahead, aside):
        """A point and the line's heading, some metres from the ego's."""
        s = np.clip(arc[8] + ahead, arc[0], arc[-1])
        mix = lambda x: np.array([np.interp(s, arc, x[:, i]) for i in (0, 1)])  # noqa: E731
        x, y = mix(points) + aside * mix(left)
        return {"x": float(x), "y": float(y)}, float(np.interp(s, arc, heading))

    def body():
        where, way = place(draw(-30.0, 120.0), draw(-6.0, 6.0))
        tilt = rng.choice([0.0, np.pi, np.pi / 2]) + draw(-0.2, 0.2)
        return Body(
            kind=str(rng.choice(BODY_KINDS)), **where, heading=way + tilt,
            speed=draw(0.0, 15.0), acceleration=draw(-4.0, 2.0),
            length=draw(0.5, 9.0), width=draw(0.4, 2.5),
        )  # fmt: skip

    where, way = place(draw(0.0, 20.0), draw(-1.5, 1.5))
    others = [body() for _ in range(rng.integers(0, 13))]
    states = rng.choice(CPP_STATES, rng.integers(0, 4))
    signals = [Signal(**place(draw(-20, 200), 0.0)[0], state=str(x)) for x in states]
    goal = place(draw(-20.0, 200.0), 0.0)[0]
    road = [[*place(x, np.sin(x / 30.0))[0].values()] for x in np.arange(-20, 250, 3.0)]
    return {
        "ego": Car(
            **where, heading=way + draw(-0.2, 0.2), speed=draw(0.0, 20.0),
            acceleration=draw(-2.0, 2.0), curvature=draw(-0.02, 0.02),
            length=draw(3.5, 6.0), width=draw(1.6, 2.2),
        ),
        "centre_line": CentreLine(
            points=points,
            speed_limit=draw(5.0, 30.0, len(points)),
            lane_width=draw(2.8, 4.0),
            road_left=None if seed % 3 else draw(2.0, 9.0),
        ),
        "obstacles": others,
        "signals": signals,
        "predictions": [future(rng, x) for x in others] if seed % 2 else None,
        "path": road if rng.random() < 0.5 else None,
        "destination": tuple(goal.values()) if rng.random() < 0.5 else None,
    }  # fmt: skip


def future(rng, body):
    """Rows (t, x, y, heading) of a body that turns and changes its speed."""
    t = np.cumsum(rng.uniform(0.1, 1.0, rng.integers(1, 20)))
    t -= t[0]
    heading = body.heading + rng.uniform(-0.1, 0.1) * t
    steps = np.diff(t, prepend=0.0) * rng.uniform(0.0, 12.0)
    x = body.x + np.cumsum(np.cos(heading) * steps)
    y = body.y + np.cumsum(np.sin(heading) * steps)
    return np.stack([t, x, y, heading], axis=1)


def as_words(given):
    """The numbers that onboard/tests/build_scene.cpp reads, as a text."""
    ego, line = given["ego"], given["centre_line"]
    limits = np.broadcast_to(line.speed_limit, len(line.points))
    edges = (-1.0 if x is None else x for x in (line.road_left, line.road_right))
    numbers = [*vars(ego).values(), line.lane_width, *edges, len(line.points)]
    for (x, y), limit in zip(line.points, limits, strict=True):
        numbers += [x, y, limit]
    futures = given["predictions"] or [()] * len(given["obstacles"])
    numbers.append(len(given["obstacles"]))
    for body, rows in zip(given["obstacles"], futures, strict=True):
        kind, *rest = vars(body).values()
        numbers += [1 + BODY_KINDS.index(kind), *rest, len(rows), *np.ravel(rows)]
    numbers.append(len(given["signals"]))
    for signal in given["signals"]:
        numbers += [signal.x, signal.y, CPP_STATES.index(signal.state)]
    path, goal = given["path"] or [], given["destination"]
    numbers += [len(path), *np.ravel(path), 0 if goal is None else 1, *(goal or ())]
    return " ".join(f"{float(x):.17g}" for x in numbers)
