"""Hand-made cases: a straight road, named agents, everything else neutral."""

import numpy as np

from rcirl_jax.simulation.cases import (
    NUM_AGENTS,
    NUM_LINES,
    NUM_MOVES,
    NUM_PHASES,
    NUM_ROAD,
    Agents,
    Case,
    Driver,
    Lines,
    Perception,
    Road,
    Script,
)
from rcirl_jax.types import Kind

DRIVER = {
    "desired": 15.0, "headway": 1.4, "standstill": 2.0, "acceleration": 1.4,
    "braking": 2.0, "delay": 0.0, "reacts": True, "obeys_lines": True,
    "changes_lane": False, "politeness": 0.2, "threshold": 0.2,
    "lapse_start": np.inf, "lapse_end": np.inf,
}  # fmt: skip
AGENT = {
    "kind": Kind.VEHICLE, "length": 4.6, "width": 1.9, "appear_s": -np.inf,
    "appear_t": 0.0, "relative": False, "s": 50.0, "l": 0.0, "heading": 0.0,
    "v": 10.0, "v_share": 0.0, "arrival_s": np.inf,
}  # fmt: skip
EMPTY = AGENT | {"kind": Kind.NONE, "appear_s": np.inf, "s": 0.0, "v": 0.0}
BOOLS = ("reacts", "obeys_lines", "changes_lane", "relative")


def _column(rows, name):
    values = [row[name] for row in rows]
    if name in BOOLS:
        return np.array(values, bool)
    return np.array(values, np.int32 if name == "kind" else np.float32)


def make_agents(agents):
    """Agents with the given overrides first, empty slots after them.

    An override may name any field of Agents or Driver, `phases` as rows
    (start, speed, rate) and `moves` as rows (start, l, speed).
    """
    rows = [AGENT | DRIVER | dict(agent) for agent in agents]
    rows += [EMPTY | DRIVER] * (NUM_AGENTS - len(rows))
    full = lambda n, value: np.full((NUM_AGENTS, n), value, np.float32)  # noqa: E731
    phases, moves = ("start", "speed", "rate"), ("move_start", "move_l", "move_speed")
    script = dict(
        zip(phases, (full(NUM_PHASES, x) for x in (np.inf, 0, 1)), strict=True)
    )
    script |= zip(moves, (full(NUM_MOVES, x) for x in (np.inf, 0, 1)), strict=True)
    for i, row in enumerate(rows):
        for given, names in (("phases", phases), ("moves", moves)):
            for number, values in enumerate(row.get(given, ())):
                for name, value in zip(names, values, strict=True):
                    script[name][i, number] = value
    return Agents(
        **{name: _column(rows, name) for name in AGENT},
        driver=Driver(**{name: _column(rows, name) for name in DRIVER}),
        script=Script(**script),
    )


def make_case(
    agents=(), lines=(), speed=10.0, limit=15.0, kappa=0.0, path_l=0.0, lanes=(0, 0),
    steps=1200, seed=0, **perception,
):  # fmt: skip
    """A straight (or given) road; lines are dicts of Lines fields."""
    grid = np.ones((NUM_ROAD,), np.float32)
    slots = {
        name: np.zeros((NUM_LINES,), np.int32 if name == "kind" else np.float32)
        for name in ("kind", "s", "offset", "green", "yellow", "red")
    }
    for i, line in enumerate(lines):
        for name, value in line.items():
            slots[name][i] = value
    f = np.float32
    noise = {"sigma_position": 0.0, "sigma_speed": 0.0, "latency": 0.0, "dropout": 0.0}
    return Case(
        seed=np.uint32(seed),
        steps=np.int32(steps),
        ego_v=f(speed),
        ego_length=f(4.933),
        ego_width=f(2.11),
        road=Road(
            kappa=np.asarray(kappa * grid, f),
            speed_limit=np.asarray(limit * grid, f),
            path_l=np.asarray(path_l * grid, f),
            lane_width=f(3.5),
            lanes_left=np.int32(lanes[0]),
            lanes_right=np.int32(lanes[1]),
            edge_left=f(3.5 * (lanes[0] + 0.5) + 0.5),
            edge_right=f(-3.5 * (lanes[1] + 0.5) - 0.5),
            destination=f(1e6),
        ),
        lines=Lines(**slots),
        agents=make_agents(agents),
        perception=Perception(**{k: f(v) for k, v in (noise | perception).items()}),
    )
