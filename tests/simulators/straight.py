"""A simulator for tests: a straight road with one car ahead at a constant speed."""

import numpy as np

from rcirl_jax.export.own_planner.inputs import Body, Car, CentreLine, Signal
from rcirl_jax.simulators.simulators import STEP_S, LockStep, Move, View

ROAD = CentreLine(points=[[-50.0, 0.0], [1500.0, 0.0]], speed_limit=15.0)


class Straight:
    """KIND is the leader's speed: "5/0/0001" has one of 5 m/s, 40 m ahead."""

    name = "straight"
    own_drivers = ("keeps 10 m/s",)
    together = 3
    changes_lanes = False

    def __init__(self, signals=()):
        self.signals = signals

    def episodes(self, count, seed):
        return [f"{5 * (n % 2)}/{seed}/{n:04d}" for n in range(count)]

    def start(self, episodes, own):
        return LockStep([StraightEpisode(name, self.signals) for name in episodes])


class StraightEpisode:
    def __init__(self, name, signals):
        self.lead_speed = float(name.split("/")[0])
        self.x, self.v, self.a, self.time = 0.0, 10.0, 0.0, 0.0
        self.signals = signals

    def look(self):
        if self.x > 1200.0:
            return None
        ahead = 40.0 + self.lead_speed * self.time
        moves = {"speed": self.v, "acceleration": self.a}
        return View(
            ego=Car(x=self.x, y=0.0, heading=0.0, length=5.0, width=2.0, **moves),
            centre_line=ROAD,
            obstacles=[
                Body(x=ahead, y=0.0, heading=0.0, speed=self.lead_speed,
                     length=4.0, width=1.8)
            ],
            signals=self.signals,
            way=self.x,
            speed_limit=15.0,
        )  # fmt: skip

    def step(self, move):
        self.time += STEP_S
        if move is None:
            self.x += self.v * STEP_S
        else:
            self.x, self.v, self.a = self.x + move.way, move.speed, move.acceleration

    def close(self):
        pass


def moved(way, speed, acceleration=0.0, beside=None):
    """A move whose plan nobody looks at."""
    future = np.zeros((18, 3), np.float32)
    a = acceleration
    return Move(way=way, speed=speed, acceleration=a, future=future, beside=beside)


def red_light(x):
    return [Signal(x=x, y=0.0, state="red")]
