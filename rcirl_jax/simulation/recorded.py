"""Stored scenes as cases: the ego starts where the human was, among the logged others.

A Demonstration holds all that a short drive needs: the human's path and motion, the
others' recorded boxes, limits and lines. So held-out rewards can be driven in closed
loop from a dataset alone, on the scenes of its test split.

The others move as recorded, by cubic Hermite curves through the stored times, are
present while they were recorded, and turn to the IDM once the ego departs from its log
or a conflict is near (`Replay.turns_reactive`). A line that demanded a stop is a light
that is red for that time, green before and after.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.typing import ArrayLike
from scipy.interpolate import CubicHermiteSpline

from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.errors import InputError
from rcirl_jax.simulation.cases import (
    DRIVER,
    FLAGS,
    NUM_AGENTS,
    NUM_LINES,
    NUM_REPLAY,
    NUM_ROAD,
    ROAD_STEP_M,
    STEP_S,
    Agents,
    Case,
    LineKind,
    Lines,
    Replay,
    Road,
    agents_of,
    lines_of,
    node,
    perfect_perception,
)
from rcirl_jax.types import Demonstration, Kind
from rcirl_jax.units import DT_S, NUM_STATIONS, STATION_STEP_M, TIMES_S

# median drivers of the IDM population: T s, s0 m, a and b m/s^2, reaction s
MEDIAN = {"headway": 1.4, "standstill": 2.0, "acceleration": 1.4, "braking": 2.0}
MEDIAN |= {"delay": 0.4}
LIMIT_SHARE = 0.8  # 1, desired speed = max(fastest recorded, this share of the limit)
KEEPS_LANE = 0.17  # sin of 10 degrees; who heads so keeps a lane (agents.LANE_TILT)


def _agents(tables: dict, limit: np.ndarray) -> Agents:
    """The replayed agents, and their driver model once they leave the log.

    They never appear by themselves (`appear_s` = inf): the log brings them.
    """
    rows = []
    for i in np.flatnonzero(tables["kind"] != Kind.NONE):
        kind, present = tables["kind"][i], tables["present"][i]
        angle, first = tables["heading"][i], np.argmax(present)
        sine, cosine = (
            np.sum(np.where(present, wave(angle), 0.0)) for wave in (np.sin, np.cos)
        )
        heading = np.arctan2(sine, cosine)
        if np.abs(np.sin(heading)) < KEEPS_LANE:
            heading = 0.0 if cosine >= 0.0 else np.pi
        desired = np.max(np.where(present, tables["v"][i], 0.0))
        if kind == Kind.VEHICLE:
            share = np.max(np.where(present, limit[i] * LIMIT_SHARE, 0.0))
            desired = max(desired, share)
        names = (*DRIVER, *FLAGS, "appear_t", "v_share")
        row: dict[str, Any] = dict.fromkeys(names, 0.0) | MEDIAN
        row |= {name: tables[name][i] for name in ("kind", "length", "width")}
        row |= {name: tables[name][i, first] for name in ("s", "l", "v")}
        row |= dict.fromkeys(("threshold", "lapse_start", "lapse_end"), np.inf)
        row |= dict.fromkeys(("appear_s", "arrival_s"), np.inf)
        row |= {"heading": heading, "desired": desired}
        row["reacts"] = kind in (Kind.VEHICLE, Kind.CYCLIST)
        row["obeys_lines"] = kind == Kind.VEHICLE
        # target speed 0: stays where it is
        row["phases"] = [(0.0, 0.0, 1.0)] if kind == Kind.STATIC else []
        rows.append({**row, "moves": []})
    return agents_of(rows)


STEPS = NUM_REPLAY - 1  # of a case; one with a shorter record is padded
CLOCK_S = np.arange(STEPS + 1) * STEP_S  # [STEPS + 1] s
DATASET = 2**40  # apart are the numbers of two datasets
LONG_S = 1000.0  # s, a light that does not change within the case
MOVING_MPS = 0.5  # m/s, above which the direction of motion is the heading
EDGE_MARGIN_M = 0.3  # m between the human's box and the drivable area's edge


@dataclasses.dataclass(frozen=True, kw_only=True)
class HeldOut:
    """Drives of a test split, D of them."""

    cases: Case  # leaves [D, ...]
    ids: tuple[str, ...]  # "DATASET:ROW"
    vehicle: np.ndarray  # [D] int, number of the ego, distinct over datasets
    recording: np.ndarray  # [D] int, number of the recording, likewise
    rows: Demonstration  # leaves [D, ...], numpy
    available: int  # drives that the split has

    @property
    def names(self) -> dict[int, str]:
        """The ids by the numbers of the cases."""
        return dict(zip(np.asarray(self.cases.seed).tolist(), self.ids, strict=True))


def held_out(
    datasets: Sequence[Dataset], count: int, seed: int = 0, split: str = "test"
) -> HeldOut:
    """About `count` drives of a split, drawn evenly over datasets, recordings, egos.

    Args:
      datasets: each gives as many as the others, or all it has.
      count: of all together.
      seed: of the draw.
      split: whose egos drive.

    Raises:
      InputError: no scene in the split.
    """
    parts, ids, vehicles, recordings = [], [], [], []
    indices = [dataset.indices(split) for dataset in datasets]
    sizes = np.array([index.size for index in indices])
    share, enough = 1, min(count, sizes.sum())
    while np.minimum(sizes, share).sum() < enough:
        share += 1
    for number, (dataset, index) in enumerate(zip(datasets, indices, strict=True)):
        if index.size == 0:
            continue
        recording, vehicle = (
            dataset.column(name)[index].astype(np.int64)
            for name in ("recording", "vehicle")
        )
        at = drawn_evenly(recording, vehicle, share, seed)
        parts.append(dataset.read(index[at]))
        ids += [f"{number}:{row}" for row in index[at].tolist()]
        vehicles.append(number * DATASET + vehicle[at])
        recordings.append(number * DATASET + recording[at])
    if not parts:
        raise InputError(
            f"held-out drives: split {split}: 0 scenes: expected a dataset with some"
        )
    rows = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    cases = [case_of(jax.tree.map(lambda x, i=i: x[i], rows)) for i in range(len(ids))]
    return HeldOut(
        cases=jax.tree.map(lambda *x: np.stack(x), *cases),
        ids=tuple(ids),
        vehicle=np.concatenate(vehicles),
        recording=np.concatenate(recordings),
        rows=rows,
        available=int(sizes.sum()),
    )


def drawn_evenly(
    recording: np.ndarray, vehicle: np.ndarray, count: int, seed: int
) -> np.ndarray:
    """Places [<= count] of scenes: turn by turn over recordings, then over vehicles.

    Every recording gives one scene before any gives two, and within a recording every
    vehicle; which of a vehicle's scenes comes first is drawn.

    Args:
      recording: [n] int, of each scene.
      vehicle: [n] int, its ego.
      count: of scenes, at most.
      seed: of the draw.
    """
    order = np.random.default_rng([seed, 23]).permutation(recording.size)
    turn_of_vehicle = _turn(list(zip(recording[order], vehicle[order], strict=True)))
    second = order[np.argsort(turn_of_vehicle, kind="stable")]
    turn_of_recording = _turn(recording[second].tolist())
    return np.sort(second[np.argsort(turn_of_recording, kind="stable")][:count])


def _turn(keys: Sequence) -> np.ndarray:
    """Counts how often each key was met before, in order."""
    seen: dict = {}
    turns = []
    for key in keys:
        turns.append(seen.get(key, 0))
        seen[key] = turns[-1] + 1
    return np.array(turns)


def case_of(one: Demonstration) -> Case:
    """The case of one Demonstration, numpy leaves without a leading axis.

    It lasts as long as the human's future and all that the human reacts to are
    recorded (`time_valid`).
    """
    scene, single = one.scene, np.float32
    until = min(float(one.future_s), TIMES_S[np.asarray(scene.time_valid)].max())
    steps = min(int(until / STEP_S + 1e-3), STEPS)
    human = _hermite(one.human.s, one.human.v, np.ones(TIMES_S.size, bool))
    ego_s = np.maximum.accumulate(human(CLOCK_S))
    tables, lines = _others(one), _lines(one)
    limit = np.interp(
        np.maximum(tables["s"], 0.0), _stations(), np.asarray(scene.path.speed_limit)
    )
    return node(
        Case,
        seed=np.uint32(int(one.frame) * 7919 + int(one.vehicle)),
        steps=np.int32(steps),
        ego_v=single(scene.ego.v),
        ego_a=single(scene.ego.a),
        ego_length=single(scene.ego.length),
        ego_width=single(scene.ego.width),
        road=_road(one),
        lines=lines,
        agents=_agents(tables, limit),
        perception=perfect_perception(),
        replay=node(
            Replay,
            **{k: tables[k].astype(single) for k in ("s", "l", "heading", "v")},
            present=tables["present"] & (np.arange(CLOCK_S.size) <= steps),
            ego_s=ego_s.astype(single),
            ego_l=np.interp(CLOCK_S, TIMES_S, one.human.l).astype(single),
            ego_v=np.gradient(ego_s, STEP_S).astype(single),
            turns_reactive=np.bool_(True),
        ),
    )


def _stations() -> np.ndarray:
    return np.arange(NUM_STATIONS) * STATION_STEP_M


def _hermite(s: ArrayLike, v: ArrayLike, known: np.ndarray) -> CubicHermiteSpline:
    """Stations over time through the known times, with the recorded speeds."""
    at, rate = np.asarray(s, float)[known], np.asarray(v, float)[known]
    times = TIMES_S[known].astype(float)
    if times.size == 1:  # met once: goes on at its speed
        times = np.append(times, times + DT_S)
        at, rate = np.append(at, at + rate * DT_S), np.append(rate, rate)
    return CubicHermiteSpline(times, at, rate)


def _others(one: Demonstration) -> dict[str, np.ndarray]:
    """Motion tables [A, STEPS + 1] of the bodies in their order, and sizes [A]."""
    o = one.scene.obstacles
    shape = (NUM_AGENTS, CLOCK_S.size)
    tables = {name: np.zeros(shape) for name in ("s", "l", "heading", "v")}
    tables["present"] = np.zeros(shape, bool)
    sizes = {"kind": np.zeros(NUM_AGENTS, np.int32)}
    sizes |= {name: np.ones(NUM_AGENTS) for name in ("length", "width")}
    kind, valid = np.asarray(o.kind), np.asarray(o.valid)
    is_body = (kind != Kind.NONE) & (kind < Kind.STOP) & valid.any(axis=1)
    for agent, slot in enumerate(np.flatnonzero(is_body)[:NUM_AGENTS]):
        known = valid[slot]
        first, last = np.flatnonzero(known)[[0, -1]]
        middle_s, middle_l = (
            0.5 * (np.asarray(low)[slot] + np.asarray(high)[slot])
            for low, high in ((o.s_lower, o.s_upper), (o.l_lower, o.l_upper))
        )
        curve = _hermite(middle_s, np.asarray(o.speed)[slot], known)
        time = np.clip(CLOCK_S, TIMES_S[first], TIMES_S[last])
        s = curve(time)
        l = np.interp(time, TIMES_S[known], middle_l[known])
        s_dot, l_dot = curve(time, 1), np.gradient(l, STEP_S)
        speed = np.hypot(s_dot, l_dot)
        # who stands keeps the direction that it had
        angle = np.where(speed > MOVING_MPS, np.arctan2(l_dot, s_dot), np.nan)
        towards = np.asarray(o.speed)[slot, known].min() < -MOVING_MPS
        angle = _filled(angle, np.pi if towards else 0.0)
        tables["s"][agent], tables["l"][agent] = s, l
        tables["v"][agent], tables["heading"][agent] = speed, angle
        tables["present"][agent] = np.isclose(CLOCK_S, time, atol=1e-6)
        sizes["kind"][agent] = kind[slot]
        sizes["length"][agent], sizes["width"][agent] = _size(one, slot, time, angle)
    return tables | sizes


def _size(
    one: Demonstration, slot: int, time: np.ndarray, angle: np.ndarray
) -> tuple[float, float]:
    """Length and width, m, of the body in a slot.

    Stored extents along the axes contain a tilted box. They are its sides where the
    body is aligned with an axis, and there their product is smallest.

    Args:
      one: the Demonstration.
      slot: of the obstacles.
      time: [S] s, moments of the angle.
      angle: [S] rad, of the body's motion to the road.
    """
    o = one.scene.obstacles
    extents = [
        np.asarray(high)[slot] - np.asarray(low)[slot]
        for low, high in ((o.s_lower, o.s_upper), (o.l_lower, o.l_upper))
    ]
    area = np.where(np.asarray(o.valid)[slot], extents[0] * extents[1], np.inf)
    best = int(np.argmin(area))
    # across the road the long side lies along l
    crosses = abs(np.sin(angle[np.argmin(np.abs(time - TIMES_S[best]))])) > 0.7
    length, width = (float(x[best]) for x in (extents[::-1] if crosses else extents))
    return length, width


def _filled(values: np.ndarray, default: float) -> np.ndarray:
    """NaNs replaced by the value before, those at the start by the first one known."""
    known = np.flatnonzero(~np.isnan(values))
    if known.size == 0:
        return np.full_like(values, default)
    place = np.searchsorted(known, np.arange(values.size), side="right") - 1
    return values[known[np.maximum(place, 0)]]


def _lines(one: Demonstration) -> Lines:
    """Lines that demanded a stop as lights: red for the time of the demand."""
    o = one.scene.obstacles
    rows: list[dict[str, Any]] = []
    valid = np.asarray(o.valid)
    stops = np.flatnonzero((np.asarray(o.kind) == Kind.STOP) & valid.any(axis=1))
    for slot in stops[:NUM_LINES]:
        first, last = np.flatnonzero(valid[slot])[[0, -1]]
        begins, ends = TIMES_S[first], TIMES_S[last] + DT_S
        if last == TIMES_S.size - 1:
            ends = LONG_S
        row = {"kind": LineKind.LIGHT, "s": np.asarray(o.s_lower)[slot, first]}
        row |= {"green": LONG_S, "yellow": 0.0, "red": ends - begins}
        rows.append({**row, "offset": LONG_S - begins})
    return lines_of(rows)


def _road(one: Demonstration) -> Road:
    """The stored station grid, held at its last values beyond; the road is straight."""
    path, single = one.scene.path, np.float32

    def prolonged(values: ArrayLike, beyond: float | None = None) -> np.ndarray:
        known = np.asarray(values, float)
        rest = np.full(NUM_ROAD - known.size, known[-1] if beyond is None else beyond)
        return np.concatenate([known, rest]).astype(single)

    assert STATION_STEP_M == ROAD_STEP_M
    left, right = float(path.lane_left[0]), float(path.lane_right[0])
    width = max(left - right, 2.0)
    driven = np.interp(one.human.s, _stations(), np.arange(NUM_STATIONS)).astype(int)
    reach = 0.5 * float(one.scene.ego.width) + EDGE_MARGIN_M
    human_l = np.asarray(one.human.l)
    edge_left = max(np.asarray(path.road_left)[driven].max(), human_l.max() + reach)
    edge_right = min(np.asarray(path.road_right)[driven].min(), human_l.min() - reach)
    # where the human was there is road, whatever the map says
    along = np.arange(NUM_ROAD) * ROAD_STEP_M
    beside = np.interp(along, one.human.s, human_l).astype(single)
    o = one.scene.obstacles
    ends = np.asarray(o.valid)[:, 0] & (np.asarray(o.kind) == Kind.VIRTUAL)
    destination = (NUM_ROAD - 1) * ROAD_STEP_M
    if ends.any():
        destination = float(np.asarray(o.s_lower)[ends, 0].min())
    return node(
        Road,
        kappa=prolonged(path.kappa, 0.0),
        speed_limit=prolonged(path.speed_limit),
        path_l=prolonged(path.l),
        lane_width=single(width),
        lanes_left=np.int32(max((edge_left - left + 0.5) // width, 0)),
        lanes_right=np.int32(max((right - edge_right + 0.5) // width, 0)),
        edge_left=single(edge_left),
        edge_right=single(edge_right),
        route_left=np.maximum(prolonged(path.road_left), beside + reach),
        route_right=np.minimum(prolonged(path.road_right), beside - reach),
        destination=single(destination),
    )
