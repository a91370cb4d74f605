"""The safety filter: what the learned score never gets to choose.

It works on every candidate of every row alike, learned, hand-set or random:

1. swept boxes: between neighbouring times the ego's box and an obstacle's box
   slide linearly past each other in the Frenet frame; they must not touch;
2. stop lines and red lights that demand a stop are walls for the front bumper;
3. road edges bound the box's sides;
4. hard limits: the speed limit handed to the planner and lateral acceleration;
5. a distance from which braking still avoids the leader (RSS, Shalev-Shwartz
   et al. 2017), or at least a growing margin where another car took it away.

The emergency stops stay available always: where nothing is admissible, the
candidate that meets something last, and then most slowly, is driven.
"""

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.features.path import path_view
from rcirl_jax.geometry.boxes import frenet_extent, overlap_times
from rcirl_jax.geometry.frenet import lookup
from rcirl_jax.types import Candidates, Kind, Scene, Trajectory
from rcirl_jax.units import DT_S, STATION_STEP_M, TIMES_S

CROSSING_MPS = 1.0  # m/s, sideways speed above which a body crosses and leads nobody


@dataclasses.dataclass(frozen=True, kw_only=True)
class SafetyConfig:
    """Margins and limits of the filter; hashable."""

    # m added along the road on each side of an obstacle
    margin_along: float = 0.6
    # m added across
    margin_across: float = 0.25
    # m of front bumper kept before a line that demands a stop
    line_margin: float = 0.2
    # m/s above the planner's speed limit
    speed_slack: float = 0.05
    # m/s^2, how fast an excess of speed must at least shrink
    speed_recovery: float = 0.8
    # m/s^2, |v^2 kappa| (Apollo's constraint checker)
    max_lateral_acceleration: float = 4.0
    # s, reaction: actuator lag and one planning period (RSS rho)
    reaction: float = 0.4
    # m/s^2, braking the ego can rely on
    ego_braking: float = 7.0
    # m/s^2, the hardest braking a leader may show
    leader_braking: float = 8.0
    # m kept at standstill behind a leader
    standstill: float = 1.0
    # index of the time at which the distance is judged (0.94 s)
    rss_index: int = 2
    # m by which a violated distance must have grown by then
    rss_recovery: float = 0.3


class Verdict(flax.struct.PyTreeNode, kw_only=True):
    """What the filter found; all [K]."""

    admissible: jax.Array  # bool
    contact_s: jax.Array  # s, first contact with a body or line; inf if none
    contact_v: jax.Array  # m/s, speed at that time
    rss_margin: jax.Array  # m, smallest distance beyond the RSS distance


def check(
    scene: Scene, candidates: Candidates, config: SafetyConfig = SafetyConfig()
) -> Verdict:
    """Judge all candidates [K] of one scene."""
    return jax.vmap(lambda x, ok: _check_one(scene, x, ok, config))(
        candidates.trajectory, candidates.feasible
    )


