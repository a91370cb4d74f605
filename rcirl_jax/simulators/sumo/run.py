"""Corridors of SUMO under way: what each ego sees, and its speed as a move says.

The ego drives along the middle of its lane, straight on at every junction, with all of
SUMO's checks of its speed and its lane changes off: what it does at lights and behind
others is the planner's alone. The own driver is SUMO's Krauss model with its default
numbers, in the same lane.
"""

import math
import random
import tempfile
import zlib
from collections.abc import Sequence
from pathlib import Path

import libsumo
import numpy as np

from rcirl_jax.export.own_planner.inputs import Body, Car, Signal
from rcirl_jax.simulation.world.lines import can_stop
from rcirl_jax.simulators.simulators import STEP_S, Move, Running, View
from rcirl_jax.simulators.sumo.network import KINDS, WARM_UP_S, main_road, write
from rcirl_jax.simulators.way import Way
from rcirl_jax.units import HORIZON_S

KRAUSS = "Krauss"
ENTRY_S = 30  # s that egos may wait for a gap at the corridors' beginning
NEAR_M = 150.0  # m within which others are shown
SIGNAL_M = 250.0  # m within which lights are
STATES = {"r": "red", "u": "red", "y": "yellow", "Y": "yellow"}  # others: green
MOST_MPS = 25.0  # m/s, above every speed of an ego
FREE = 0  # no checks of speed or of lane changes


class Sumo:
    """Episodes on corridors of `network.KINDS`."""

    name = "sumo"
    own_drivers = (KRAUSS,)
    together = 25

    def episodes(self, count: int, seed: int) -> list[str]:
        """KIND/SEED/NUMBER, kinds in turn; traffic depends on who runs beside it."""
        kinds = list(KINDS)
        return [f"{kinds[n % len(kinds)]}/{seed}/{n:04d}" for n in range(count)]

    def start(self, episodes: Sequence[str], own: str | None) -> Running:
        """One simulation of as many corridors."""
        return Corridors(episodes, own)


class Corridors:
    """A simulation; see `simulators.Running`."""

    def __init__(self, episodes: Sequence[str], own: str | None) -> None:
        with tempfile.TemporaryDirectory() as folder:
            network, routes = write(Path(folder), episodes)
            libsumo.start(_command(network, routes, episodes))
        _shift_lights(episodes)
        self._sizes: dict[str, tuple[float, float]] = {}
        egos = [f"{n}.ego" for n in range(len(episodes))]
        _warm_up(egos)
        on_the_road = set(libsumo.vehicle.getIDList())
        self._egos = [
            Ego(name, n, own) if name in on_the_road else None
            for n, name in enumerate(egos)
        ]
        self._views = self._look()

    def look(self) -> list[View | None]:
        """What each ego sees; None: it has left its road, or never came onto it."""
        return self._views

    def step(self, moves: Sequence[Move | None]) -> None:
        """0.1 s of all corridors."""
        for ego, move in zip(self._egos, moves, strict=True):
            if ego is not None and move is not None:
                ego.go(move)
        libsumo.simulationStep()
        self._views = self._look()

    def close(self) -> None:
        """End the simulation."""
        libsumo.close()

    def _look(self) -> list[View | None]:
        names = libsumo.vehicle.getIDList()
        gone = set(self._names_of_egos()) - set(names)
        self._egos = [
            None if ego is None or ego.name in gone else ego for ego in self._egos
        ]
        beside: dict[str, list[str]] = {}
        for name in names:
            beside.setdefault(name.partition(".")[0], []).append(name)
        return [
            ego and ego.look(self._near(ego, beside[str(n)]))
            for n, ego in enumerate(self._egos)
        ]

    def _names_of_egos(self) -> list[str]:
        return [ego.name for ego in self._egos if ego is not None]

    def _near(self, ego: "Ego", names: Sequence[str]) -> list[Body]:
        """The others of a corridor around its ego."""
        x, y = libsumo.vehicle.getPosition(ego.name)
        found = []
        for name in names:
            there = libsumo.vehicle.getPosition(name)
            if name != ego.name and math.hypot(there[0] - x, there[1] - y) < NEAR_M:
                found.append(self._body(name, there))
        return found

    def _body(self, name: str, front: tuple[float, float]) -> Body:
        if name not in self._sizes:
            get = libsumo.vehicle
            self._sizes[name] = (get.getLength(name), get.getWidth(name))
        length, width = self._sizes[name]
        heading = _heading(libsumo.vehicle.getAngle(name))
        return Body(
            x=front[0] - 0.5 * length * math.cos(heading),
            y=front[1] - 0.5 * length * math.sin(heading),
            heading=heading,
            speed=max(libsumo.vehicle.getSpeed(name), 0.0),
            acceleration=libsumo.vehicle.getAcceleration(name),
            length=length,
            width=width,
        )


