"""Where each obstacle stands relative to one point of a trajectory.

Everything is geometry in the Frenet frame of the scene: the ego's box and the
obstacles' boxes are axis-aligned there (headings relative to the reference
line are small; the obstacle's own tilt is already in its extents). Source of
the classes: the paper's Table I and Apollo's per-point rule (stop test and
time axis corrected).

Two habits make this fast where it counts, on [T, K] grids of candidates:

* whatever depends on obstacle and time alone is folded into the obstacle
  first (`slots`): its box grows by the ego's half extents, so the ego becomes
  a point, and what cannot be met moves to infinity, so masks disappear;
* the loop over obstacles is unrolled, so XLA runs through one fused
  elementwise loop per result; reductions over an obstacle axis cost 3 times
  as much on a CPU.
"""

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.types import Ego, Kind, Obstacles

LATERAL_BUFFER_M = 0.2  # m added to the half widths; half of Apollo's 0.4 m
NUDGE_RANGE_M = 3.0  # m, lateral gap beyond which Apollo's path decider ignores
OBSTACLE_CAP_M = 100.0  # m, Apollo: follow, overtake, side-pass "none" distance
LINE_CAP_M = 60.0  # m, Apollo: stop, virtual and nudge "none" distance
LATERAL_CAP_M = 10.0  # m, Apollo: lateral "none" distance
FAR_M = 1e6  # m, "no such obstacle"


class Nearest(flax.struct.PyTreeNode, kw_only=True):
    """The nearest member of a class; (cap, 0) where none is nearer than the cap."""

    distance: jax.Array  # m, in [0, cap]
    speed: jax.Array  # m/s, obstacle minus ego


class Relations(flax.struct.PyTreeNode, kw_only=True):
    """One point against all obstacles; all scalars."""

    follow: Nearest  # in the way and ahead
    overtake: Nearest  # in the way and behind
    nudge: Nearest  # beside, abreast; distance is the lateral gap
    sidepass_front: Nearest  # beside, ahead
    sidepass_rear: Nearest  # beside, behind
    stop: Nearest  # a line ahead that demands a stop
    virtual: Nearest  # the destination ahead
    body: jax.Array  # m, signed distance to the closest body; < 0 penetration
    line_overrun: jax.Array  # m, how far a demanding line was just crossed


class Slot(flax.struct.PyTreeNode, kw_only=True):
    """One obstacle at one time, grown by the ego's half extents; scalars."""

    lower: jax.Array  # m, the ego's centre is behind it below; FAR_M: no body
    upper: jax.Array  # m, and past it above; -FAR_M: no body
    right: jax.Array  # m, the ego's side clears it on the right below
    left: jax.Array  # m, and on the left above
    speed: jax.Array  # m/s along the road
    wall: jax.Array  # m, the same for a line that demands a stop; FAR_M: none
    wall_before: jax.Array  # m, a time earlier; -FAR_M: did not demand one
    end: jax.Array  # m, the same for the destination; FAR_M: none


def slots(ego: Ego, obstacles: Obstacles) -> tuple[Slot, ...]:
    """The N obstacles as Slots with leaves [T]."""
    half_length, half_width = 0.5 * ego.length, 0.5 * ego.width
    kind = obstacles.kind[:, None]
    body = obstacles.valid & (kind >= Kind.VEHICLE) & (kind <= Kind.STATIC)
    line = obstacles.valid & (kind == Kind.STOP)
    end = obstacles.valid & (kind == Kind.VIRTUAL)
    lower = obstacles.s_lower - half_length
    demanded = jnp.where(line, lower, -FAR_M)
    before = jnp.concatenate(
        [jnp.where(line[:, :1], FAR_M, -FAR_M), demanded[:, :-1]], axis=1
    )
    leaves = (
        jnp.where(body, lower, FAR_M),
        jnp.where(body, obstacles.s_upper + half_length, -FAR_M),
        obstacles.l_lower - half_width,
        obstacles.l_upper + half_width,
        obstacles.speed,
        jnp.where(line, lower, FAR_M),
        before,
        jnp.where(end, lower, FAR_M),
    )
    names = ("lower", "upper", "right", "left", "speed", "wall", "wall_before", "end")
    return tuple(
        Slot(**{name: leaf[n] for name, leaf in zip(names, leaves, strict=True)})
        for n in range(obstacles.kind.shape[0])
    )


