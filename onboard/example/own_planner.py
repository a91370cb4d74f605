"""Ten candidates beside two cars: filtered, then judged by a learned reward.

    python own_planner.py weights.msgpack

Needs numpy and msgpack. Beside it: copies of features/columns.py, units.py,
planner/safety.py, export/reader.py, and of features.py and choose.py in
export/own_planner of rcirl_jax. The C++ twin, own_planner.cpp, prints the same numbers.
"""

import sys

import numpy as np
from choose import choose
from features import (
    HORIZON_S,
    NUM_STATIONS,
    NUM_TIMES,
    Ego,
    Kind,
    Obstacle,
    Path,
    Scene,
)
from reader import load_weights

SPEED = 12.0  # m/s, the ego's
TIMES = HORIZON_S * np.arange(NUM_TIMES) / (NUM_TIMES - 1)  # [T] s


def car(s: float, l: float, speed: float) -> Obstacle:
    """A car of 4.5 by 1.8 m that keeps its speed and its place across the road."""
    at, flat = s + speed * TIMES, np.ones(NUM_TIMES)
    return Obstacle(
        kind=Kind.VEHICLE,
        s_lower=at - 2.25,
        s_upper=at + 2.25,
        l_lower=(l - 0.9) * flat,
        l_upper=(l + 0.9) * flat,
        speed=speed * flat,
        valid=flat,
    )


reward = load_weights(sys.argv[1])
print(reward.describe())  # what it was trained for, and what not
flat = np.zeros(NUM_STATIONS)
scene = Scene(
    ego=Ego(v=SPEED, length=4.9, width=2.1),
    path=Path(kappa=flat, l=flat, speed_limit=flat + 13.9),
    obstacles=[car(s=30.0, l=0.0, speed=8.0), car(s=-15.0, l=3.6, speed=14.0)],
)
a = -3.0 + 0.5 * np.arange(10)[:, None]  # m/s^2, held until the ego stands
t = np.minimum(TIMES, SPEED / np.maximum(-a, 1e-9))
s = SPEED * t + 0.5 * a * t * t  # [10, T] m along the given path
own = -np.abs(a[:, 0])  # for a prior cost: your planner's own costs, negated
choice = choose(reward, scene, s, own=own)  # the safety filter first, then the value
for number, (value, why) in enumerate(zip(choice.values, choice.why, strict=True)):
    print(f"candidate {number}: {value:.9g} {why or 'is admissible'}")
print(f"best: candidate {choice.best}" if choice.best is not None else choice.none)
