"""Types of the closed-loop simulator on one page: the case, the world, the log.

Axis legend beyond that of `rcirl_jax.types`: `A` = 14 agent slots, `R` points
of the road grid, `L` stop lines, `P` phases of a speed script, `M` lateral
moves, `S` steps of the run, `H` steps of perception history, `D` steps of
reaction delay.

A case is data only: two cases of one suite differ in arrays, never in code or
shapes, so thousands of them run in one compiled program. Everything lives in
the road's Frenet frame: station `s` along the reference line (the ego's lane
centre at the start of the road), lateral offset `l` to the left, heading
relative to the reference line (0 = with the ego, pi = oncoming).
"""

import enum
from typing import Any, TypeVar

import flax.struct
import jax
import numpy as np

STEP_S = 0.1  # s, the simulator's clock and the fastest planning rate
NUM_AGENTS = 14  # A
ROAD_STEP_M = 2.0  # m between points of the road grid
NUM_ROAD = 2304  # R: 4.6 km, 120 s at 36 m/s plus the planner's view
NUM_LINES = 6  # L
NUM_PHASES = 8  # P
NUM_MOVES = 2  # M
NUM_HISTORY = 4  # H: latencies of 0 to 0.3 s
NUM_DELAY = 9  # D: reaction delays of 0 to 0.8 s
NUM_REPLAY = 81  # moments of a recorded drive, 0 to 8 s

_T = TypeVar("_T")


def node(kind: type[_T], /, **leaves: Any) -> _T:  # noqa: ANN401
    """One of the types below with numpy leaves; the types say jax.Array."""
    return kind(**leaves)


class LineKind(enum.IntEnum):
    """The demands of a stop line. Stored in `Lines.kind`."""

    NONE = 0  # an empty slot
    LIGHT = 1  # a traffic light with a cycle
    STOP_SIGN = 2  # stand once, then go


class Road(flax.struct.PyTreeNode, kw_only=True):
    """The ego's road on a uniform station grid; point r lies at `r * ROAD_STEP_M`."""

    kappa: jax.Array  # [R] 1/m, curvature of the reference line, left positive
    speed_limit: jax.Array  # [R] m/s, posted limit
    path_l: jax.Array  # [R] m, lateral offset of the path given to the ego
    lane_width: jax.Array  # [] m; lane k has its centre at l = k * lane_width
    lanes_left: jax.Array  # [] int32, same-direction lanes left of lane 0
    lanes_right: jax.Array  # [] int32, same-direction lanes right of lane 0
    edge_left: jax.Array  # [] m, l of the drivable area's left edge
    edge_right: jax.Array  # [] m, l of its right edge (negative)
    # [R] m, edges of the lanes that the route leaves free; read where paths are planned
    route_left: jax.Array
    route_right: jax.Array
    destination: jax.Array  # [] m, station where the route ends


class Lines(flax.struct.PyTreeNode, kw_only=True):
    """Stop lines across the ego's road. Lights cycle green, yellow, red."""

    kind: jax.Array  # [L] int32, `LineKind`
    s: jax.Array  # [L] m
    offset: jax.Array  # [L] s, the cycle's phase at t = 0 (0: green starts)
    green: jax.Array  # [L] s
    yellow: jax.Array  # [L] s
    red: jax.Array  # [L] s


class Driver(flax.struct.PyTreeNode, kw_only=True):
    """The driver model of an agent: IDM along its heading, MOBIL across lanes."""

    desired: jax.Array  # [A] m/s, v0 of the IDM
    headway: jax.Array  # [A] s, T
    standstill: jax.Array  # [A] m, s0
    acceleration: jax.Array  # [A] m/s^2, a
    braking: jax.Array  # [A] m/s^2, comfortable b
    delay: jax.Array  # [A] s, reaction delay, at most (D - 1) * 0.1
    reacts: jax.Array  # [A] bool: brakes for what is in its way (else blind)
    obeys_lines: jax.Array  # [A] bool: stops at the lines of the ego's road
    changes_lane: jax.Array  # [A] bool: MOBIL is on
    politeness: jax.Array  # [A] 1, MOBIL p
    threshold: jax.Array  # [A] m/s^2, MOBIL gain below which it stays
    lapse_start: jax.Array  # [A] s after activation: begins not to react
    lapse_end: jax.Array  # [A] s after activation


