"""Where each obstacle stands relative to each point of a trajectory.

Everything is geometry in the Frenet frame of the scene: the ego's box and the
obstacles' boxes are axis-aligned there (headings relative to the reference
line are small; the obstacle's own tilt is already in its extents). Source of
the classes: the paper's Table I and Apollo's per-point rule (stop test and
time axis corrected).
"""

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.types import Kind, Scene, Trajectory

LATERAL_BUFFER_M = 0.2  # m added to the half widths; half of Apollo's 0.4 m
NUDGE_RANGE_M = 3.0  # m, lateral gap beyond which Apollo's path decider ignores
FAR_M = 1e6  # m, "no such obstacle"


class Relations(flax.struct.PyTreeNode, kw_only=True):
    """Signed gaps and classes of one trajectory against N obstacles."""

    gap: jax.Array  # [N, T] m, longitudinal; < 0 while abreast
    lateral_gap: jax.Array  # [N, T] m; < 0 while the widths overlap
    speed: jax.Array  # [N, T] m/s, obstacle minus ego
    follow: jax.Array  # [N, T] bool, in the way and ahead
    overtake: jax.Array  # [N, T] bool, in the way and behind
    nudge: jax.Array  # [N, T] bool, beside, abreast
    sidepass_front: jax.Array  # [N, T] bool, beside, ahead
    sidepass_rear: jax.Array  # [N, T] bool, beside, behind
    stop: jax.Array  # [N, T] bool, a line ahead that demands a stop
    virtual: jax.Array  # [N, T] bool, the destination ahead
    body: jax.Array  # [N, T] bool, something one can hit
    line_overrun: jax.Array  # [T] m, how far a demanding line was just crossed


def relate(scene: Scene, trajectory: Trajectory) -> Relations:
    """Classify every obstacle at every time.

        gap = max(s_lower - (s + L/2), (s - L/2) - s_upper)
        lateral_gap = max(l_lower - (l + W/2), (l - W/2) - l_upper)

    An obstacle with lateral_gap < buffer is in the way: ahead of the bumper it
    is followed, behind the tail it is overtaken, in between it collides. One
    beside the ego within the nudge range is nudged while abreast and
    side-passed while ahead or behind. A line counts as overrun at the time
    where the front bumper first lies beyond it while it demands a stop.
    """
    obstacles = scene.obstacles
    front = trajectory.s + 0.5 * scene.ego.length
    rear = trajectory.s - 0.5 * scene.ego.length
    front_gap = obstacles.s_lower - front
    rear_gap = rear - obstacles.s_upper
    half_width = 0.5 * scene.ego.width
    lateral_gap = jnp.maximum(
        obstacles.l_lower - (trajectory.l + half_width),
        (trajectory.l - half_width) - obstacles.l_upper,
    )
    kind = obstacles.kind[:, None]
    is_body = (kind >= Kind.VEHICLE) & (kind <= Kind.STATIC)
    body = obstacles.valid & is_body
    in_way = body & (lateral_gap < LATERAL_BUFFER_M)
    beside = body & ~in_way & (lateral_gap < NUDGE_RANGE_M)
    ahead, behind = front_gap >= 0.0, rear_gap >= 0.0
    is_line = obstacles.valid & (kind == Kind.STOP)
    beyond = jnp.where(is_line, -front_gap, 0.0)
    before = jnp.concatenate([is_line[:, :1], (is_line & ahead)[:, :-1]], axis=1)
    overrun = jnp.where(is_line & ~ahead & before, beyond, 0.0)
    return Relations(
        gap=jnp.maximum(front_gap, rear_gap),
        lateral_gap=lateral_gap,
        speed=obstacles.speed - trajectory.v,
        follow=in_way & ahead,
        overtake=in_way & behind,
        nudge=beside & ~ahead & ~behind,
        sidepass_front=beside & ahead,
        sidepass_rear=beside & behind,
        stop=is_line & ahead,
        virtual=obstacles.valid & (kind == Kind.VIRTUAL) & ahead,
        body=body,
        line_overrun=jnp.max(overrun, axis=0),
    )


def nearest(
    member: jax.Array, distance: jax.Array, attribute: jax.Array, none: float
) -> tuple[jax.Array, jax.Array]:
    """Distance of the nearest member of a class, and its attribute.

    Args:
      member: [N, T] bool, who belongs to the class.
      distance: [N, T] m, >= 0 for members.
      attribute: [N, T], read at the nearest member; 0 without one.
      none: m, the cap: returned without a member, and nothing beyond it counts.

    Returns:
      Distance [T] in [0, none] and attribute [T]. Exact ties are averaged, so
      that the order of the obstacles does not matter.
    """
    counted = jnp.where(member & (distance < none), distance, FAR_M)
    closest = jnp.min(counted, axis=0)
    is_closest = (counted == closest) & (counted < FAR_M)
    count = jnp.sum(is_closest, axis=0)
    total = jnp.sum(jnp.where(is_closest, attribute, 0.0), axis=0)
    found = jnp.clip(closest, 0.0, none)
    return found, total / jnp.maximum(count, 1)


def closest_body(relations: Relations) -> jax.Array:
    """Signed distance [T] m to the closest body; negative is penetration.

    Apart: sqrt(max(gap, 0)^2 + max(lateral_gap, 0)^2). Overlapping: the larger
    (shallower) of the two negative gaps. FAR_M without a body.
    """
    gap, lateral = relations.gap, relations.lateral_gap
    apart = (gap > 0.0) | (lateral > 0.0)
    square = jnp.maximum(gap, 0.0) ** 2 + jnp.maximum(lateral, 0.0) ** 2
    outside = jnp.sqrt(jnp.where(apart, square, 1.0))
    distance = jnp.where(apart, outside, jnp.maximum(gap, lateral))
    return jnp.min(jnp.where(relations.body, distance, FAR_M), axis=0)
