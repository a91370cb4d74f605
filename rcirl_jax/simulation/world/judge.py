"""What happened in a step: contacts, faults, times to collision, rules.

All geometry is done in the ego's own tangent frame: a body at (ds, dl) on a
road of local curvature kappa lies, for bodies near the ego, at

    x = (1/kappa - l_j) sin(kappa ds),   y = 1/kappa - (1/kappa - l_j) cos(kappa ds)

relative to the reference line's point at the ego, which is exact where the
curvature is constant.
"""

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.geometry.boxes import Box, contact_interval, separation
from rcirl_jax.geometry.frenet import lookup
from rcirl_jax.simulation.cases import ROAD_STEP_M, AgentState, Case, EgoState
from rcirl_jax.simulation.world.agents import CORRIDOR_MARGIN_M
from rcirl_jax.types import Kind

# nuPlan's constants (reference: its no-at-fault-collision metric)
STOPPED_EGO_MPS = 0.05  # m/s, an ego slower than this is not at fault
STOPPED_TRACK_MPS = 0.05  # m/s, hitting a standing track is the ego's fault
OFF_ROAD_M = 0.3  # m outside the drivable area that counts
TTC_STANDING_MPS = 0.005  # m/s, below it the ego has no time to collision
TTC_HORIZON_S = 3.0  # s, nuPlan's projection
NEAR_M = 25.0  # m along the road within which its curvature bends the picture


class Contacts(flax.struct.PyTreeNode, kw_only=True):
    """The ego against every agent; all [A]."""

    clearance: jax.Array  # m, separation; < 0 overlapping; inf if absent
    hit: jax.Array  # bool
    at_fault: jax.Array  # bool, of the hits
    ttc: jax.Array  # s, inf if never within nuPlan's horizon
    relative_speed: jax.Array  # m/s
    ahead: jax.Array  # bool, for nuPlan's TTC


def _local(case: Case, ego: EgoState, state: AgentState) -> tuple[jax.Array, jax.Array]:
    """Agents' centres [A] in the tangent frame at the ego's station."""
    kappa = lookup(case.road.kappa, ego.s, ROAD_STEP_M)
    ds = jnp.clip(state.s - ego.s, -200.0, 200.0)
    angle = kappa * jnp.clip(ds, -NEAR_M, NEAR_M)  # no wrapping round far away
    # sin(a)/kappa and (1 - cos(a))/kappa without dividing by a small kappa
    along = ds * jnp.sinc(angle / jnp.pi)
    bulge = 0.5 * ds * angle * jnp.sinc(0.5 * angle / jnp.pi) ** 2
    return along - state.l * jnp.sin(angle), bulge + state.l * jnp.cos(angle)


def contacts(case: Case, ego: EgoState, state: AgentState) -> Contacts:
    """Separation, fault and time to collision of the ego against all agents."""
    x, y = _local(case, ego, state)
    kappa = lookup(case.road.kappa, ego.s, ROAD_STEP_M)
    heading = state.heading + kappa * jnp.clip(state.s - ego.s, -NEAR_M, NEAR_M)
    own = Box(
        x=jnp.zeros(()),
        y=ego.l,
        heading=ego.heading,
        length=case.ego_length,
        width=case.ego_width,
    )
    others = Box(
        x=x,
        y=y,
        heading=heading,
        length=case.agents.length,
        width=case.agents.width,
    )
    vx = state.v * jnp.cos(heading) - ego.v * jnp.cos(ego.heading)
    vy = state.v * jnp.sin(heading) - ego.v * jnp.sin(ego.heading)
    apart = jax.vmap(separation, in_axes=(None, 0))(own, others)
    enter, leave = jax.vmap(contact_interval, in_axes=(None, 0, 0, 0))(
        own, others, vx, vy
    )
    meets = (enter <= leave) & (leave >= 0.0) & state.present
    ttc = jnp.where(meets, jnp.maximum(enter, 0.0), jnp.inf)
    ttc = jnp.where((ttc <= TTC_HORIZON_S) & (ego.v > TTC_STANDING_MPS), ttc, jnp.inf)
    # the agent's place in the ego's own axes
    dx, dy = x, y - ego.l
    along = dx * jnp.cos(ego.heading) + dy * jnp.sin(ego.heading)
    half = 0.5 * case.ego_length
    clearance = jnp.where(state.present, apart, jnp.inf)
    hit = state.present & (apart <= 0.0)
    behind = along < -0.5 * half  # behind the rear axle
    reach = 0.5 * (
        case.agents.length * jnp.abs(jnp.cos(heading - ego.heading))
        + case.agents.width * jnp.abs(jnp.sin(heading - ego.heading))
    )
    front = along + reach > half  # reaches beyond the front bumper line
    standing_track = state.v <= STOPPED_TRACK_MPS
    lateral_fault = _straddles(case, ego)
    at_fault = standing_track | (~behind & (front | lateral_fault))
    at_fault = at_fault & (ego.v > STOPPED_EGO_MPS)
    return Contacts(
        clearance=clearance,
        hit=hit,
        at_fault=hit & at_fault,
        ttc=ttc,
        relative_speed=jnp.sqrt(vx**2 + vy**2),
        ahead=(along > 0.0) | (lateral_fault & ~behind),
    )


def _straddles(case: Case, ego: EgoState) -> jax.Array:
    """Whether the ego covers more than one lane or leaves the drivable area."""
    width = case.road.lane_width
    centre = width * jnp.round(ego.l / width)
    reach = 0.5 * (
        case.ego_width * jnp.abs(jnp.cos(ego.heading))
        + case.ego_length * jnp.abs(jnp.sin(ego.heading))
    )
    return jnp.abs(ego.l - centre) + reach > 0.5 * width + 0.05


def off_road(case: Case, ego: EgoState) -> jax.Array:
    """How far [m] the farthest corner lies outside the drivable area; >= 0."""
    reach = 0.5 * (
        case.ego_width * jnp.abs(jnp.cos(ego.heading))
        + case.ego_length * jnp.abs(jnp.sin(ego.heading))
    )
    left = ego.l + reach - case.road.edge_left
    right = case.road.edge_right - (ego.l - reach)
    return jnp.maximum(jnp.maximum(left, right), 0.0)


def headway(case: Case, ego: EgoState, state: AgentState) -> jax.Array:
    """Time [s] to the rear of the nearest agent ahead in the own corridor."""
    nearest = gap_ahead(case, ego, state)
    return jnp.where(ego.v > 0.5, nearest / jnp.maximum(ego.v, 0.5), jnp.inf)


def gap_ahead(case: Case, ego: EgoState, state: AgentState) -> jax.Array:
    """Distance [m] to the rear of the nearest agent ahead in the own corridor; inf."""
    half_s = 0.5 * (
        case.agents.length * jnp.abs(jnp.cos(state.heading))
        + case.agents.width * jnp.abs(jnp.sin(state.heading))
    )
    half_l = 0.5 * (
        case.agents.length * jnp.abs(jnp.sin(state.heading))
        + case.agents.width * jnp.abs(jnp.cos(state.heading))
    )
    gap = state.s - half_s - ego.s - 0.5 * case.ego_length
    aside = jnp.abs(state.l - ego.l) - half_l - 0.5 * case.ego_width
    in_way = state.present & (gap > 0.0) & (aside < CORRIDOR_MARGIN_M)
    return jnp.min(jnp.where(in_way, gap, jnp.inf))


def is_vru(case: Case) -> jax.Array:
    """[A] bool: pedestrians and cyclists."""
    kind = case.agents.kind
    return (kind == Kind.PEDESTRIAN) | (kind == Kind.CYCLIST)