class Script(flax.struct.PyTreeNode, kw_only=True):
    """The actions of an agent at given times after its activation.

    Phase p holds from `start[p]` until the next phase starts: the agent drives
    its speed towards `speed[p]` at `rate[p]`, whatever the IDM wants to do
    with free road; if it `reacts`, the IDM's acceleration stays the upper bound,
    so it still brakes for what is in its way. An unused phase has start = inf.
    A move leads the agent to another lateral offset.
    """

    start: jax.Array  # [A, P] s after activation, increasing; inf = unused
    speed: jax.Array  # [A, P] m/s, target
    rate: jax.Array  # [A, P] m/s^2 > 0, how fast it is approached
    move_start: jax.Array  # [A, M] s after activation; inf = unused
    move_l: jax.Array  # [A, M] m, target lateral offset
    move_speed: jax.Array  # [A, M] m/s, largest lateral speed of the move


class Agents(flax.struct.PyTreeNode, kw_only=True):
    """The other road users: kind and size, where they appear, how they act.

    An agent appears when the ego's station has reached `appear_s` and the
    clock `appear_t` (and, if it appears relative to the ego, its place is
    free). Its own clock starts, and with it its motion, when the ego's time
    to arrival at the agent's station has fallen to `arrival_s` (inf: at once).
    """

    kind: jax.Array  # [A] int32, `rcirl_jax.types.Kind`; NONE = empty slot
    length: jax.Array  # [A] m
    width: jax.Array  # [A] m
    appear_s: jax.Array  # [A] m, ego station; -inf = from the start
    appear_t: jax.Array  # [A] s
    relative: jax.Array  # [A] bool: `s` is measured from the ego's station
    s: jax.Array  # [A] m, station of the centre where it appears
    l: jax.Array  # [A] m, lateral offset where it appears
    heading: jax.Array  # [A] rad, relative to the reference line
    v: jax.Array  # [A] m/s along its heading at activation
    v_share: jax.Array  # [A] 1: v += v_share * (ego's speed when it appears)
    arrival_s: jax.Array  # [A] s, ego's time to arrival that activates it
    driver: Driver
    script: Script


class Perception(flax.struct.PyTreeNode, kw_only=True):
    """The errors of the planner's perception of the agents."""

    # [] m, noise of s, drawn for each step and agent; that of l has half the spread
    sigma_position: jax.Array
    sigma_speed: jax.Array  # [] 1, relative noise of the speed, of the draw of s
    latency: jax.Array  # [] s, age of what is seen, at most (H - 1) * 0.1
    dropout: jax.Array  # [] 1, probability that an agent is missed in a step


def perfect_perception() -> Perception:
    """Perception that shows the planner the truth, at once; numpy leaves."""
    zero = np.float32(0.0)
    return node(Perception, **dict.fromkeys(Perception.__dataclass_fields__, zero))


class Replay(flax.struct.PyTreeNode, kw_only=True):
    """Recorded motion of the agents and of the human ego on the step grid.

    In a case of the catalogue nobody is present in it (`nobody_recorded`).
    """

    s: jax.Array  # [A, S + 1] m, recorded station of the centre
    l: jax.Array  # [A, S + 1] m
    heading: jax.Array  # [A, S + 1] rad, relative to the reference line
    v: jax.Array  # [A, S + 1] m/s
    present: jax.Array  # [A, S + 1] bool
    ego_s: jax.Array  # [S + 1] m, the human's station
    ego_l: jax.Array  # [S + 1] m
    ego_v: jax.Array  # [S + 1] m/s
    # bool: agents leave the log for the IDM once the ego has departed from its
    # own log by more than 2 m, or a conflict is nearer than 3 s
    turns_reactive: jax.Array  # []


