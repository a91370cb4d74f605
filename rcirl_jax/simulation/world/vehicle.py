"""The simulated ego: a kinematic bicycle with lagging actuators on a curved road.

    s'       = v cos(h) / (1 - kappa l)          kappa: of the reference line
    l'       = v sin(h)
    h'       = v c - kappa s'                    h: heading against the line
    v'       = a,          tau_a a' = a_cmd - a              tau_a = 0.2 s
                           tau_c c' = c_cmd - c              tau_c = 0.05 s

c = tan(steering angle) / wheelbase is the curvature that the steering delivers;
lagging c or the angle differs by less than 1 % below 10 degrees. The lags are
nuPlan's; they are integrated exactly for a held command, so their response does
not depend on the step.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp

from rcirl_jax.geometry.frenet import lookup, path_curvature
from rcirl_jax.simulation.cases import ROAD_STEP_M, STEP_S, EgoState, Road


@dataclasses.dataclass(frozen=True, kw_only=True)
class Vehicle:
    """Limits and lags of the ego, and the gains of its path tracking."""

    acceleration_lag: float = 0.2  # s, nuPlan
    steering_lag: float = 0.05  # s, nuPlan
    min_acceleration: float = -8.0  # m/s^2, full braking on dry road
    max_acceleration: float = 4.0  # m/s^2 (Apollo)
    max_curvature: float = 0.1979  # 1/m (Apollo)
    substeps: int = 2  # integration steps of one simulator step
    # path tracking: the lateral error decays over this length,
    # max(min_length, time * v)
    tracking_time: float = 0.9  # s
    tracking_min_length: float = 5.0  # m
    tracking_damping: float = 1.0  # 1, critically damped


UNROLLED = 4  # substeps that are written out instead of looped over


def _at(table: jax.Array, s: jax.Array) -> jax.Array:
    return lookup(table, s, ROAD_STEP_M)


def path_points(
    road: Road, s: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """The given path at stations [M].

    Returns:
      Offset l m, slope dl/ds, curvature 1/m of the path, and kappa 1/m of the
      reference line there; all [M].
    """
    step = 2.0 * ROAD_STEP_M
    around = jnp.stack([s - step, s, s + step])
    at = jax.vmap(jax.vmap(lookup, (None, 0, None)), (None, 0, None))
    behind, here, ahead = at(road.path_l, around, ROAD_STEP_M)
    kappas = at(road.kappa, around, ROAD_STEP_M)
    slope = (ahead - behind) / (2.0 * step)
    bend = (ahead - 2.0 * here + behind) / step**2
    dkappa = (kappas[2] - kappas[0]) / (2.0 * step)
    curvature = jax.vmap(path_curvature)(kappas[1], dkappa, here, slope, bend)
    return here, slope, curvature, kappas[1]


def steering(ego: EgoState, road: Road, vehicle: Vehicle) -> jax.Array:
    """Curvature command 1/m that leads the ego onto its path.

        c = c_path(s + v tau) - (l - l_path) / D^2 - 2 z (h - h_path) / D

    so that the lateral error e obeys e'' + 2 z e' / D + e / D^2 = 0 by station.
    """
    ahead = ego.s + ego.v * (vehicle.steering_lag + 0.5 * STEP_S)
    l, slopes, curvatures, kappas = path_points(road, jnp.stack([ahead, ego.s]))
    feedforward, l_path, slope = curvatures[0], l[1], slopes[1]
    reach = jnp.maximum(vehicle.tracking_time * ego.v, vehicle.tracking_min_length)
    shrink = jnp.maximum(1.0 - kappas[1] * ego.l, 0.1)
    off_heading = ego.heading - jnp.arctan(slope / shrink)
    command = (
        feedforward
        - (ego.l - l_path) / reach**2
        - 2.0 * vehicle.tracking_damping * off_heading / reach
    )
    return jnp.clip(command, -vehicle.max_curvature, vehicle.max_curvature)


def drive(
    ego: EgoState, road: Road, acceleration: jax.Array, vehicle: Vehicle
) -> EgoState:
    """The ego one simulator step (0.1 s) later, under an acceleration command."""
    command = jnp.clip(acceleration, vehicle.min_acceleration, vehicle.max_acceleration)
    h = STEP_S / vehicle.substeps
    take_a = 1.0 - math.exp(-h / vehicle.acceleration_lag)
    take_c = 1.0 - math.exp(-h / vehicle.steering_lag)
    target = steering(ego, road, vehicle)

    def substep(_: int, ego: EgoState) -> EgoState:
        a = ego.a + take_a * (command - ego.a)
        c = ego.curvature + take_c * (target - ego.curvature)
        v = jnp.maximum(ego.v + 0.5 * (ego.a + a) * h, 0.0)
        a = jnp.where(v > 0.0, a, jnp.maximum(a, 0.0))
        mean_v, mean_c = 0.5 * (ego.v + v), 0.5 * (ego.curvature + c)
        kappa = _at(road.kappa, ego.s)
        shrink = jnp.maximum(1.0 - kappa * ego.l, 0.1)
        rate = mean_v * jnp.cos(ego.heading) / shrink
        turn = (mean_v * mean_c - kappa * rate) * h
        middle = ego.heading + 0.5 * turn
        return EgoState(
            s=ego.s + mean_v * jnp.cos(middle) / shrink * h,
            l=ego.l + mean_v * jnp.sin(middle) * h,
            heading=ego.heading + turn,
            v=v,
            a=a,
            curvature=c,
        )

    unroll = vehicle.substeps <= UNROLLED
    return jax.lax.fori_loop(0, vehicle.substeps, substep, ego, unroll=unroll)
