"""What a planner answers to a scene, and how it is followed until the next plan.

A plan is s(t), v(t), a(t) on the time axis. Until the next planning step the ego
follows it (`command`), and that step has the rest of it among its candidates
(`stations_from_now`), so that the trajectory that was valued is the one that is driven.
"""

import math

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.geometry.frenet import lookup
from rcirl_jax.geometry.polynomial import hermite
from rcirl_jax.types import Trajectory
from rcirl_jax.units import DT_S, NUM_TIMES, TIMES_S

COMMAND_STEP_S = 0.1  # s that one command stays in force
ACTUATOR_LAG_S = 0.2  # s, of the drive train; the command leads the plan by it
EASED_MPS2 = 0.3  # m/s^2, braking left at standstill in an ordinary stop
EASING_S = 0.5  # s, time constant of the last part of an ordinary stop
MIN_WAY_M = 0.01  # m, keeps v^2 / 2s finite at rest
# A command held for h moves the acceleration by 1 - exp(-h / lag) of the way, so a
# plan with jerk j is met after h when the command leads by j h / (1 - exp(-h / lag)).
LEAD_S = COMMAND_STEP_S / (1.0 - math.exp(-COMMAND_STEP_S / ACTUATOR_LAG_S))


class Plan(flax.struct.PyTreeNode, kw_only=True):
    """One plan in the frame of the scene that it was made for, and its evidence."""

    s: jax.Array  # [T] m, planned stations
    v: jax.Array  # [T] m/s
    a: jax.Array  # [T] m/s^2
    since: jax.Array  # [] s since it was made
    since_choice: jax.Array  # [] s since it was last chosen, made or confirmed
    lasts: jax.Array  # [] bool: may be gone on with at the next planning step
    urgent: jax.Array  # [] bool: brakes at once, without leading up to it
    fallback: jax.Array  # [] bool: no candidate was admissible
    admissible: jax.Array  # [] int32, candidates that passed the safety filter


def plan_of(
    chosen: Trajectory,
    *,
    lasts: jax.Array | bool = False,
    urgent: jax.Array | bool = False,
    fallback: jax.Array | bool = False,
    admissible: jax.Array | int = 0,
) -> Plan:
    """A fresh plan along a trajectory [T]."""
    return Plan(
        s=chosen.s,
        v=chosen.v,
        a=chosen.a,
        since=jnp.zeros(()),
        since_choice=jnp.zeros(()),
        lasts=jnp.asarray(lasts),
        urgent=jnp.asarray(urgent),
        fallback=jnp.asarray(fallback),
        admissible=jnp.asarray(admissible, jnp.int32),
    )


def no_plan() -> Plan:
    """The empty plan that is in force before the first one."""
    zero = jnp.zeros((NUM_TIMES,))
    nothing = Trajectory(**dict.fromkeys(Trajectory.__dataclass_fields__, zero))
    return plan_of(nothing)


def held(v: jax.Array, a: jax.Array) -> Plan:
    """A plan that holds an acceleration [] m/s^2 from a speed [] m/s until standing."""
    times = jnp.asarray(TIMES_S)
    until = jnp.where(a < 0.0, jnp.minimum(times, v / -jnp.minimum(a, -1e-6)), times)
    return Plan(
        s=v * until + 0.5 * a * until**2,
        v=v + a * until,
        a=jnp.full_like(times, a),
        since=jnp.zeros(()),
        since_choice=jnp.zeros(()),
        lasts=jnp.zeros((), bool),
        urgent=jnp.zeros((), bool),
        fallback=jnp.zeros((), bool),
        admissible=jnp.zeros((), jnp.int32),
    )


def command(plan: Plan, v: jax.Array) -> jax.Array:
    """Acceleration command [] m/s^2 that follows a plan now, `plan.since` on.

    The planned acceleration, linear between the times, led by the actuator's lag; an
    urgent plan asks for its braking at once. A plan that comes to rest within an
    interval shows only a part of its braking in second differences: there the braking
    is the one that stops within the planned distance, v^2 / 2s, eased off towards
    standstill unless it is urgent.

    Args:
      plan: the plan in force.
      v: [] m/s, the ego's speed now.
    """
    at = jnp.clip(plan.since / DT_S, 0.0, NUM_TIMES - 2.0)
    here = at.astype(jnp.int32)
    led = jnp.clip((plan.since + LEAD_S) / DT_S, 0.0, NUM_TIMES - 1.0)
    wanted = lookup(plan.a, led, 1.0)
    planned = jnp.stack([plan.s, plan.v, plan.a])
    (s, begin, _), (s_next, _, a_next) = jnp.moveaxis(
        planned[:, here + np.arange(2)], 1, 0
    )
    wanted = jnp.where(plan.urgent, a_next, wanted)
    way = s_next - s
    rests = way < 0.5 * begin * DT_S
    stopping = -(begin**2) / (2.0 * jnp.maximum(way, MIN_WAY_M))
    eased = jnp.maximum(stopping, -(EASED_MPS2 + v / EASING_S))
    stopping = jnp.where(plan.urgent, stopping, eased)
    return jnp.where(rests, jnp.minimum(wanted, stopping), wanted)


def later(plan: Plan, seconds: float) -> Plan:
    """The same plan after some time has passed."""
    return plan.replace(
        since=plan.since + seconds, since_choice=plan.since_choice + seconds
    )


def stations_from_now(plan: Plan) -> jax.Array:
    """Stations [T] m of the rest of a plan, from 0 now, on the time axis.

    Cubic Hermite interpolation between the planned times; after the plan's end its
    last speed is kept.
    """
    times = jnp.asarray(TIMES_S)
    t = plan.since + jnp.append(times, 0.0)
    place = jnp.clip(t / DT_S, 0.0, NUM_TIMES - 1.0)
    low = jnp.minimum(place.astype(jnp.int32), NUM_TIMES - 2)
    (s, s_next), (v, v_next) = jnp.moveaxis(
        jnp.stack([plan.s, plan.v])[:, low[:, None] + np.arange(2)], 2, 1
    )
    inside = hermite(place - low, s, s_next, (v, v_next), DT_S)
    stations = inside + jnp.maximum(t - TIMES_S[-1], 0.0) * plan.v[-1]
    return stations[:-1] - stations[-1]