def nobody_recorded() -> Replay:
    """A replay without anybody in it: the others act by themselves; numpy leaves."""
    agents = np.zeros((NUM_AGENTS, NUM_REPLAY), np.float32)
    ego = np.zeros(NUM_REPLAY, np.float32)
    return node(
        Replay,
        **dict.fromkeys(("s", "l", "heading", "v"), agents),
        present=agents > 0.0,
        **dict.fromkeys(("ego_s", "ego_l", "ego_v"), ego),
        turns_reactive=np.bool_(True),
    )


class Case(flax.struct.PyTreeNode, kw_only=True):
    """One simulated drive."""

    seed: jax.Array  # [] uint32, of the perception noise and the sampler
    steps: jax.Array  # [] int32, steps that count (the rest is padding)
    ego_v: jax.Array  # [] m/s at t = 0; the ego starts at s = 0 on its path
    ego_length: jax.Array  # [] m
    ego_width: jax.Array  # [] m
    road: Road
    lines: Lines
    agents: Agents
    perception: Perception
    replay: Replay | None = None  # None: as `nobody_recorded`
    ego_a: jax.Array | None = None  # [] m/s^2 at t = 0; None: 0


class EgoState(flax.struct.PyTreeNode, kw_only=True):
    """The ego's centre in the road's Frenet frame, with its actuators."""

    s: jax.Array  # [] m
    l: jax.Array  # [] m
    heading: jax.Array  # [] rad, relative to the reference line
    v: jax.Array  # [] m/s >= 0
    a: jax.Array  # [] m/s^2, what the drive train delivers now
    curvature: jax.Array  # [] 1/m, what the steering delivers now


class AgentState(flax.struct.PyTreeNode, kw_only=True):
    """The state of all agents at one time."""

    s: jax.Array  # [A] m, centre
    l: jax.Array  # [A] m
    heading: jax.Array  # [A] rad, relative to the reference line
    v: jax.Array  # [A] m/s along the heading, >= 0
    a: jax.Array  # [A] m/s^2
    l_dot: jax.Array  # [A] m/s, lateral speed of lane keepers
    l_target: jax.Array  # [A] m, lateral offset steered to
    clock: jax.Array  # [A] s since activation; negative before it
    present: jax.Array  # [A] bool: has appeared and not left
    gone: jax.Array  # [A] bool: will not appear (again)
    queue: jax.Array  # [A, D] m/s^2, limits set by others, newest first


class Seen(flax.struct.PyTreeNode, kw_only=True):
    """The agents as they are perceived."""

    s: jax.Array  # [A] m
    l: jax.Array  # [A] m
    heading: jax.Array  # [A] rad
    v: jax.Array  # [A] m/s
    a: jax.Array  # [A] m/s^2
    present: jax.Array  # [A] bool


class World(flax.struct.PyTreeNode, kw_only=True):
    """The state that one step maps to the next."""

    step: jax.Array  # [] int32
    ego: EgoState
    agents: AgentState
    seen: jax.Array  # [H, 6, A] what perception remembers, newest first (`SEEN`)
    served: jax.Array  # [L] bool: the ego has stood at this stop sign
    halts: jax.Array  # [L] bool: this light's yellow or red has demanded a stop
    stopped: jax.Array  # [] bool: an at-fault collision has ended the drive
    reactive: jax.Array  # [] bool: replayed agents have left their logs