class Ego:
    """The ego of a corridor and the way that it drives.

    Args:
      name: of SUMO's vehicle.
      number: of the corridor.
      own: the own driver that drives it; None: moves do.
    """

    def __init__(self, name: str, number: int, own: str | None) -> None:
        self.name, self._own = name, own
        self._begins, self._way = _lanes(main_road(number))
        self._size = (libsumo.vehicle.getLength(name), libsumo.vehicle.getWidth(name))
        self._acceleration = 0.0
        self._start = self._front()
        self._next = self._light()
        self._halts: set[tuple[str, int]] = set()  # lights that it stops for
        if own is None:
            libsumo.vehicle.setSpeedMode(name, FREE)

    def go(self, move: Move) -> None:
        """Set the speed at the end of the next step."""
        libsumo.vehicle.setSpeed(self.name, move.speed)
        self._acceleration = move.acceleration

    def look(self, others: Sequence[Body]) -> View | None:
        """What is seen now; None: the way ends within the planner's horizon."""
        get, front = libsumo.vehicle, self._front()
        length, width = self._size
        if front + MOST_MPS * HORIZON_S > self._way.stations[-1]:
            return None
        x, y, heading, curvature = self._way.place(front - 0.5 * length)
        own = get.getAcceleration(self.name)
        before, self._next = self._next, self._light()
        return View(
            ego=Car(
                x=x,
                y=y,
                heading=heading,
                speed=max(get.getSpeed(self.name), 0.0),
                acceleration=self._acceleration if self._own is None else own,
                curvature=curvature,
                length=length,
                width=width,
            ),
            centre_line=self._way.centre_line,
            obstacles=others,
            signals=self._signals(front),
            way=front - self._start,
            speed_limit=self._way.limit(front),
            passed_red=int(_ran(before, self._next)),
        )

    def _front(self) -> float:
        """Station m of the front bumper."""
        lane = libsumo.vehicle.getLaneID(self.name)
        return self._begins[lane] + libsumo.vehicle.getLanePosition(self.name)

    def _light(self) -> tuple[str, int] | None:
        """The next light and which of its links the ego takes."""
        ahead = libsumo.vehicle.getNextTLS(self.name)
        return (ahead[0][0], ahead[0][1]) if ahead else None

    def _signals(self, front: float) -> list[Signal]:
        """The lights ahead, each where its stop line is.

        A yellow one that has demanded a stop is shown as red until it is green again,
        as in our simulator: whoever brakes late by a little would else be let go on.
        """
        found, halts = [], set()
        speed = libsumo.vehicle.getSpeed(self.name)
        for *light, distance, shown in libsumo.vehicle.getNextTLS(self.name):
            link, state = tuple(light), STATES.get(shown, "green")
            halt = state == "red" or link in self._halts or can_stop(speed, distance)
            if halt and state != "green":
                halts.add(link)
                state = "red"
            if distance < SIGNAL_M:
                x, y, *_ = self._way.place(front + distance)
                found.append(Signal(x=x, y=y, state=state))
        self._halts = halts
        return found


def _ran(before: tuple[str, int] | None, now: tuple[str, int] | None) -> bool:
    """Whether a light lies behind that shows red."""
    if before is None or before == now:
        return False
    shows = libsumo.trafficlight.getRedYellowGreenState(before[0])[before[1]]
    return STATES.get(shows) == "red"


def _lanes(edges: Sequence[str]) -> tuple[dict[str, float], Way]:
    """Stations m where the lanes of a way begin, and the way: lane 0 of each edge."""
    begins, points, limits, station = {}, [], [], 0.0
    for edge, after in zip(edges, [*edges[1:], None], strict=True):
        lane = f"{edge}_0"
        for part in [lane, *_across(lane, f"{after}_0")]:
            shape = np.array(libsumo.lane.getShape(part))
            begins[part] = station
            station += float(np.sum(np.hypot(*np.diff(shape, axis=0).T)))
            points.append(shape)
            limits += [libsumo.lane.getMaxSpeed(part)] * len(shape)
    width = libsumo.lane.getWidth(f"{edges[0]}_0")
    return begins, Way(np.concatenate(points), np.array(limits), width)


def _across(lane: str, after: str) -> list[str]:
    """The lanes of a junction that lead from a lane to another."""
    found = []
    for link in libsumo.lane.getLinks(lane):
        if link[0] != after:
            continue
        part = link[4]
        while part:
            found.append(part)
            (further,) = libsumo.lane.getLinks(part)
            part = further[4]
    return found


def _warm_up(egos: Sequence[str]) -> None:
    """Let the traffic drive until every ego is on its road, or has waited enough."""
    while libsumo.simulation.getTime() < WARM_UP_S + ENTRY_S:
        libsumo.simulationStep()
        for name in set(egos) & set(libsumo.simulation.getDepartedIDList()):
            libsumo.vehicle.setLaneChangeMode(name, FREE)
        if set(egos) <= set(libsumo.vehicle.getIDList()):
            return


def _shift_lights(episodes: Sequence[str]) -> None:
    """Begin every light's cycle somewhere."""
    for light in libsumo.trafficlight.getIDList():
        name = episodes[int(light.partition(".")[0])]
        draw = random.Random(f"{name} {light}")
        phases = libsumo.trafficlight.getAllProgramLogics(light)[0].phases
        phase = draw.randrange(len(phases))
        libsumo.trafficlight.setPhase(light, phase)
        libsumo.trafficlight.setPhaseDuration(
            light, draw.uniform(0.0, phases[phase].duration)
        )


def _command(network: Path, routes: Path, episodes: Sequence[str]) -> list[str]:
    """How SUMO is started: quiet, exact steps, nobody moved away after a jam."""
    seed = zlib.crc32(" ".join(episodes).encode()) % 2**31
    return [
        *("sumo", "-n", str(network), "-r", str(routes), "--seed", str(seed)),
        *("--step-length", str(STEP_S), "--step-method.ballistic", "true"),
        *("--time-to-teleport", "-1", "--collision.action", "none"),
        *("--no-step-log", "true", "--no-warnings", "true"),
        *("--duration-log.disable", "true"),
    ]


def _heading(angle: float) -> float:
    """Heading in rad counter-clockwise from x, of degrees clockwise from y."""
    return math.remainder(math.radians(90.0 - angle), math.tau)
