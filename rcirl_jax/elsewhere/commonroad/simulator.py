"""CommonRoad scenarios as episodes: a process of the other environment for each.

The ego is put on the reference path where its plan has it; an offset that it has at
first fades over 40 m. The others drive as they were recorded and react to nobody, so
that a crash counts only where it is the ego's fault. The own drivers are the reactive
planner by its own cost and, where weights are given, by the reward as its cost.
"""

import json
import math
import random
import subprocess
from collections.abc import Sequence
from pathlib import Path

from rcirl_jax.elsewhere.simulators import STEP_S, LockStep, Move, View
from rcirl_jax.elsewhere.way import Way
from rcirl_jax.errors import InputError
from rcirl_jax.export.own_planner.inputs import Body, Car

DEFAULT = "reactive planner"
BY_REWARD = "reactive planner, reward as cost"
WORKER = "rcirl_jax.elsewhere.commonroad.worker"
ROOT = Path(__file__).resolve().parents[3]
LENGTH_M, WIDTH_M = 4.508, 1.61  # m, of the car that the reactive planner plans for
LANE_WIDTH_M = 3.5  # m
FADING_M = 40.0  # m of way after which the ego is on the reference path
SAID = 400  # characters of a worker's last words that are shown


class CommonRoad:
    """Scenario files of a folder.

    Args:
      scenarios: the folder.
      python: interpreter of an environment with `commonroad-reactive-planner` and
        msgpack.
      weights: of the reward that is the planner's cost; "": none.
    """

    name = "commonroad"
    together = 4

    def __init__(self, scenarios: str, python: str, weights: str = "") -> None:
        self.files = {file.stem: file for file in Path(scenarios).rglob("*.xml")}
        self.python, self.weights = python, weights
        self.own_drivers = (DEFAULT, BY_REWARD) if weights else (DEFAULT,)
        if not self.files:
            raise InputError(f"scenarios: {scenarios}: none: expected XML files")

    def episodes(self, count: int, seed: int) -> list[str]:
        """SITE/SCENARIO of different files, drawn."""
        if count > len(self.files):
            raise InputError(
                f"--episodes: {count}: expected at most {len(self.files)}, the "
                "scenarios that there are"
            )
        drawn = random.Random(seed).sample(sorted(self.files), count)
        return [f"{name.split('-')[0]}/{name}" for name in drawn]

    def start(self, episodes: Sequence[str], own: str | None) -> LockStep:
        """A process for each."""
        cost = {None: [], DEFAULT: ["default"], BY_REWARD: [self.weights]}[own]
        files = [self.files[name.split("/")[1]] for name in episodes]
        return LockStep([Replay([self.python, "-m", WORKER, f, *cost]) for f in files])


class Replay:
    """One scenario; see `simulators.Episode`.

    Args:
      command: that begins its worker.
    """

    def __init__(self, command: Sequence[str | Path]) -> None:
        pipe = subprocess.PIPE
        words = [str(word) for word in command]
        try:
            self.process = subprocess.Popen(
                words, stdin=pipe, stdout=pipe, stderr=pipe, text=True, cwd=ROOT
            )
        except OSError as error:
            raise InputError(
                f"python: {words[0]}: {error.strerror}: expected an interpreter with "
                "commonroad-reactive-planner"
            ) from None
        self.now = self._heard()
        if abs(self.now["dt"] - STEP_S) > 1e-6:
            raise InputError(
                f"{words[3]}: timeStepSize: {self.now['dt']:g}: expected {STEP_S:g} s"
            )
        self.line = Way(self.now["line"], self.now["limit"], LANE_WIDTH_M)
        x, y, *_ = self.now["ego"]
        self.begin = self.station = self.line.station(x, y)
        at, left, along, _ = self.line.place(self.station)
        self.offset = (y - left) * math.cos(along) - (x - at) * math.sin(along)
        self.way = 0.0

    def _heard(self) -> dict:
        """What the worker says; {} where the scenario is over."""
        assert self.process.stdout is not None
        assert self.process.stderr is not None
        line = self.process.stdout.readline()
        if not line:
            said = self.process.stderr.read().strip()[-SAID:]
            raise InputError(f"commonroad: the worker ended: {said}")
        return json.loads(line) or {}

    def look(self) -> View | None:
        """What is seen now."""
        if not self.now:
            return None
        x, y, heading, speed, acceleration, curvature = self.now["ego"]
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
            obstacles=[_body(row) for row in self.now["others"]],
            way=self.way,
            speed_limit=self.now["limit"],
        )

    def step(self, move: Move | None) -> None:
        """0.1 s on."""
        assert self.process.stdin is not None
        before = self.now
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        said = self._heard()
        if said and move is not None:
            said = {"limit": before["limit"], **said, "ego": self._moved(move)}
        if said:
            x, y, *_ = before["ego"]
            self.way += math.hypot(said["ego"][0] - x, said["ego"][1] - y)
        self.now = said

    def _moved(self, move: Move) -> list[float]:
        """The ego a way farther on its line."""
        self.station += move.way
        share = min((self.station - self.begin) / FADING_M, 1.0)
        aside = self.offset * (1.0 - share) ** 2 * (1.0 + 2.0 * share)
        x, y, heading, curvature = self.line.place(self.station)
        x, y = x - aside * math.sin(heading), y + aside * math.cos(heading)
        return [x, y, heading, move.speed, move.acceleration, curvature]

    def close(self) -> None:
        """End the process."""
        for stream in (self.process.stdin, self.process.stdout, self.process.stderr):
            if stream is not None:
                stream.close()
        self.process.kill()
        self.process.wait()


def _body(row: list) -> Body:
    """One of the others."""
    kind, x, y, heading, speed, acceleration, length, width = row
    return Body(
        kind=kind,
        x=x,
        y=y,
        heading=math.remainder(heading, math.tau),
        speed=speed,
        acceleration=acceleration,
        length=length,
        width=width,
    )