class Record(flax.struct.PyTreeNode, kw_only=True):
    """One step's log of one case; every leaf gains a leading [S]."""

    valid: jax.Array  # [] bool: inside the case's steps, before an ending crash
    s: jax.Array  # [] m
    l: jax.Array  # [] m
    heading: jax.Array  # [] rad
    v: jax.Array  # [] m/s
    a: jax.Array  # [] m/s^2, along the path
    curvature: jax.Array  # [] 1/m of the path driven
    speed_limit: jax.Array  # [] m/s, posted, at the ego's station
    path_l: jax.Array  # [] m, given path at the ego's station
    clearance: jax.Array  # [] m to the nearest agent; < 0 while overlapping
    ttc: jax.Array  # [] s to agents ahead at constant speeds and headings; inf if never
    headway: jax.Array  # [] s to the agent ahead in the own corridor; inf
    free_way: jax.Array  # [] m to that agent, or to a line that demands a stop; inf
    collision: jax.Array  # [] int32, number of agents hit in this step
    at_fault: jax.Array  # [] int32, of them by the ego's fault
    at_fault_vru: jax.Array  # [] int32, of them pedestrians or cyclists
    at_fault_object: jax.Array  # [] int32, of them static objects
    impact_speed: jax.Array  # [] m/s, largest relative speed of these hits
    red_light: jax.Array  # [] bool: front bumper crossed a line while red
    stop_sign: jax.Array  # [] bool: crossed a stop sign without standing
    off_road: jax.Array  # [] m, farthest corner outside the drivable area, >= 0
    induced_braking: jax.Array  # [] m/s^2 >= 0, hardest braking for the ego
    fallback: jax.Array  # [] bool, of the plan in force
    command: jax.Array  # [] m/s^2, of the plan in force


class Snapshot(flax.struct.PyTreeNode, kw_only=True):
    """The state that a picture needs beyond the Record; every leaf gains [S]."""

    agents: AgentState
    plan_s: jax.Array  # [T] m, absolute planned stations
    line_red: jax.Array  # [L] bool: the line demands a stop now
    plan_l: jax.Array | None = None  # [T] m, planned offsets; None: the given path's


# fields of `Driver` that are numbers, and the flags of an agent
DRIVER = (
    *("desired", "headway", "standstill", "acceleration", "braking", "delay"),
    *("politeness", "threshold", "lapse_start", "lapse_end"),
)
FLAGS = ("relative", "reacts", "obeys_lines", "changes_lane")
# what stands in empty slots, where that is not 0
EMPTY = {"length": 1.0, "width": 1.0, "appear_s": np.inf, "arrival_s": np.inf}
EMPTY |= {"headway": 1.4, "standstill": 2.0, "acceleration": 1.4, "braking": 2.0}
EMPTY |= {"desired": 10.0, "lapse_start": np.inf, "lapse_end": np.inf}


def lines_of(rows: list[dict[str, float]]) -> Lines:
    """Lights and stop signs, by the fields of `Lines`; empty slots have kind NONE."""

    def column(name: str) -> np.ndarray:
        out = np.zeros(NUM_LINES, np.int32 if name == "kind" else np.float32)
        out[: len(rows)] = [row[name] for row in rows]
        return out

    return node(Lines, **{name: column(name) for name in Lines.__dataclass_fields__})


def agents_of(rows: list[dict[str, Any]]) -> Agents:
    """Agents with their drivers and scripts; empty slots have kind NONE.

    Args:
      rows: by the fields of `Agents` and `Driver`; phases (start, speed, rate) and
        moves (start, l, speed) of `Script`.
    """

    def column(name: str, kind: type = np.float32) -> np.ndarray:
        out = np.full(NUM_AGENTS, EMPTY.get(name, 0), kind)
        out[: len(rows)] = [row[name] for row in rows]
        return out

    unused = np.array([np.inf, 0.0, 1.0], np.float32)
    phases = np.tile(unused, (NUM_AGENTS, NUM_PHASES, 1))
    moves = np.tile(unused, (NUM_AGENTS, NUM_MOVES, 1))
    for i, row in enumerate(rows):
        phases[i, : len(row["phases"])] = row["phases"] or phases[i, :0]
        moves[i, : len(row["moves"])] = row["moves"] or moves[i, :0]
    flags = {name: column(name, bool) for name in FLAGS}
    names = ("start", "speed", "rate", "move_start", "move_l", "move_speed")
    table = [*np.moveaxis(phases, 2, 0), *np.moveaxis(moves, 2, 0)]
    plain = ("length", "width", "appear_s", "appear_t", "s", "l", "heading", "v")
    return node(
        Agents,
        kind=column("kind", np.int32),
        relative=flags.pop("relative"),
        **{name: column(name) for name in (*plain, "v_share", "arrival_s")},
        driver=node(Driver, **flags, **{name: column(name) for name in DRIVER}),
        script=node(Script, **dict(zip(names, table, strict=True))),
    )
