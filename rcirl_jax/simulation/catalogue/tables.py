"""The events of a case, joined into the fixed arrays of a `Case`."""

import dataclasses

import numpy as np

from rcirl_jax.simulation.cases import (
    NUM_AGENTS,
    NUM_LINES,
    NUM_MOVES,
    NUM_PHASES,
    NUM_ROAD,
    ROAD_STEP_M,
    Agents,
    Driver,
    Lines,
    Road,
    Script,
    node,
)
from rcirl_jax.simulation.catalogue.families import (
    DRIVER,
    FLAGS,
)
from rcirl_jax.types import Kind

STATIONS = np.arange(NUM_ROAD) * ROAD_STEP_M  # m, the road grid


@dataclasses.dataclass
class Parts:
    """The elements of all events of a case, joined."""

    kappa: np.ndarray
    limits: list[tuple[float, float]]
    shifts: list[tuple[float, float, float]]
    lines: list[dict[str, float]]
    agents: list[dict]


def road_of(road: dict[str, float], parts: Parts) -> Road:
    """The road grid: curvature, limits and the given path along it."""
    limit = np.full(NUM_ROAD, road["speed_limit"])
    for at, speed in sorted(parts.limits):
        limit[at <= STATIONS] = speed
    path = np.zeros(NUM_ROAD)
    for at, length, target in sorted(parts.shifts):
        begin = float(np.interp(at, STATIONS, path))
        u = np.clip((STATIONS - at) / max(length, ROAD_STEP_M), 0.0, 1.0)
        smooth = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
        path = np.where(at <= STATIONS, begin + (target - begin) * smooth, path)
    width = road["lane_width"]
    f = np.float32
    return node(
        Road,
        kappa=parts.kappa.astype(f),
        speed_limit=limit.astype(f),
        path_l=path.astype(f),
        lane_width=f(width),
        lanes_left=np.int32(road["lanes_left"]),
        lanes_right=np.int32(road["lanes_right"]),
        edge_left=f(
            (road["lanes_left"] + road["oncoming"] + 0.5) * width + road["shoulder"]
        ),
        edge_right=f(-((road["lanes_right"] + 0.5) * width + road["shoulder"])),
        destination=f(road["destination"]),
    )


def lines_of(parts: Parts) -> Lines:
    """Lights and stop signs; empty slots have kind NONE."""
    names = {"s": "at", "offset": "offset", "green": "green", "yellow": "yellow"}
    names["red"] = "red"
    made = {}
    for leaf, key in names.items():
        made[leaf] = np.zeros(NUM_LINES, np.float32)
        made[leaf][: len(parts.lines)] = [line[key] for line in parts.lines]
    kind = np.zeros(NUM_LINES, np.int32)
    kind[: len(parts.lines)] = [int(line["kind"]) for line in parts.lines]
    return node(Lines, kind=kind, **made)


def _column(rows: list[dict], name: str, empty: float) -> np.ndarray:
    out = np.full(NUM_AGENTS, empty, np.float32)
    out[: len(rows)] = [row[name] for row in rows]
    return out


def agents_of(rows: list[dict]) -> Agents:
    """Agents with their drivers and scripts; empty slots have kind NONE."""
    flags = {name: np.zeros(NUM_AGENTS, bool) for name in FLAGS}
    for name, values in flags.items():
        values[: len(rows)] = [row[name] for row in rows]
    kind = np.full(NUM_AGENTS, Kind.NONE, np.int32)
    kind[: len(rows)] = [row["kind"] for row in rows]
    neutral = {"headway": 1.4, "standstill": 2.0, "acceleration": 1.4, "braking": 2.0}
    neutral |= {"desired": 10.0, "lapse_start": np.inf, "lapse_end": np.inf}
    plain = ("s", "l", "heading", "v", "v_share", "appear_t")
    return node(
        Agents,
        kind=kind,
        length=_column(rows, "length", 1.0),
        width=_column(rows, "width", 1.0),
        appear_s=_column(rows, "appear_s", np.inf),
        arrival_s=_column(rows, "arrival_s", np.inf),
        relative=flags.pop("relative"),
        **{name: _column(rows, name, 0.0) for name in plain},
        driver=node(
            Driver,
            **flags,
            **{name: _column(rows, name, neutral.get(name, 0.0)) for name in DRIVER},
        ),
        script=_script(rows),
    )


def _script(rows: list[dict]) -> Script:
    f = np.float32
    start = np.full((NUM_AGENTS, NUM_PHASES), np.inf, f)
    speed, rate = np.zeros_like(start), np.ones_like(start)
    move_start = np.full((NUM_AGENTS, NUM_MOVES), np.inf, f)
    move_l, move_speed = np.zeros_like(move_start), np.ones_like(move_start)
    for i, row in enumerate(rows):
        for p, phase in enumerate(row["phases"]):
            start[i, p], speed[i, p], rate[i, p] = phase
        for m, move in enumerate(row["moves"]):
            move_start[i, m], move_l[i, m], move_speed[i, m] = move
    return node(
        Script,
        start=start,
        speed=speed,
        rate=rate,
        move_start=move_start,
        move_l=move_l,
        move_speed=move_speed,
    )
