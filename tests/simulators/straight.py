"""A simulator for tests: a straight road with one car ahead at a constant speed."""

from rcirl_jax.export.own_planner.inputs import Body, Car, CentreLine, Signal
from rcirl_jax.simulators.simulators import STEP_S, LockStep, View

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
        lead = Body(
            x=40.0 + self.lead_speed * self.time,
            y=0.0,
            heading=0.0,
            speed=self.lead_speed,
            length=4.0,
            width=1.8,
        )
        ego = Car(
            x=self.x,
            y=0.0,
            heading=0.0,
            speed=self.v,
            acceleration=self.a,
            length=5.0,
            width=2.0,
        )
        return View(
            ego=ego,
            centre_line=ROAD,
            obstacles=[lead],
            signals=self.signals,
            way=self.x,
            speed_limit=15.0,
        )

    def step(self, move):
        self.time += STEP_S
        if move is None:
            self.x += self.v * STEP_S
        else:
            self.x, self.v, self.a = self.x + move.way, move.speed, move.acceleration

    def close(self):
        pass


def red_light(x):
    return [Signal(x=x, y=0.0, state="red")]