class _Running(flax.struct.PyTreeNode, kw_only=True):
    """The smallest key met so far and the speed that came with it."""

    key: jax.Array
    speed: jax.Array

    def meet(self, member: jax.Array, key: jax.Array, speed: jax.Array) -> "_Running":
        """Of two at the very same key the slower counts: order does not matter."""
        key = jnp.where(member, key, FAR_M)
        wins = (key < self.key) | ((key == self.key) & (speed < self.speed))
        return _Running(
            key=jnp.minimum(key, self.key), speed=jnp.where(wins, speed, self.speed)
        )

    def nearest(self, offset: jax.Array | float, v: jax.Array, cap: float) -> Nearest:
        distance = self.key - offset
        known = distance < cap
        return Nearest(
            distance=jnp.where(known, distance, cap),
            speed=jnp.where(known, self.speed - v, 0.0),
        )


def relate(
    ego_slots: tuple[Slot, ...],
    s: jax.Array,
    l: jax.Array,
    v: jax.Array,
    s_before: jax.Array,
) -> Relations:
    """Classify every obstacle against the ego at (s, l) with speed v.

        gap = max(s_lower - (s + L/2), (s - L/2) - s_upper)
        lateral_gap = max(l_lower - (l + W/2), (l - W/2) - l_upper)

    An obstacle with lateral_gap < buffer is in the way: ahead of the bumper it
    is followed, behind the tail it is overtaken, in between it collides. One
    beside the ego within the nudge range is nudged while abreast and
    side-passed while ahead or behind. A line counts as overrun at the time
    where the front bumper first lies beyond it while it demands a stop.

    The distance to a body is sqrt(max(gap, 0)^2 + max(lateral_gap, 0)^2) apart
    and the larger (shallower) of the two negative gaps inside.

    Args:
      ego_slots: N slots with scalar leaves, of `slots`.
      s: m, station of the ego's centre.
      l: m, its lateral offset.
      v: m/s, its speed.
      s_before: m, its station one time earlier; very negative at the first.
    """
    nothing = _Running(key=jnp.asarray(FAR_M), speed=jnp.zeros(()))
    follow = overtake = nudge = front = rear = stop = virtual = nothing
    signed, overrun = jnp.asarray(FAR_M**2), jnp.zeros(())
    for o in ego_slots:
        aside = jnp.maximum(o.right - l, l - o.left)
        gap = jnp.maximum(o.lower - s, s - o.upper)
        in_way = aside < LATERAL_BUFFER_M
        beside = ~in_way & (aside < NUDGE_RANGE_M)
        ahead, behind = s <= o.lower, (s >= o.upper) & (o.upper > -FAR_M)
        # ordering by an edge's station orders by the distance to it
        follow = follow.meet(in_way & ahead, o.lower, o.speed)
        overtake = overtake.meet(in_way & behind, -o.upper, o.speed)
        front = front.meet(beside & ahead, o.lower, o.speed)
        rear = rear.meet(beside & behind, -o.upper, o.speed)
        nudge = nudge.meet(beside & (gap < 0.0), aside, o.speed)
        stop = stop.meet(s <= o.wall, o.wall, o.speed)
        virtual = virtual.meet(s <= o.end, o.end, o.speed)
        square = jnp.maximum(gap, 0.0) ** 2 + jnp.maximum(aside, 0.0) ** 2
        depth = jnp.maximum(gap, aside)
        signed = jnp.minimum(signed, jnp.where(depth < 0.0, depth, square))
        crossed = (s > o.wall) & (s_before <= o.wall_before)
        overrun = jnp.where(crossed, jnp.maximum(overrun, s - o.wall), overrun)
    outside = jnp.sqrt(jnp.where(signed > 0.0, signed, 1.0))
    return Relations(
        follow=follow.nearest(s, v, OBSTACLE_CAP_M),
        overtake=overtake.nearest(-s, v, OBSTACLE_CAP_M),
        nudge=nudge.nearest(0.0, v, LATERAL_CAP_M),
        sidepass_front=front.nearest(s, v, OBSTACLE_CAP_M),
        sidepass_rear=rear.nearest(-s, v, OBSTACLE_CAP_M),
        stop=stop.nearest(s, v, LINE_CAP_M),
        virtual=virtual.nearest(s, v, LINE_CAP_M),
        body=jnp.where(signed > 0.0, outside, signed),
        line_overrun=overrun,
    )
