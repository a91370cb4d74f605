"""The other road users of a recorded drive, as agents of its case."""

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.geometry.boxes import Box, overlaps
from rcirl_jax.simulation.cases import (
    NUM_AGENTS,
    NUM_MOVES,
    NUM_PHASES,
    Agents,
    Driver,
    Script,
    node,
)
from rcirl_jax.simulation.recorded.config import RecordedConfig
from rcirl_jax.types import Kind

KEEPS_LANE = 0.17  # sin of 10 degrees; who heads so keeps a lane (agents.LANE_TILT)


def agents_of(tables: dict, limit: np.ndarray, config: RecordedConfig) -> Agents:
    """Who the replayed agents are, and how they drive once they leave the log.

    They never appear by themselves (`appear_s` = inf): the log brings them.
    """
    kind, present = tables["kind"], tables["present"]
    drives_by_itself = (kind == Kind.VEHICLE) | (kind == Kind.CYCLIST)
    first = np.argmax(present, axis=1)[:, None]
    start = lambda key: np.take_along_axis(tables[key], first, 1)[:, 0]  # noqa: E731
    fastest = np.max(np.where(present, tables["v"], 0.0), axis=1)
    share = np.max(np.where(present, limit, 0.0), axis=1)
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
        **{
            name: fill(getattr(config, name))
            for name in ("headway", "standstill", "acceleration", "braking", "delay")
        },
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


def touches(length: float, width: float, own: dict, tables: dict) -> bool:
    """Whether the human's box meets an agent's anywhere in the log."""
    x, y = (tables[name] - own[name] for name in "xy")
    reach = 0.5 * (length + width + tables["length"] + tables["width"])[:, None]
    near = tables["present"] & (np.hypot(x, y) < reach)
    slot, step = np.nonzero(near)
    if slot.size == 0:
        return False
    count = -(-slot.size // 256) * 256  # few sizes compile
    slot, step = np.resize(slot, count), np.resize(step, count)
    single = lambda *values: [jnp.asarray(v, jnp.float32) for v in values]  # noqa: E731
    zero = np.zeros(count)
    one = single(zero, zero, own["yaw"][step], zero + length, zero + width)
    size = (tables["length"][slot], tables["width"][slot])
    other = single(x[slot, step], y[slot, step], tables["yaw"][slot, step], *size)
    return bool(np.any(_meet(one, other)))


@jax.jit
def _meet(one: list[jax.Array], other: list[jax.Array]) -> jax.Array:
    """Whether boxes overlap, [q]; each a list of the leaves of `Box`."""
    box = lambda row: Box(  # noqa: E731
        x=row[0], y=row[1], heading=row[2], length=row[3], width=row[4]
    )
    return jax.vmap(lambda a, b: overlaps(box(a), box(b)))(one, other)
