"""SUMO (Alvarez Lopez et al. 2018) by libsumo: corridors with lights, drawn here.

A main road crosses junctions with lights or, without lights, with the right of way:

                 d e        d e
                 | |        | |              a, d: side roads in,   b, e: out
    m0 ->  ------(1)-- m1 --(2)-- m2 --      m: the way of the ego, eastwards
    <- r0        | |        | |              r: back
                 b a        b a

libsumo holds one simulation a process, so the episodes of a run are corridors side by
side that no vehicle leaves; ids begin with the corridor's number: `3.m1`. The ego
drives straight on at every junction, with all of SUMO's checks of its speed and its
lane changes off: what it does at lights and behind others is the planner's alone. It
drives along the middle of its lane or, where paths are planned, beside it: SUMO has it
in the lane that its centre is on. The own driver is SUMO's Krauss model with its
default numbers, in the first lane.
"""

import dataclasses
import math
import random
import subprocess
import tempfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import libsumo
import numpy as np
import sumo

from rcirl_jax.errors import InputError
from rcirl_jax.export.own_planner.inputs import Body, Car, Signal
from rcirl_jax.simulation.agents import can_stop
from rcirl_jax.simulators.simulators import (
    STEP_S,
    Move,
    Running,
    View,
    Way,
    drawn_names,
)
from rcirl_jax.units import HORIZON_S

