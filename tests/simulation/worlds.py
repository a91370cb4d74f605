"""Hand-made cases: a straight road, named agents, everything else neutral."""

import numpy as np

from rcirl_jax.simulation.cases import (
    NUM_ROAD,
    Case,
    Lines,
    Road,
    agents_of,
    lines_of,
    perfect_perception,
)
from rcirl_jax.types import Kind

AGENT = {
    "desired": 15.0, "headway": 1.4, "standstill": 2.0, "acceleration": 1.4,
    "braking": 2.0, "delay": 0.0, "reacts": True, "obeys_lines": True,
    "changes_lane": False, "politeness": 0.2, "threshold": 0.2,
    "lapse_start": np.inf, "lapse_end": np.inf,
    "kind": Kind.VEHICLE, "length": 4.6, "width": 1.9, "appear_s": -np.inf,
    "appear_t": 0.0, "relative": False, "s": 50.0, "l": 0.0, "heading": 0.0,
    "v": 10.0, "v_share": 0.0, "arrival_s": np.inf, "phases": (), "moves": (),
}  # fmt: skip
LINE = dict.fromkeys(Lines.__dataclass_fields__, 0.0)


def make_case(
    agents=(), lines=(), speed=10.0, limit=15.0, kappa=0.0, path_l=0.0, lanes=(0, 0),
    steps=1200, seed=0, **perception,
):  # fmt: skip
    """A straight (or given) road; agents and lines override what is neutral."""
    grid, f = np.ones((NUM_ROAD,), np.float32), np.float32
    left, right = 3.5 * (lanes[0] + 0.5) + 0.5, -3.5 * (lanes[1] + 0.5) - 0.5
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
            edge_left=f(left),
            edge_right=f(right),
            route_left=np.asarray(left * grid, f),
            route_right=np.asarray(right * grid, f),
            destination=f(1e6),
        ),
        lines=lines_of([LINE | line for line in lines]),
        agents=agents_of([AGENT | agent for agent in agents]),
        perception=perfect_perception().replace(
            **{name: f(value) for name, value in perception.items()}
        ),
    )
