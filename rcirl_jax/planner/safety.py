"""The safety filter: which candidates a score may choose from.

It is the same for learned, hand-set and random scores. For each candidate:

1. swept boxes: between neighbouring times the ego's box and an obstacle's box
   slide linearly past each other in the Frenet frame; they must not touch;
2. stop lines and red lights that demand a stop are walls for the front bumper;
3. road edges bound the box's sides;
4. hard limits: the speed limit handed to the planner and lateral acceleration;
5. a distance from which braking still avoids the leader (RSS, Shalev-Shwartz
   et al. 2017), or at least a growing margin where another car took it away.

Emergency stops are always among the candidates. If no candidate is admissible, the one
with the latest contact is driven (`choose`).
"""

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.errors import InputError
from rcirl_jax.features.columns import path_view
from rcirl_jax.geometry.boxes import frenet_extent
from rcirl_jax.types import Candidates, Kind, Scene, Trajectory
from rcirl_jax.units import DT_S, TIMES_S

MOVING_MPS = 1.0  # m/s, above which a body's prediction is uncertain
CROSSING_MPS = 1.0  # m/s, sideways speed above which a body is no lead vehicle


TRACKS = ("full", "collision")


@dataclasses.dataclass(frozen=True, kw_only=True)
class SafetyConfig:
    """Margins and limits of the filter; hashable."""

    # "full": all five rules; "collision": only bodies and lines (1 and 2), so that
    # everything else is the reward's to decide
    track: str = "full"
    # m added along the road on each side of an obstacle
    margin_along: float = 0.6
    # m/s by which that margin grows with time for bodies that move: their
    # drivers do not keep the predicted speed
    margin_growth: float = 0.3
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

    def __post_init__(self) -> None:
        """Reject an unknown track."""
        if self.track not in TRACKS:
            raise InputError(f"track: {self.track}: expected one of {TRACKS}")


class Verdict(flax.struct.PyTreeNode, kw_only=True):
    """The findings of the filter; all [K]."""

    admissible: jax.Array  # bool
    contact_s: jax.Array  # s, first contact with a body; inf if none
    contact_v: jax.Array  # m/s, speed at that time
    rss_margin: jax.Array  # m, smallest distance beyond the RSS distance


def check(
    scene: Scene, candidates: Candidates, config: SafetyConfig = SafetyConfig()
) -> Verdict:
    """Judge all candidates [K] of one scene."""
    trajectory = candidates.trajectory
    body = first_contact(scene, jax.tree.map(jnp.transpose, trajectory), config)
    judge = jax.vmap(lambda x, ok, hit: _check_one(scene, x, ok, hit, config))
    return judge(trajectory, candidates.feasible, body)


