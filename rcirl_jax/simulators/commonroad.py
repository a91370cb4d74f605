"""CommonRoad scenarios as episodes: a process of the other environment for each.

The ego is put on the reference path where its plan has it; an offset that it has at
first fades away. The others drive as they were recorded and react to nobody, so
that a crash counts only where it is the ego's fault. The own drivers are the reactive
planner by its own cost and, where weights are given, by the reward as its cost
(`commonroad_cost.py`). `commonroad_worker.py` is what runs in the other environment.
"""

import json
import math
import random
import subprocess
from collections.abc import Sequence
from pathlib import Path

from rcirl_jax.errors import InputError
from rcirl_jax.export.own_planner.inputs import Body, Car
from rcirl_jax.simulators.simulators import STEP_S, LockStep, Move, View, Way

DEFAULT = "reactive planner"
BY_REWARD = "reactive planner, reward as cost"
WORKER = "rcirl_jax.simulators.commonroad_worker"
LENGTH_M, WIDTH_M = 4.508, 1.61  # m, of the car that the reactive planner plans for
LANE_WIDTH_M = 3.5  # m
# what the worker says of each of the others
BODY = ["kind", "x", "y", "heading", "speed", "acceleration", "length", "width"]


class CommonRoad:
    """Scenario files of a folder.

    Args:
      scenarios: the folder.
      python: interpreter of an environment with `commonroad-reactive-planner`, msgpack
        and, without what it depends on, this package.
      weights: of the reward that is the planner's cost; "": none.
    """

    name = "commonroad"
    changes_lanes = False
    together = 4

    def __init__(self, scenarios: str, python: str, weights: str = "") -> None:
        self.files = {file.stem: file for file in Path(scenarios).rglob("*.xml")}
        self.python, self.weights = python, weights
        self.own_drivers = (DEFAULT, BY_REWARD) if weights else (DEFAULT,)
        if not self.files:
            raise InputError(f"scenarios: {scenarios}: none: expected XML files")

    def episodes(self, count: int, seed: int) -> list[str]:
        """Return SITE/SCENARIO of different files, drawn."""
        if count > len(self.files):
            raise InputError(
                f"episodes: {count}: expected at most {len(self.files)}, the "
                "scenarios that there are"
            )
        drawn = random.Random(seed).sample(sorted(self.files), count)
        return [f"{name.split('-')[0]}/{name}" for name in drawn]

    def start(self, episodes: Sequence[str], own: str | None) -> LockStep:
        """Begin a process for each."""
        cost = {None: [], DEFAULT: ["default"], BY_REWARD: [self.weights]}[own]
        files = [str(self.files[name.split("/")[1]]) for name in episodes]
        return LockStep([Replay([self.python, "-m", WORKER, f, *cost]) for f in files])


class Replay:
    """One scenario; see `simulators.Episode`.

    Args:
      command: that begins its worker; the fourth word is the scenario's file.
    """

    def __init__(self, command: Sequence[str]) -> None:
        self.python = command[0]
        try:
            self.process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
        except OSError as error:
            raise InputError(
                f"python: {self.python}: {error.strerror}: expected an interpreter "
                "with commonroad-reactive-planner"
            ) from None
        self.now = self._heard()
        if abs(self.now["dt"] - STEP_S) > 1e-6:
            self.close()
            raise InputError(
                f"{command[3]}: timeStepSize: {self.now['dt']:g}: expected {STEP_S:g} s"
            )
        self.line = Way(self.now["line"], self.now["limit"], LANE_WIDTH_M)
        self.begin, self.offset = self.line.project(*self.now["ego"][:2])
        self.station, self.way = self.begin, 0.0

    def _heard(self) -> dict:
        """Return what the worker says; {} where the scenario is over."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            self.close()
            raise InputError(f"python: {self.python}: ended: what it said stands above")
        return json.loads(line) or {}

    def look(self) -> View | None:
        """Return what is seen now."""
        if not self.now:
            return None
        x, y, heading, speed, acceleration, curvature = self.now["ego"]
        others = [dict(zip(BODY, row, strict=True)) for row in self.now["others"]]
        for other in others:
            other["heading"] = math.remainder(other["heading"], math.tau)
        return View(
            ego=Car(
                x=x,
                y=y,
                heading=heading,
                speed=max(speed, 0.0),
                acceleration=acceleration,
                curvature=curvature,
                length=LENGTH_M,
                width=WIDTH_M,
            ),
            centre_line=self.line.centre_line,
            obstacles=[Body(**other) for other in others],
            way=self.way,
            speed_limit=self.now["limit"],
        )

    def step(self, move: Move | None) -> None:
        """Advance 0.1 s; without a move the ego does not move."""
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        x, y, *_ = ego = self.now["ego"]
        if move is not None:
            self.station += move.way
            gone = self.station - self.begin
            *there, curvature = self.line.place(self.station, self.offset, gone)
            ego = [*there, move.speed, move.acceleration, curvature]
        said, limit = self._heard(), self.now["limit"]
        self.now = {"ego": ego, "limit": limit, **said} if said else {}
        if said:
            self.way += math.hypot(self.now["ego"][0] - x, self.now["ego"][1] - y)

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.communicate()