def choose(verdict: Verdict, scores: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Index of the best admissible candidate, and whether there was none.

    Without an admissible one, the latest contact wins; among equals the
    larger margin to the leader, then the lower speed at the contact.
    """
    best = jnp.argmax(jnp.where(verdict.admissible, scores, -jnp.inf))
    nothing = ~jnp.any(verdict.admissible)
    late = jnp.minimum(verdict.contact_s, TIMES_S[-1] + 1.0)
    fallback = jnp.argmax(
        1e3 * late + jnp.clip(verdict.rss_margin, -400.0, 0.0) - 0.1 * verdict.contact_v
    )
    return jnp.where(nothing, fallback, best), nothing


def _check_one(
    scene: Scene, x: Trajectory, feasible: jax.Array, config: SafetyConfig
) -> Verdict:
    body = _first_contact(scene, x, config)
    line = _first_crossing(scene, x, config)
    contact = jnp.minimum(body, line)
    margin, gains = _rss(scene, x, config)
    inside = _inside_limits(scene, x, config)
    moment = jnp.clip(jnp.round(contact / DT_S), 0, x.v.shape[0] - 1).astype(jnp.int32)
    speed = jnp.where(jnp.isfinite(contact), x.v[moment], 0.0)
    keeps = (margin >= 0.0) | gains
    return Verdict(
        admissible=feasible & jnp.isinf(contact) & inside & keeps,
        contact_s=contact,
        contact_v=speed,
        rss_margin=margin,
    )


def _first_contact(scene: Scene, x: Trajectory, config: SafetyConfig) -> jax.Array:
    """Time [s] of the first contact with a body; inf without one.

    On each axis the distance of the centres runs linearly between two times;
    the boxes touch while both axes overlap (`overlap_times`). Boxes that are
    tilted enter with their extents along the axes, which contain them.
    """
    obstacles, ego = scene.obstacles, scene.ego
    half_s, half_l = jax.vmap(frenet_extent, in_axes=(None, None, 0))(
        ego.length, ego.width, jnp.arctan(x.dl)
    )
    mid_s = 0.5 * (obstacles.s_lower + obstacles.s_upper)
    mid_l = 0.5 * (obstacles.l_lower + obstacles.l_upper)
    reach_s = 0.5 * (obstacles.s_upper - obstacles.s_lower) + half_s
    reach_l = 0.5 * (obstacles.l_upper - obstacles.l_lower) + half_l
    ds, dl = mid_s - x.s, mid_l - x.l
    wide = lambda r, margin: jnp.maximum(r[:, :-1], r[:, 1:]) + margin  # noqa: E731
    from_s, to_s = overlap_times(
        ds[:, :-1], ds[:, 1:] - ds[:, :-1], wide(reach_s, config.margin_along)
    )
    from_l, to_l = overlap_times(
        dl[:, :-1], dl[:, 1:] - dl[:, :-1], wide(reach_l, config.margin_across)
    )
    enter = jnp.maximum(jnp.maximum(from_s, from_l), 0.0)
    leave = jnp.minimum(jnp.minimum(to_s, to_l), 1.0)
    kind = obstacles.kind[:, None]
    body = (kind >= Kind.VEHICLE) & (kind <= Kind.STATIC)
    known = body & obstacles.valid[:, :-1] & obstacles.valid[:, 1:]
    # a body that runs into the ego from behind is not the plan's to avoid
    from_behind = (ds[:, :1] < 0.0) & (jnp.abs(dl[:, :1]) < reach_l[:, :1])
    touches = known & (enter <= leave) & ~from_behind
    # a contact that exists already may dissolve: only closing in counts
    when = jnp.asarray(TIMES_S)[None, :-1] + DT_S * enter
    return jnp.min(jnp.where(touches, when, jnp.inf))


def _first_crossing(scene: Scene, x: Trajectory, config: SafetyConfig) -> jax.Array:
    """Time [s] at which the front bumper passes a demanding line; inf if never."""
    obstacles = scene.obstacles
    front = x.s + 0.5 * scene.ego.length
    before = front[0] <= obstacles.s_lower[:, :1]
    is_line = (obstacles.kind == Kind.STOP)[:, None] & obstacles.valid & before
    slack = jnp.minimum(config.line_margin, obstacles.s_lower[:, :1] - front[0])
    passed = is_line & (front > obstacles.s_lower - slack + 1e-3)
    return jnp.min(jnp.where(passed, jnp.asarray(TIMES_S), jnp.inf))


def _rss(
    scene: Scene, x: Trajectory, config: SafetyConfig
) -> tuple[jax.Array, jax.Array]:
    """Margin [m] to the RSS distance soon, and whether it grows.

    d = v rho + v^2 / (2 b_ego) - v_lead^2 / (2 b_lead) + standstill
    """
    obstacles, ego = scene.obstacles, scene.ego

    def margin(i: int) -> jax.Array:
        gap = obstacles.s_lower[:, i] - x.s[i] - 0.5 * ego.length
        aside = jnp.maximum(
            obstacles.l_lower[:, i] - x.l[i], x.l[i] - obstacles.l_upper[:, i]
        )
        lead = jnp.maximum(obstacles.speed[:, i], 0.0)
        needed = (
            x.v[i] * config.reaction
            + x.v[i] ** 2 / (2.0 * config.ego_braking)
            - lead**2 / (2.0 * config.leader_braking)
        )
        needed = jnp.maximum(needed, 0.0) + config.standstill
        in_way = aside < 0.5 * ego.width + config.margin_across
        body = (obstacles.kind >= Kind.VEHICLE) & (obstacles.kind <= Kind.STATIC)
        ahead = obstacles.s_upper[:, i] > x.s[i]
        sideways = jnp.abs(obstacles.l_lower[:, 1] - obstacles.l_lower[:, 0]) / DT_S
        along = sideways < CROSSING_MPS
        leads = body & in_way & ahead & along & obstacles.valid[:, i]
        return jnp.where(leads, gap - needed, 1e3)

    now, soon = margin(0), margin(config.rss_index)
    worst = jnp.min(soon)
    grows = (soon >= 0.0) | (soon >= now + config.rss_recovery)
    return worst, jnp.all(grows)


def _inside_limits(scene: Scene, x: Trajectory, config: SafetyConfig) -> jax.Array:
    """Speed limit, lateral acceleration and road edges at all later times."""
    view = path_view(scene, x.s)
    times = jnp.asarray(TIMES_S)
    limit = view.speed_limit + config.speed_slack
    allowed = jnp.maximum(limit, scene.ego.v - config.speed_recovery * times)
    slow = x.v <= allowed
    at = jax.vmap(lookup, in_axes=(None, 0, None))
    half = 0.5 * scene.ego.width
    left = at(scene.path.road_left, x.s, STATION_STEP_M)
    right = at(scene.path.road_right, x.s, STATION_STEP_M)
    outside = jnp.maximum(x.l + half - left, right - (x.l - half))
    on_road = (outside <= 0.0) | (outside <= outside[0] + 0.01)
    gentle = jnp.abs(x.v**2 * view.curvature(x)) <= config.max_lateral_acceleration
    return jnp.all((slow & on_road & gentle)[1:])
