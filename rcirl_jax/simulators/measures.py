"""What a drive elsewhere was like, by the measures of our own closed loop.

Speeds and accelerations are those that the simulator shows, so that its own drivers
are measured as ours are.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.export.own_planner.inputs import Body, Car
from rcirl_jax.geometry.boxes import Box, separation
from rcirl_jax.simulation.cases import Record
from rcirl_jax.simulation.metrics import CaseMetrics, MetricsConfig, case_metrics
from rcirl_jax.simulation.world.judge import STOPPED_EGO_MPS
from rcirl_jax.simulators.simulators import STEP_S, View

LENGTHS = 100  # steps: records are filled up to a multiple, so that few compile


@dataclasses.dataclass(frozen=True, kw_only=True)
class Contact:
    """The ego touches somebody."""

    at_fault: bool
    relative_speed: float  # m/s
    vulnerable: bool  # a pedestrian or a cyclist
    standing_object: bool


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sample:
    """One step of one drive: what was ahead before it, what it came to."""

    view: View  # before the step
    way: float  # m driven since the start, after the step
    speed: float  # m/s after the step
    passed_red: int  # stop lines passed against red in this step
    hit: Contact | None  # after the step
    gap: float  # m to the rear of the body ahead, before the step; inf
    gap_speed: float  # m/s, its speed along the road
    line: float  # m to a line ahead that demands a stop; inf
    fallback: bool  # no plan was admissible


@dataclasses.dataclass(frozen=True, kw_only=True)
class Drive:
    """One episode driven by somebody; arrays [S]."""

    episode: str
    way: np.ndarray  # m
    v: np.ndarray  # m/s
    a: np.ndarray  # m/s^2, of the speed shown
    curvature: np.ndarray  # 1/m
    speed_limit: np.ndarray  # m/s
    gap: np.ndarray  # m
    gap_speed: np.ndarray  # m/s
    line: np.ndarray  # m
    passed_red: np.ndarray  # int
    fallback: np.ndarray  # bool
    contact: Contact | None  # that ended it

    @classmethod
    def of(cls, episode: str, log: Sequence[Sample]) -> "Drive":
        """From the samples of an episode."""
        get = lambda name: np.array([getattr(x, name) for x in log])  # noqa: E731
        v = get("speed")
        begin = np.array([x.view.ego.speed for x in log])
        return cls(
            episode=episode,
            way=get("way"),
            v=v,
            a=(v - begin) / STEP_S,
            curvature=np.array([x.view.ego.curvature for x in log]),
            speed_limit=np.array([x.view.speed_limit for x in log]),
            gap=get("gap"),
            gap_speed=get("gap_speed"),
            line=get("line"),
            passed_red=get("passed_red"),
            fallback=get("fallback"),
            contact=log[-1].hit if log else None,
        )


def contact(view: View) -> Contact | None:
    """The body that the ego's box touches; the ego's fault where there are several.

    As in our simulator, after nuPlan: who stands is not at fault; who moves is, if what
    it hits reaches beyond its front bumper from no farther back than its rear axle, or
    stands. A body beside or behind it that drives into it is not its fault.
    """
    found = [_against(view.ego, body) for body in view.obstacles]
    return max(filter(None, found), key=lambda x: x.at_fault, default=None)


_separation = jax.jit(separation)


def _box(body: Body | Car) -> Box:
    return Box(
        x=jnp.float32(body.x),
        y=jnp.float32(body.y),
        heading=jnp.float32(body.heading),
        length=jnp.float32(body.length),
        width=jnp.float32(body.width),
    )


def _against(ego: Car, body: Body) -> Contact | None:
    dx, dy = body.x - ego.x, body.y - ego.y
    turn = body.heading - ego.heading
    cosine, sine = math.cos(ego.heading), math.sin(ego.heading)
    along, across = dx * cosine + dy * sine, dy * cosine - dx * sine
    turned = abs(math.cos(turn)), abs(math.sin(turn))
    reach = 0.5 * (body.length * turned[0] + body.width * turned[1])
    aside = 0.5 * (body.length * turned[1] + body.width * turned[0])
    # two of the axes that may separate them; the others are asked where these do not
    if abs(along) > 0.5 * ego.length + reach or abs(across) > 0.5 * ego.width + aside:
        return None
    here = dataclasses.replace(ego, x=0.0, y=0.0)
    if _separation(_box(here), _box(dataclasses.replace(body, x=dx, y=dy))) > 0.0:
        return None
    front = along >= -0.25 * ego.length and along + reach > 0.5 * ego.length
    stands = body.speed <= STOPPED_EGO_MPS
    vx = body.speed * math.cos(turn) - ego.speed
    return Contact(
        at_fault=ego.speed > STOPPED_EGO_MPS and (stands or front),
        relative_speed=math.hypot(vx, body.speed * math.sin(turn)),
        vulnerable=body.kind in ("pedestrian", "cyclist"),
        standing_object=body.kind == "static",
    )


def record_of(drive: Drive, size: int) -> Record:
    """The drive as a record [size] of our closed loop; what nobody measures is 0."""
    count = drive.v.size
    fill = lambda x, rest=0.0: np.pad(  # noqa: E731
        np.asarray(x, np.float32), (0, size - count), constant_values=rest
    )
    nothing, never = fill(np.zeros(count)), np.full(size, np.inf, np.float32)
    closing = np.maximum(drive.v - drive.gap_speed, 1e-3)
    at_end = np.arange(size) == count - 1
    hit = drive.contact
    fault = hit if hit is not None and hit.at_fault else None
    counted = lambda yes: (at_end & bool(yes)).astype(np.int32)  # noqa: E731
    is_true = lambda x: fill(x).astype(bool)  # noqa: E731
    leaves: dict[str, Any] = dict(
        valid=np.arange(size) < count,
        s=fill(drive.way),
        l=nothing,
        heading=nothing,
        v=fill(drive.v),
        a=fill(drive.a),
        curvature=fill(drive.curvature),
        speed_limit=fill(drive.speed_limit, 1.0),
        path_l=nothing,
        clearance=never,
        ttc=fill(np.maximum(drive.gap, 0.0) / closing, np.inf),
        ttc_counts=fill(np.ones(count)).astype(bool),
        headway=fill(
            np.where(drive.v > 0.5, drive.gap / np.maximum(drive.v, 0.5), np.inf),
            np.inf,
        ),
        free_way=fill(np.minimum(drive.gap, drive.line), np.inf),
        collision=counted(hit),
        at_fault=counted(fault),
        at_fault_vru=counted(fault and fault.vulnerable),
        at_fault_object=counted(fault and fault.standing_object),
        impact_speed=np.float32(at_end * (hit.relative_speed if hit else 0.0)),
        red_light=is_true(drive.passed_red),
        stop_sign=np.zeros(size, bool),
        off_road=nothing,
        induced_braking=nothing,
        fallback=is_true(drive.fallback),
        command=nothing,
    )
    return Record(**leaves)


@jax.jit
@jax.vmap
def _measured(record: Record) -> CaseMetrics:
    return case_metrics(record, MetricsConfig())


def measure(drives: Sequence[Drive]) -> CaseMetrics:
    """The closed loop's measures of drives, leaves [N, ...]; numpy."""
    longest = max(drive.v.size for drive in drives)
    size = -(-max(longest, 1) // LENGTHS) * LENGTHS
    records = [record_of(drive, size) for drive in drives]
    stacked = jax.tree.map(lambda *x: np.stack(x), *records)
    return jax.device_get(_measured(stacked))
