"""Corridors for SUMO: a main road across junctions with lights or with right of way.

                 d e        d e
                 | |        | |              a, d: side roads in,   b, e: out
    m0 ->  ------(1)-- m1 --(2)-- m2 --      m: the way of the ego, eastwards
    <- r0        | |        | |              r: back
                 b a        b a

At a junction without lights the main road has the right of way. Ids begin with the
corridor's number: `3.m1`.
"""

import dataclasses
import random
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import sumo

from rcirl_jax.errors import InputError

JUNCTIONS = 6
BLOCK_M = (180.0, 320.0)  # m between junctions
BEND_M = 3.0  # m that a junction lies aside: nobody has to slow down
SIDE_M = 150.0  # m, length of side roads
APART_M = 1000.0  # m between corridors
LIGHTS = 0.7  # 1, share of junctions with lights
LIMITS_MPS = (8.33, 13.89, 16.67, 19.44)  # m/s: 30, 50, 60 and 70 km/h
WARM_UP_S = 60  # s before the egos start
TRUCKS = 0.1  # 1, share of the traffic


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


def write(folder: Path, episodes: Sequence[str]) -> tuple[Path, Path]:
    """The network and the routes of episodes side by side; returns both files.

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
    _xml(folder / "nodes.xml", "nodes", nodes)
    _xml(folder / "edges.xml", "edges", edges)
    _xml(folder / "routes.xml", "routes", [*_types(), *_by_depart(traffic)])
    return _convert(folder), folder / "routes.xml"


def main_road(number: int) -> list[str]:
    """Edges that the ego of a corridor drives on."""
    return [f"{number}.m{k}" for k in range(JUNCTIONS + 1)]


def _nodes(number: int, draw: random.Random) -> Iterator[str]:
    """Junctions 1 to JUNCTIONS from the west, the main road's ends, those of sides."""
    x, y0 = 0.0, number * APART_M
    for k in range(JUNCTIONS + 2):
        inside = 1 <= k <= JUNCTIONS
        y = y0 + draw.uniform(-BEND_M, BEND_M)
        is_light = inside and draw.random() < LIGHTS
        kind = "traffic_light" if is_light else "priority"
        yield _node(f"{number}.n{k}", x, y, kind)
        if inside:
            yield _node(f"{number}.s{k}", x, y - SIDE_M, "priority")
            yield _node(f"{number}.t{k}", x, y + SIDE_M, "priority")
        x += draw.uniform(*BLOCK_M)


def _node(name: str, x: float, y: float, kind: str) -> str:
    return f'<node id="{name}" x="{x:.2f}" y="{y:.2f}" type="{kind}"/>'


def _edges(number: int, kind: Kind, draw: random.Random) -> Iterator[str]:
    """Main road both ways, with a limit for each half of it, and the side roads."""
    first, second = draw.choice(LIMITS_MPS), draw.choice(LIMITS_MPS)
    for k in range(JUNCTIONS + 1):
        here, there = f"{number}.n{k}", f"{number}.n{k + 1}"
        limit = first if k <= JUNCTIONS // 2 else second
        yield _edge(f"{number}.m{k}", here, there, kind.lanes, limit, 3)
        yield _edge(f"{number}.r{k}", there, here, kind.lanes, limit, 3)
    for k in range(1, JUNCTIONS + 1):
        for name, end in (("ab", f"{number}.s{k}"), ("de", f"{number}.t{k}")):
            here = f"{number}.n{k}"
            yield _edge(f"{number}.{name[0]}{k}", end, here, 1, LIMITS_MPS[1], 1)
            yield _edge(f"{number}.{name[1]}{k}", here, end, 1, LIMITS_MPS[1], 1)


def _edge(
    name: str, begin: str, end: str, lanes: int, limit: float, priority: int
) -> str:
    return (
        f'<edge id="{name}" from="{begin}" to="{end}" numLanes="{lanes}" '
        f'speed="{limit}" priority="{priority}"/>'
    )


def _types() -> list[str]:
    """The others: SUMO's Krauss drivers, each with a speed of its own; the ego."""
    spread = 'speedFactor="normc(1,0.1,0.7,1.3)"'
    return [
        '<vTypeDistribution id="others">',
        f'<vType id="car" probability="{1 - TRUCKS}" {spread}/>',
        f'<vType id="truck" vClass="truck" length="10" accel="1.3" '
        f'probability="{TRUCKS}" {spread}/>',
        "</vTypeDistribution>",
        '<vType id="ego" speedFactor="1" speedDev="0"/>',
    ]


def _traffic(number: int, kind: Kind) -> Iterator[tuple[float, str]]:
    """(begin s, element) of the flows of a corridor and of its ego."""
    east = main_road(number)
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


def _by_depart(traffic: Sequence[tuple[float, str]]) -> list[str]:
    return [element for _, element in sorted(traffic, key=lambda item: item[0])]


def _xml(path: Path, root: str, elements: Sequence[str]) -> None:
    path.write_text("\n".join([f"<{root}>", *elements, f"</{root}>"]) + "\n")


def _convert(folder: Path) -> Path:
    """SUMO's network, by netconvert."""
    network = folder / "network.xml"
    program = Path(sumo.SUMO_HOME) / "bin" / "netconvert"
    done = subprocess.run(
        [
            *(str(program), "--node-files", str(folder / "nodes.xml")),
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
    return network
