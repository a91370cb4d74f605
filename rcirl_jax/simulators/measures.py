"""Numbers of a drive elsewhere, by the measures of the package's own closed loop.

Speeds and accelerations are those that the simulator shows, so that its own drivers
are measured as ours are. Nobody looks elsewhere at what is not logged: it is 0.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.export.own_planner.inputs import Body, Car
from rcirl_jax.geometry.boxes import Box, separation
from rcirl_jax.simulation.cases import Record
from rcirl_jax.simulation.metrics import CaseMetrics, MetricsConfig, case_metrics
from rcirl_jax.simulation.world import STOPPED_EGO_MPS
from rcirl_jax.simulators.simulators import STEP_S, View

LENGTHS = 100  # steps: records are filled up to a multiple, so that few compile
# [S] by leaf of `simulation.cases.Record`, and `changes_lane`
EpisodeLog = dict[str, np.ndarray]
# leaves after a drive's end and where nobody logs them; the others are 0
FAR = dict.fromkeys(("clearance", "ttc", "headway", "free_way"), math.inf)
REST = {"speed_limit": 1.0, **FAR}
COUNTS = ("collision", "at_fault", "at_fault_vru", "at_fault_object")  # int32
MARKS = ("valid", "red_light", "stop_sign", "fallback")  # bool


@dataclasses.dataclass(frozen=True, kw_only=True)
class Contact:
    """The ego touches somebody."""

    at_fault: bool
    relative_speed: float  # m/s
    body: Body


def contact(view: View) -> Contact | None:
    """Return the contact of the ego's box; the ego's fault where there are several.

    As in the package's own simulator, after nuPlan: who stands is not at fault; who
    moves is, if what it hits reaches beyond its front bumper from no farther back than
    its rear axle, or stands. A body beside or behind it that drives into it is not.
    """
    found = [_against(view.ego, body) for body in view.obstacles]
    return max(filter(None, found), key=lambda x: x.at_fault, default=None)


_separation = jax.jit(separation)


def _box(body: Body | Car, x: float, y: float) -> Box:
    leaves = dict(x=x, y=y, heading=body.heading, length=body.length, width=body.width)
    return Box(**{name: jnp.float32(value) for name, value in leaves.items()})


def _against(ego: Car, body: Body) -> Contact | None:
    """Return the contact of the ego with one body, if they touch."""
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
    if _separation(_box(ego, 0.0, 0.0), _box(body, dx, dy)) > 0.0:
        return None
    front = along >= -0.25 * ego.length and along + reach > 0.5 * ego.length
    stands = body.speed <= STOPPED_EGO_MPS
    vx = body.speed * math.cos(turn) - ego.speed
    return Contact(
        at_fault=ego.speed > STOPPED_EGO_MPS and (stands or front),
        relative_speed=math.hypot(vx, body.speed * math.sin(turn)),
        body=body,
    )


def sample(
    view: View, after: View, gap: float, gap_speed: float, line: float, fallback: bool
) -> dict[str, float]:
    """Return the record of one step, by key of `EpisodeLog`.

    Args:
      view: before the step.
      after: after it.
      gap: m to the rear of the body ahead before the step; inf without one.
      gap_speed: m/s, that body's speed along the road.
      line: m to a line ahead that demands a stop; inf without one.
      fallback: no plan was admissible.
    """
    v, hit = after.ego.speed, contact(after)
    fault = hit.body.kind if hit is not None and hit.at_fault else None
    return {
        "valid": True,
        "s": after.way,
        "v": v,
        "a": (v - view.ego.speed) / STEP_S,
        "curvature": view.ego.curvature,
        "speed_limit": view.speed_limit,
        "ttc": max(gap, 0.0) / max(v - gap_speed, 1e-3),
        "headway": gap / v if v > 0.5 else math.inf,
        "free_way": min(gap, line),
        "collision": hit is not None,
        "at_fault": fault is not None,
        "at_fault_vru": fault in ("pedestrian", "cyclist"),
        "at_fault_object": fault == "static",
        "impact_speed": hit.relative_speed if hit else 0.0,
        "red_light": after.passed_red > 0,
        "fallback": fallback,
        "changes_lane": after.aside != 0.0,
    }


def log_of(samples: Sequence[Mapping[str, float]]) -> EpisodeLog:
    """Stack the samples of an episode; one that never began has none."""
    if not samples:
        return {}
    return {name: np.array([x[name] for x in samples]) for name in samples[0]}


@jax.jit
@jax.vmap
def _measured(record: Record) -> CaseMetrics:
    return case_metrics(record, MetricsConfig())


def measure(logs: Sequence[EpisodeLog]) -> CaseMetrics:
    """Return the closed loop's measures of drives, leaves [N, ...]; numpy."""
    longest = max(len(log["v"]) for log in logs)
    size = -(-longest // LENGTHS) * LENGTHS
    records = []  # [size]
    for log in logs:
        leaves = {}
        for name in Record.__dataclass_fields__:
            kind = np.int32 if name in COUNTS else bool if name in MARKS else np.float32
            leaves[name] = np.full(size, REST.get(name, 0.0), kind)
            if name in log:
                leaves[name][: len(log[name])] = log[name]
        records.append(Record(**leaves))
    return jax.device_get(_measured(jax.tree.map(lambda *x: np.stack(x), *records)))
