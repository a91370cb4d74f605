"""Stop lines: what the light shows, and who has to stop."""

from typing import Any

import jax
import jax.numpy as jnp

from rcirl_jax.simulation.cases import (
    STEP_S,
    Case,
    EgoState,
    LineKind,
    Lines,
    World,
)

# m/s^2: at yellow one stops if this braking suffices (dilemma-zone practice)
YELLOW_BRAKING_MPS2 = 3.0
STOP_WINDOW_M = 5.0  # m before a stop sign within which standing counts (nuPlan)
STOP_SPEED_MPS = 0.1  # m/s, standing (nuPlan)


def colours(lines: Lines, time: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(yellow, red) [L] bool of all lines at a time [s]."""
    is_light = lines.kind == LineKind.LIGHT
    cycle = jnp.maximum(lines.green + lines.yellow + lines.red, 1e-3)
    phase = jnp.mod(time + lines.offset, cycle)
    yellow = is_light & (phase >= lines.green) & (phase < lines.green + lines.yellow)
    red = is_light & (phase >= lines.green + lines.yellow)
    return yellow, red


def can_stop(v: Any, distance: Any) -> Any:  # noqa: ANN401
    """Whether 3 m/s^2 stop a driver at speed v m/s within distance m, elementwise.

    Arguments are numbers or arrays, of numpy or JAX.
    """
    return v**2 <= 2.0 * YELLOW_BRAKING_MPS2 * distance


def demands(
    lines: Lines, time: jax.Array, distance: jax.Array, v: jax.Array
) -> jax.Array:
    """Whether lights demand a stop of a driver: bool, shape of `distance`.

    Red always does; yellow where the driver can still stop with 3 m/s^2.

    Args:
      lines: [L].
      time: [] s.
      distance: [..., L] m from the driver's front to the lines.
      v: [..., 1] m/s, the driver's speed.
    """
    yellow, red = colours(lines, time)
    return red | (yellow & can_stop(v, jnp.maximum(distance, 0.0)))


def halting(
    lines: Lines, halts: jax.Array, time: jax.Array, distance: jax.Array, v: jax.Array
) -> jax.Array:
    """Lights [L] that have demanded a stop of the ego and are not green again.

    Who could stop when the light turned yellow has to: without this a driver who
    brakes late by a little is let go on, and meets red at the line.
    """
    yellow, red = colours(lines, time)
    return (yellow | red) & (halts | demands(lines, time, distance, v))


def serve(
    lines: Lines, served: jax.Array, distance: jax.Array, v: jax.Array
) -> jax.Array:
    """Stop signs at which the ego has stood: within 5 m before it, below 0.1 m/s."""
    stands = (v < STOP_SPEED_MPS) & (distance >= 0.0) & (distance <= STOP_WINDOW_M)
    return served | (stands & (lines.kind == LineKind.STOP_SIGN))


def stop_line(case: Case, world: World, ego: EgoState) -> jax.Array:
    """Station [] m of the nearest line that demands a stop of the ego now; inf.

    Args:
      case: the drive, with its lines.
      world: its clock, the stop signs at which the ego has stood, the lights that it
        stops for.
      ego: whose front is at or before the line.
    """
    lines = case.lines
    distance = lines.s - (ego.s + 0.5 * case.ego_length)
    time = world.step * STEP_S
    light = halting(lines, world.halts, time, distance, ego.v[None])
    sign = (lines.kind == LineKind.STOP_SIGN) & ~world.served
    return jnp.min(jnp.where((light | sign) & (distance >= 0.0), lines.s, jnp.inf))
