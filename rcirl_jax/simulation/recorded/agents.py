"""The other road users of a recorded drive, as agents of its case."""

import numpy as np

from rcirl_jax.simulation.cases import (
    NUM_AGENTS,
    NUM_MOVES,
    NUM_PHASES,
    Agents,
    Driver,
    Script,
    node,
)
from rcirl_jax.types import Kind

# median drivers of the IDM population: T s, s0 m, a and b m/s^2, reaction s
MEDIAN = {"headway": 1.4, "standstill": 2.0, "acceleration": 1.4, "braking": 2.0}
MEDIAN |= {"delay": 0.4}
LIMIT_SHARE = 0.8  # 1, desired speed = max(fastest recorded, this share of the limit)
KEEPS_LANE = 0.17  # sin of 10 degrees; who heads so keeps a lane (agents.LANE_TILT)


def agents_of(tables: dict, limit: np.ndarray) -> Agents:
    """The replayed agents, and their driver model once they leave the log.

    They never appear by themselves (`appear_s` = inf): the log brings them.
    """
    kind, present = tables["kind"], tables["present"]
    drives_by_itself = (kind == Kind.VEHICLE) | (kind == Kind.CYCLIST)
    first = np.argmax(present, axis=1)[:, None]
    start = lambda key: np.take_along_axis(tables[key], first, 1)[:, 0]  # noqa: E731
    fastest = np.max(np.where(present, tables["v"], 0.0), axis=1)
    share = np.max(np.where(present, limit * LIMIT_SHARE, 0.0), axis=1)
    share = np.where(kind == Kind.VEHICLE, share, 0.0)
    sine, cosine = (
        np.sum(np.where(present, wave(tables["heading"]), 0.0), axis=1)
        for wave in (np.sin, np.cos)
    )
    heading = np.arctan2(sine, cosine)
    along = np.where(cosine >= 0.0, 0.0, np.pi)
    heading = np.where(np.abs(np.sin(heading)) < KEEPS_LANE, along, heading)
    fill = lambda value: np.full(NUM_AGENTS, value, np.float32)  # noqa: E731
    driver = node(
        Driver,
        desired=np.maximum(fastest, share).astype(np.float32),
        **{name: fill(value) for name, value in MEDIAN.items()},
        reacts=drives_by_itself,
        obeys_lines=kind == Kind.VEHICLE,
        changes_lane=np.zeros(NUM_AGENTS, bool),
        politeness=fill(0.0),
        threshold=fill(np.inf),
        lapse_start=fill(np.inf),
        lapse_end=fill(np.inf),
    )
    phases, moves = (NUM_AGENTS, NUM_PHASES), (NUM_AGENTS, NUM_MOVES)
    script = node(
        Script,
        start=np.full(phases, np.inf, np.float32),
        speed=np.zeros(phases, np.float32),
        rate=np.ones(phases, np.float32),
        move_start=np.full(moves, np.inf, np.float32),
        move_l=np.zeros(moves, np.float32),
        move_speed=np.ones(moves, np.float32),
    )
    script.start[kind == Kind.STATIC, 0] = 0.0  # target speed 0: stays where it is
    return node(
        Agents,
        kind=kind,
        **{name: tables[name].astype(np.float32) for name in ("length", "width")},
        appear_s=fill(np.inf),
        appear_t=fill(0.0),
        relative=np.zeros(NUM_AGENTS, bool),
        **{name: start(name).astype(np.float32) for name in ("s", "l", "v")},
        heading=heading.astype(np.float32),
        v_share=fill(0.0),
        arrival_s=fill(np.inf),
        driver=driver,
        script=script,
    )