JUNCTIONS = 6
BLOCK_M = (180.0, 320.0)  # m between junctions
BEND_M = 3.0  # m that a junction lies aside: nobody has to slow down
SIDE_M = 150.0  # m, length of side roads
APART_M = 1000.0  # m between corridors
LIGHTS = 0.7  # 1, share of junctions with lights
LIMITS_MPS = (8.33, 13.89, 16.67, 19.44)  # m/s: 30, 50, 60 and 70 km/h
WARM_UP_S = 60  # s before the egos start
ENTRY_S = 30  # s that egos may wait for a gap at the corridors' beginning
TRUCKS = 0.1  # 1, share of the traffic
NEAR_M = 150.0  # m within which others are shown
SIGNAL_M = 250.0  # m within which lights are
STATES = {"r": "red", "u": "red", "y": "yellow", "Y": "yellow"}  # others: green
MOST_MPS = 25.0  # m/s, above every speed of an ego
FREE = 0  # no checks of speed or of lane changes
KRAUSS = "Krauss"
SPREAD = 'speedFactor="normc(1,0.1,0.7,1.3)"'
TYPES = (  # the others: Krauss drivers, each with a speed of its own; and the ego
    '<vTypeDistribution id="others">',
    f'<vType id="car" probability="{1 - TRUCKS}" {SPREAD}/>',
    '<vType id="truck" vClass="truck" length="10" accel="1.3" '
    f'probability="{TRUCKS}" {SPREAD}/>',
    "</vTypeDistribution>",
    '<vType id="ego" speedFactor="1" speedDev="0"/>',
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Kind:
    """Lanes of the main road, and vehicles per second that enter."""

    lanes: int
    main: float  # on the main road, either way
    side: float  # on each side road


KINDS = {
    "sparse": Kind(lanes=2, main=0.05, side=0.01),
    "dense": Kind(lanes=2, main=0.25, side=0.04),
    "single": Kind(lanes=1, main=0.12, side=0.02),
}


class Sumo:
    """Episodes on corridors of `KINDS`."""

    name = "sumo"
    own_drivers = (KRAUSS,)
    together = 25
    changes_lanes = True

    def episodes(self, count: int, seed: int) -> list[str]:
        """Return KIND/SEED/NUMBER; traffic depends on who runs beside it."""
        return drawn_names(list(KINDS), count, seed)

    def start(self, episodes: Sequence[str], own: str | None) -> Running:
        """Begin one simulation of as many corridors."""
        return Corridors(episodes, own)


class Corridors:
    """A simulation; see `simulators.Running`."""

    def __init__(self, episodes: Sequence[str], own: str | None) -> None:
        seed = zlib.crc32(" ".join(episodes).encode()) % 2**31
        with tempfile.TemporaryDirectory() as folder:
            network, routes = write_corridors(Path(folder), episodes)
            libsumo.start(  # quiet, exact steps, nobody moved away after a jam
                [
                    *("sumo", "-n", str(network), "-r", str(routes)),
                    *("--seed", str(seed), "--step-length", str(STEP_S)),
                    *("--step-method.ballistic", "true", "--time-to-teleport", "-1"),
                    *("--collision.action", "none", "--no-step-log", "true"),
                    *("--no-warnings", "true", "--duration-log.disable", "true"),
                ]
            )
        # every light's cycle begins somewhere
        for light in libsumo.trafficlight.getIDList():
            draw = random.Random(f"{episodes[int(light.partition('.')[0])]} {light}")
            phases = libsumo.trafficlight.getAllProgramLogics(light)[0].phases
            phase = draw.randrange(len(phases))
            rest = draw.uniform(0.0, phases[phase].duration)
            libsumo.trafficlight.setPhase(light, phase)
            libsumo.trafficlight.setPhaseDuration(light, rest)
        self._sizes: dict[str, tuple[float, float]] = {}
        egos = [f"{n}.ego" for n in range(len(episodes))]
        on_the_road: set[str] = set()
        # the traffic drives until every ego is on its road, or has waited enough
        while libsumo.simulation.getTime() < WARM_UP_S + ENTRY_S:
            libsumo.simulationStep()
            for name in set(egos) & set(libsumo.simulation.getDepartedIDList()):
                libsumo.vehicle.setLaneChangeMode(name, FREE)
            on_the_road = set(libsumo.vehicle.getIDList())
            if set(egos) <= on_the_road:
                break
        self._egos = [
            Ego(name, n, own) if name in on_the_road else None
            for n, name in enumerate(egos)
        ]
        self._views = self._look()

    def look(self) -> list[View | None]:
        """Return what each ego sees; None: it left its road, or never came onto it."""
        return self._views

    def step(self, moves: Sequence[Move | None]) -> None:
        """Advance all corridors by 0.1 s."""
        for ego, move in zip(self._egos, moves, strict=True):
            if ego is not None and move is not None:
                ego.go(move)
        libsumo.simulationStep()
        self._views = self._look()

    def close(self) -> None:
        """End the simulation."""
        libsumo.close()

    def _look(self) -> list[View | None]:
        """Return the views; an ego that is gone stays so."""
        beside: dict[str, list[str]] = {}
        for name in libsumo.vehicle.getIDList():
            beside.setdefault(name.partition(".")[0], []).append(name)
        for n, ego in enumerate(self._egos):
            if ego is not None and ego.name not in beside.get(str(n), ()):
                self._egos[n] = None
        return [
            ego and ego.look(self._near(ego.name, beside[str(n)]))
            for n, ego in enumerate(self._egos)
        ]

    def _near(self, ego: str, names: Sequence[str]) -> list[Body]:
        """Return the others of a corridor around its ego."""
        get, (x, y) = libsumo.vehicle, libsumo.vehicle.getPosition(ego)
        found = []
        for name in names:
            front_x, front_y = get.getPosition(name)
            if name == ego or math.hypot(front_x - x, front_y - y) >= NEAR_M:
                continue
            if name not in self._sizes:
                self._sizes[name] = (get.getLength(name), get.getWidth(name))
            length, width = self._sizes[name]
            # SUMO's angles are degrees clockwise from north
            heading = math.remainder(math.radians(90.0 - get.getAngle(name)), math.tau)
            body = Body(
                x=front_x - 0.5 * length * math.cos(heading),
                y=front_y - 0.5 * length * math.sin(heading),
                heading=heading,
                speed=max(get.getSpeed(name), 0.0),
                acceleration=get.getAcceleration(name),
                length=length,
                width=width,
            )
            found.append(body)
        return found


class Ego:
    """The ego of a corridor and the way that it drives.

    Args:
      name: of SUMO's vehicle.
      number: of the corridor.
      own: the own driver that drives it; None: moves do.
    """

    def __init__(self, name: str, number: int, own: str | None) -> None:
        self.name, self._own = name, own
        self._ways = _ways(_main_road(number))
        self._lane = 0
        self._beside: tuple[float, float, float] | None = None
        self._size = (libsumo.vehicle.getLength(name), libsumo.vehicle.getWidth(name))
        self._acceleration = 0.0
        self._start, self._driven = self._front(), 0.0
        self._next = self._light()
        self._halts: set[str] = set()  # lights that it stops for
        if own is None:
            libsumo.vehicle.setSpeedMode(name, FREE)

    def go(self, move: Move) -> None:
        """Set the speed at the end of the next step, and the lane that it is on."""
        libsumo.vehicle.setSpeed(self.name, move.speed)
        self._acceleration, self._beside = move.acceleration, move.beside
        if move.beside is None:
            return
        # lanes are counted from the right
        lane = self._lane + round(move.beside[0] / self._width)
        lane = min(max(lane, 0), len(self._ways) - 1)
        if lane != self._lane:
            libsumo.vehicle.changeLane(self.name, lane, STEP_S)

    def look(self, others: Sequence[Body]) -> View | None:
        """Return what is seen; None: the way ends within the planner's horizon."""
        get, aside, length = libsumo.vehicle, self._changed(), self._size[0]
        front, way = self._front(), self._ways[self._lane][1]
        if front + MOST_MPS * HORIZON_S > way.stations[-1]:
            return None
        self._driven = front - self._start
        x, y, heading, curvature = way.beside(front - 0.5 * length, self._beside)
        own = get.getAcceleration(self.name)
        before, self._next = self._next, self._light()
        passed_red = False
        if before is not None and before[0] != (self._next or ("",))[0]:
            shows = libsumo.trafficlight.getRedYellowGreenState(before[0])[before[1]]
            passed_red = STATES.get(shows) == "red"
        return View(
            ego=Car(
                x=x,
                y=y,
                heading=heading,
                speed=max(get.getSpeed(self.name), 0.0),
                acceleration=self._acceleration if self._own is None else own,
                curvature=curvature,
                length=length,
                width=self._size[1],
            ),
            centre_line=way.centre_line,
            obstacles=others,
            signals=self._signals(front),
            way=self._driven,
            speed_limit=way.limit(front),
            passed_red=int(passed_red),
            aside=aside,
        )

    @property
    def _width(self) -> float:
        """The width m of a lane."""
        return self._ways[0][1].centre_line.lane_width

    def _changed(self) -> float:
        """Take the lane that SUMO has the ego on; return how far m left it lies."""
        at = libsumo.vehicle.getLaneID(self.name)
        begins = [at in begins for begins, _ in self._ways]
        lane = begins.index(True) if any(begins) else self._lane
        aside, self._lane = (lane - self._lane) * self._width, lane
        if aside and self._beside is not None:
            step = libsumo.vehicle.getSpeed(self.name) * STEP_S
            self._start = self._front() - self._driven - step
            l, dl, ddl = self._beside
            self._beside = (l - aside, dl, ddl)
        return aside

    def _front(self) -> float:
        """Return the station m of the front bumper."""
        lane = libsumo.vehicle.getLaneID(self.name)
        begins, _ = self._ways[self._lane]
        return begins[lane] + libsumo.vehicle.getLanePosition(self.name)

    def _light(self) -> tuple[str, int] | None:
        """Return the next light and which of its links the ego takes."""
        ahead = libsumo.vehicle.getNextTLS(self.name)
        return (ahead[0][0], ahead[0][1]) if ahead else None

    def _signals(self, front: float) -> list[Signal]:
        """Return the lights ahead, each where its stop line is.

        A yellow one that has demanded a stop is shown as red until it is green again,
        as in the package's own simulator: whoever brakes late by a little would else be
        let go on.
        """
        found, halts = [], set()
        way = self._ways[self._lane][1]
        speed = libsumo.vehicle.getSpeed(self.name)
        for light, _, distance, shown in libsumo.vehicle.getNextTLS(self.name):
            state = STATES.get(shown, "green")
            halt = state == "red" or light in self._halts or can_stop(speed, distance)
            if halt and state != "green":
                halts.add(light)
                state = "red"
            if distance < SIGNAL_M:
                x, y, *_ = way.place(front + distance)
                found.append(Signal(x=x, y=y, state=state))
        self._halts = halts
        return found


def _ways(edges: Sequence[str]) -> list[tuple[dict[str, float], Way]]:
    """Return the lanes that go straight on along all edges, from the right.

    Of each, the stations m where its parts begin, by lane of SUMO, and the way.
    """
    width = libsumo.lane.getWidth(f"{edges[0]}_0")
    found = []
    for lane in range(libsumo.edge.getLaneNumber(edges[0])):
        begins, points, limits, station = {}, [], [], 0.0
        for edge, after in zip(edges, [*edges[1:], None], strict=True):
            part = f"{edge}_{lane}"
            while part:  # a lane, and those across the junction behind it
                shape = np.array(libsumo.lane.getShape(part))
                begins[part] = station
                station += float(np.sum(np.hypot(*np.diff(shape, axis=0).T)))
                points.append(shape)
                limits += [libsumo.lane.getMaxSpeed(part)] * len(shape)
                links = libsumo.lane.getLinks(part)
                part = next((x[4] for x in links if x[0] == f"{after}_{lane}"), "")
        found.append((begins, np.concatenate(points), np.array(limits)))
    return [
        (
            begins,
            Way(
                points,
                limits,
                width,
                left=(len(found) - lane - 0.5) * width,
                right=(lane + 0.5) * width,
            ),
        )
        for lane, (begins, points, limits) in enumerate(found)
    ]


# ------------------------------------------------------- the files that SUMO reads


def write_corridors(folder: Path, episodes: Sequence[str]) -> tuple[Path, Path]:
    """Write the network and the routes of episodes side by side; return both files.

    Raises:
      InputError: netconvert refuses the network.
    """
    nodes, edges, traffic = [], [], []
    for number, name in enumerate(episodes):
        draw = random.Random(name)
        kind = KINDS[name.split("/")[0]]
        nodes += _nodes(number, draw)
        edges += _edges(number, kind, draw)
        traffic += _traffic(number, kind)
    by_depart = [element for _, element in sorted(traffic, key=lambda x: x[0])]
    files = {"nodes": nodes, "edges": edges, "routes": [*TYPES, *by_depart]}
    for root, elements in files.items():
        text = "\n".join([f"<{root}>", *elements, f"</{root}>"])
        (folder / f"{root}.xml").write_text(text + "\n")
    network = folder / "network.xml"
    done = subprocess.run(
        [
            str(Path(sumo.SUMO_HOME) / "bin" / "netconvert"),
            *("--node-files", str(folder / "nodes.xml")),
            *("--edge-files", str(folder / "edges.xml"), "-o", str(network)),
            *("--no-turnarounds", "true", "--no-warnings", "true"),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        why = " ".join(done.stderr.split())[:200]
        raise InputError(f"netconvert: {quoteattr(why)}: expected a network")
    return network, folder / "routes.xml"


def _main_road(number: int) -> list[str]:
    """Return the edges that the ego of a corridor drives on."""
    return [f"{number}.m{k}" for k in range(JUNCTIONS + 1)]


def _nodes(number: int, draw: random.Random) -> Iterator[str]:
    """Yield junctions 1 to JUNCTIONS from the west, and the ends of all roads."""

    def node(name: str, y: float, kind: str) -> str:
        return f'<node id="{number}.{name}" x="{x:.2f}" y="{y:.2f}" type="{kind}"/>'

    x, y0 = 0.0, number * APART_M
    for k in range(JUNCTIONS + 2):
        inside = 1 <= k <= JUNCTIONS
        y = y0 + draw.uniform(-BEND_M, BEND_M)
        is_light = inside and draw.random() < LIGHTS
        yield node(f"n{k}", y, "traffic_light" if is_light else "priority")
        if inside:
            yield node(f"s{k}", y - SIDE_M, "priority")
            yield node(f"t{k}", y + SIDE_M, "priority")
        x += draw.uniform(*BLOCK_M)


def _edges(number: int, kind: Kind, draw: random.Random) -> Iterator[str]:
    """Yield the main road both ways, a limit for each half of it, and side roads."""

    def edge(name: str, begin: str, end: str, lanes: int, limit: float, p: int) -> str:
        return (
            f'<edge id="{number}.{name}" from="{number}.{begin}" to="{number}.{end}" '
            f'numLanes="{lanes}" speed="{limit}" priority="{p}"/>'
        )

    first, second = draw.choice(LIMITS_MPS), draw.choice(LIMITS_MPS)
    for k in range(JUNCTIONS + 1):
        limit = first if k <= JUNCTIONS // 2 else second
        yield edge(f"m{k}", f"n{k}", f"n{k + 1}", kind.lanes, limit, 3)
        yield edge(f"r{k}", f"n{k + 1}", f"n{k}", kind.lanes, limit, 3)
    for k in range(1, JUNCTIONS + 1):
        for (into, out), end in (("ab", f"s{k}"), ("de", f"t{k}")):
            yield edge(f"{into}{k}", end, f"n{k}", 1, LIMITS_MPS[1], 1)
            yield edge(f"{out}{k}", f"n{k}", end, 1, LIMITS_MPS[1], 1)


def _traffic(number: int, kind: Kind) -> Iterator[tuple[float, str]]:
    """Yield (begin s, element) of the flows of a corridor and of its ego."""
    east = _main_road(number)
    west = [f"{number}.r{k}" for k in range(JUNCTIONS, -1, -1)]
    flows = [(east, 0.7 * kind.main), (west, 0.3 * kind.main)]
    for k in range(1, JUNCTIONS + 1):
        a, b, d, e = (f"{number}.{side}{k}" for side in "abde")
        back = JUNCTIONS + 1 - k  # edges of the way back before the junction
        off, cross = 0.15 * kind.main / JUNCTIONS, 0.4 * kind.side
        flows += [
            ([*way, out], off) for way in (east[:k], west[:back]) for out in (b, e)
        ]
        flows += [([a, *east[k:]], cross), ([d, *east[k:]], 0.5 * cross)]
        flows += [([a, e], cross), ([d, b], cross), ([d, *west[back:]], cross)]
    for n, (edges, rate) in enumerate(flows):
        yield (
            0.0,
            f'<flow id="{number}.{n}" type="others" begin="0" end="1000" '
            f'probability="{rate:.5f}" departLane="best" departSpeed="max">'
            f'<route edges="{" ".join(edges)}"/></flow>',
        )
    yield (
        WARM_UP_S,
        f'<vehicle id="{number}.ego" type="ego" depart="{WARM_UP_S}" departLane="0" '
        f'departSpeed="max"><route edges="{" ".join(east)}"/></vehicle>',
    )