def choose(
    verdict: Verdict, candidates: Candidates, scores: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Index of the best admissible candidate, and whether there was none.

    A candidate whose score is not a number is not admissible.

    Without an admissible one, the latest contact with a body wins; among equals
    the larger margin to the leader, then the lower speed at the contact, then the
    shorter distance, which is the harder braking.
    """
    admissible = verdict.admissible & ~jnp.isnan(scores)
    best = jnp.argmax(jnp.where(admissible, scores, -jnp.inf))
    nothing = ~jnp.any(admissible)
    late = jnp.minimum(verdict.contact_s, TIMES_S[-1] + 1.0)
    # who drives through the leader has none ahead: its margin means nothing
    free = jnp.isinf(verdict.contact_s)
    margin = jnp.where(free, jnp.clip(verdict.rss_margin, -400.0, 0.0), -400.0)
    way = candidates.trajectory.s[:, -1]
    urgency = 1e3 * late + margin - 0.1 * verdict.contact_v - 0.01 * way
    fallback = jnp.argmax(jnp.where(candidates.feasible, urgency, -jnp.inf))
    return jnp.where(nothing, fallback, best), nothing


def _check_one(
    scene: Scene,
    x: Trajectory,
    feasible: jax.Array,
    body: jax.Array,
    config: SafetyConfig,
) -> Verdict:
    line = _first_crossing(scene, x, config)
    margin, gains = _rss(scene, x, config)
    inside = _inside_limits(scene, x, config)
    moment = jnp.clip(jnp.round(body / DT_S), 0, x.v.shape[0] - 1).astype(jnp.int32)
    speed = jnp.where(jnp.isfinite(body), x.v[moment], 0.0)
    clear = jnp.isinf(body) & jnp.isinf(line)
    keeps = (margin >= 0.0) | gains
    if config.track == "collision":
        inside, keeps = jnp.ones((), bool), jnp.ones((), bool)
    return Verdict(
        admissible=feasible & clear & inside & keeps,
        contact_s=body,
        contact_v=speed,
        rss_margin=margin,
    )


def first_contact(scene: Scene, x: Trajectory, config: SafetyConfig) -> jax.Array:
    """Start [s] of the first interval with a contact, [K]; inf without one.

    Between two times the centres' distance runs on a straight segment with
    middle m and half extent h; the boxes, added up to half sides e, touch it
    if and only if no axis separates them (segment against box, exact):

        |m_s| <= e_s + |h_s|,   |m_l| <= e_l + |h_l|,
        |m_s h_l - m_l h_s| <= e_s |h_l| + e_l |h_s|

    Boxes that are tilted enter with their extents along the axes, which
    contain them. A body that overlaps the ego's corridor from behind does not count.
    Every leaf of `x` is [T, K] here: long loops.
    """
    obstacles, ego = scene.obstacles, scene.ego
    extent = jax.vmap(jax.vmap(frenet_extent, (None, None, 0)), (None, None, 0))
    half_s, half_l = extent(ego.length, ego.width, jnp.arctan(x.dl))
    wide_s = jnp.maximum(half_s[:-1], half_s[1:]) + config.margin_along
    wide_l = jnp.maximum(half_l[:-1], half_l[1:]) + config.margin_across
    starts = jnp.asarray(TIMES_S)[:-1, None]
    touched = jnp.zeros(wide_s.shape, bool)
    for n in range(obstacles.kind.shape[0]):
        o = jax.tree.map(lambda a, n=n: a[n], obstacles)
        size_s = 0.5 * (o.s_upper - o.s_lower)[:, None]
        size_l = 0.5 * (o.l_upper - o.l_lower)[:, None]
        ds = 0.5 * (o.s_upper + o.s_lower)[:, None] - x.s
        dl = 0.5 * (o.l_upper + o.l_lower)[:, None] - x.l
        m_s, h_s = 0.5 * (ds[1:] + ds[:-1]), 0.5 * (ds[1:] - ds[:-1])
        m_l, h_l = 0.5 * (dl[1:] + dl[:-1]), 0.5 * (dl[1:] - dl[:-1])
        moving = (jnp.abs(o.speed[0]) > MOVING_MPS) & (o.kind != Kind.STATIC)
        grown = jnp.where(moving, config.margin_growth * starts, 0.0)
        e_s = wide_s + grown + jnp.maximum(size_s[1:], size_s[:-1])
        e_l = wide_l + jnp.maximum(size_l[1:], size_l[:-1])
        h_s, h_l = jnp.abs(h_s), jnp.abs(h_l)
        cross = jnp.abs(m_s * (dl[1:] - dl[:-1]) - m_l * (ds[1:] - ds[:-1]))
        near = (jnp.abs(m_s) <= e_s + h_s) & (jnp.abs(m_l) <= e_l + h_l)
        near = near & (0.5 * cross <= e_s * h_l + e_l * h_s)
        behind = (ds[:1] < 0.0) & (jnp.abs(dl[:1]) < size_l[:1] + half_l[:1])
        is_body = (o.kind >= Kind.VEHICLE) & (o.kind <= Kind.STATIC)
        known = is_body & (o.valid[1:] & o.valid[:-1])[:, None]
        touched = touched | (near & known & ~behind)
    return jnp.min(jnp.where(touched, starts, jnp.inf), axis=0)


def _first_crossing(scene: Scene, x: Trajectory, config: SafetyConfig) -> jax.Array:
    """Time [s] at which the front bumper passes a demanding line; inf if never."""
    obstacles = scene.obstacles
    front = x.s + 0.5 * scene.ego.length
    before = front[0] <= obstacles.s_lower[:, :1]
    is_line = (obstacles.kind == Kind.STOP)[:, None] & obstacles.valid & before
    # nearer than twice the margin, half of the way that is left
    left = obstacles.s_lower[:, :1] - front[0]
    slack = jnp.minimum(config.line_margin, 0.5 * left)
    passed = is_line & (front > obstacles.s_lower - slack)
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
    # the lower limit of an interval's two ends holds for all of it
    before = jnp.concatenate([view.speed_limit[:1], view.speed_limit[:-1]])
    limit = jnp.minimum(view.speed_limit, before) + config.speed_slack
    allowed = jnp.maximum(limit, scene.ego.v - config.speed_recovery * times)
    slow = x.v <= allowed
    half = 0.5 * scene.ego.width
    outside = jnp.maximum(x.l + half - view.road_left, view.road_right - (x.l - half))
    on_road = (outside <= 0.0) | (outside <= outside[0] + 0.01)
    gentle = jnp.abs(x.v**2 * view.curvature(x)) <= config.max_lateral_acceleration
    return jnp.all((slow & on_road & gentle)[1:])
