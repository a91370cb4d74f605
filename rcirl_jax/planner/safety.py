"""The safety filter: which candidates a score may choose from.

It is the same for learned, hand-set and random scores. For each candidate:

1. swept boxes: between neighbouring times the ego's box and an obstacle's box
   slide linearly past each other in the Frenet frame; they must not touch;
2. stop lines and red lights that demand a stop are walls for the front bumper;
3. hard limits: the speed limit handed to the planner, the road's edges for the
   box's sides, and lateral acceleration;
4. a distance from which braking still avoids the leader (RSS, Shalev-Shwartz
   et al. 2017), or at least a growing margin where another car took it away;
5. where paths are planned, the same distance to whom the ego moves in behind, and one
   from which whoever it moves in ahead of can brake gently, as a human would: what is
   predicted of it afterwards, as if it had not seen the ego, touches nothing; before
   what never moves, room to get round it.

`check` tells which candidates keep all rules, `explain` which rule each breaks first.
Numbers of an obstacle at times when it is not there are never read.

The sampler's emergency stops are always among its candidates. If no candidate is
admissible, the one with the latest contact is driven (`choose`).

The file runs on numpy and on JAX, as `features/columns.py` does: a planner may copy it,
with the files that `export/own_planner/features.py` names.
"""

import dataclasses
import enum
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

try:
    from rcirl_jax.errors import InputError
    from rcirl_jax.features.columns import namespace, path_view
    from rcirl_jax.units import DT_S, TIMES_S, Kind
except ImportError:  # the files were copied
    from columns import namespace, path_view  # pyright: ignore[reportMissingImports]
    from units import DT_S, TIMES_S, Kind  # pyright: ignore[reportMissingImports]

    InputError = ValueError

Array = Any  # of numpy, or of JAX
# of rcirl_jax.types, or plain ones with the same fields
Scene = Any
Candidates = Any
Trajectory = Any

MOVING_MPS = 1.0  # m/s, above which a body's prediction is uncertain
CROSSING_MPS = 1.0  # m/s, sideways speed above which a body is no lead vehicle
FREE_M = 1e3  # m, the margin to a leader where there is none
NEARER_M = 0.2  # m by which one comes nearer in earnest


TRACKS = ("full", "collision")


@dataclasses.dataclass(frozen=True, kw_only=True)
class SafetyConfig:
    """Margins and limits of the filter; hashable."""

    # "full": all rules; "collision": only bodies and lines (1 and 2), so that
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
    # whether bodies that the ego itself moves in ahead of or behind keep a gap (rule 5)
    entry: bool = False
    # s and m/s^2, reaction and braking of who is behind then
    rear_reaction: float = 0.6
    rear_braking: float = 3.0
    # m kept before what never moves, to get round it
    room: float = 8.0

    def __post_init__(self) -> None:
        """Reject an unknown track."""
        if self.track not in TRACKS:
            raise InputError(f"track: {self.track}: expected one of {TRACKS}")


class Verdict(NamedTuple):
    """The findings of the filter; all [K]."""

    admissible: Array  # bool
    contact_s: Array  # s, first contact with a body; inf if none
    contact_v: Array  # m/s, speed at that time
    rss_margin: Array  # m, smallest distance beyond the RSS distance


class Reason(enum.IntEnum):
    """The rules of the filter, in the order in which `explain` names them."""

    NONE = 0  # admissible
    NOT_FEASIBLE = 1  # so the planner said
    BODY = 2  # touches a body
    LINE = 3  # passes a line that demands a stop
    SPEED = 4  # over the speed limit
    ROAD = 5  # a side of the box leaves the road
    BEND = 6  # lateral acceleration
    DISTANCE = 7  # too near behind a leader
    ENTRY = 8  # moves in too near ahead of a body or behind one


class Explanation(NamedTuple):
    """The rule that each candidate breaks first; all [K]."""

    reason: Array  # int32, `Reason`
    obstacle: Array  # int32, the obstacle's place in the scene; -1: of none
    time_s: Array  # s, when; inf: at no one time


class Motion(NamedTuple):
    """The motion of candidates as the filter reads it; all [T, K]: loops are long."""

    s: Array  # m
    v: Array  # m/s
    l: Array  # m
    dl: Array  # 1
    ddl: Array  # 1/m


def motion_of(trajectory: Trajectory) -> Motion:
    """Return the leaves [K, T] of trajectories as the filter reads them, [T, K]."""
    return Motion(*(getattr(trajectory, name).T for name in Motion._fields))


def check(
    scene: Scene, candidates: Candidates, config: SafetyConfig = SafetyConfig()
) -> Verdict:
    """Judge all candidates of one scene.

    Args:
      scene: one planning frame; of N obstacles at least 1, which may be empty.
      candidates: K of them.
      config: margins and limits.

    Returns:
      A verdict with leaves [K].
    """
    x = motion_of(candidates.trajectory)
    xp = namespace(x.s, scene.path.l)
    body = first_contact(scene, x, config)
    line = xp.where(_crossings(scene, x, config), TIMES_S[:, None], xp.inf)
    margin, keeps = _rss(scene, x, config)
    speed = _speed_at(x, body)
    clear = xp.isinf(body) & xp.isinf(xp.min(line, axis=(0, 1)))
    admissible = candidates.feasible & clear
    if config.track != "collision":
        slow, on_road, gentle = _inside_limits(scene, x, config)
        inside = xp.all(slow & on_road & gentle, axis=0)
        admissible = admissible & inside & xp.all(keeps, axis=0)
        if config.entry:
            admissible = admissible & ~xp.any(_crowds(scene, x, config), axis=(0, 1))
    return Verdict(
        admissible=admissible,
        contact_s=body,
        contact_v=speed,
        rss_margin=xp.min(margin, axis=0),
    )


def _speed_at(x: Motion, time: Array) -> Array:
    """Speed [K] m/s at a time [K] s of each; 0 at none (inf)."""
    xp = namespace(x.v, time)
    moment = xp.clip(xp.round(time / DT_S), 0, x.v.shape[0] - 1).astype("int32")
    speed = xp.take_along_axis(x.v, moment[None], axis=0)[0]
    return xp.where(xp.isfinite(time), speed, 0.0)


def explain(
    scene: Scene, candidates: Candidates, config: SafetyConfig = SafetyConfig()
) -> Explanation:
    """Return the first rule that each candidate breaks.

    Rules come in the order of `Reason`, within a rule the earliest time, at one time
    the first obstacle. `Reason.NONE` is given where `check` says admissible.

    Args:
      scene: as in `check`.
      candidates: as in `check`.
      config: as in `check`.

    Returns:
      An explanation with leaves [K].
    """
    x = motion_of(candidates.trajectory)
    xp = namespace(x.s, scene.path.l)
    touched = xp.stack(list(_touches(scene, x, config)))  # [N, T - 1, K]
    passed = _crossings(scene, x, config)  # [N, T, K]
    rules = [
        _first_of(xp.where(touched, TIMES_S[:-1, None], xp.inf)),
        _first_of(xp.where(passed, TIMES_S[:, None], xp.inf)),
    ]
    if config.track != "collision":
        for fine in _inside_limits(scene, x, config):
            at = xp.where(fine, xp.inf, TIMES_S[1:, None])
            rules.append((xp.any(~fine, axis=0), None, xp.min(at, axis=0)))
        margin, keeps = _rss(scene, x, config)
        nearest = xp.argmin(xp.where(keeps, xp.inf, margin), axis=0)
        rules.append((xp.any(~keeps, axis=0), nearest, None))
        if config.entry:
            crowded = _crowds(scene, x, config)
            rules.append(_first_of(xp.where(crowded, TIMES_S[1:, None], xp.inf)))
    count = x.s.shape[1]
    reason = xp.zeros(count, "int32")
    obstacle, time = xp.full(count, -1, "int32"), xp.full(count, xp.inf, "float32")
    # the last rule first, so that the first one stays
    for number, (broken, which, at) in reversed([*enumerate(rules, Reason.BODY)]):
        reason = xp.where(broken, number, reason)
        obstacle = xp.where(broken, -1 if which is None else which, obstacle)
        time = xp.where(broken, xp.inf if at is None else at, time)
    wrong = ~candidates.feasible
    return Explanation(
        reason=xp.where(wrong, Reason.NOT_FEASIBLE, reason).astype("int32"),
        obstacle=xp.where(wrong, -1, obstacle).astype("int32"),
        time_s=xp.where(wrong, xp.inf, time).astype("float32"),
    )


def _first_of(times: Array) -> tuple[Array, Array, Array]:
    """From times [N, T, K], inf where a rule holds: broken, by which, and when, [K]."""
    xp = namespace(times)
    first = xp.min(times, axis=1)
    at = xp.min(first, axis=0)
    return xp.isfinite(at), xp.argmin(first, axis=0), at


def last_resort(
    scene: Scene, candidates: Candidates, verdict: Verdict, config: SafetyConfig
) -> Verdict:
    """Contacts without margins, and with lines too, for `choose` in need.

    Beside a body that has come too near, all candidates touch its margins at once, and
    nothing tells braking in the lane from steering into it.
    """
    x = motion_of(candidates.trajectory)
    xp = namespace(x.s, scene.path.l)
    bare = dataclasses.replace(
        config, margin_along=0.0, margin_growth=0.0, margin_across=0.05, entry=False
    )
    body = first_contact(scene, x, bare)
    crossed = xp.any(_crossings(scene, x, config), axis=0)
    line = xp.min(xp.where(crossed, TIMES_S[:, None], xp.inf), axis=0)
    meets = xp.minimum(body, line)
    # m/s; a metre aside counts as much as 5 m of way
    swerves = 0.5 * xp.abs(x.l[-1] - x.l[0])
    return verdict._replace(contact_s=meets, contact_v=_speed_at(x, meets) + swerves)


def choose(
    verdict: Verdict, candidates: Candidates, scores: Array
) -> tuple[Array, Array]:
    """Index of the best admissible candidate, and whether there was none.

    A candidate whose score is not a number is not admissible.

    Without an admissible one, the latest contact with a body wins; among equals
    the larger margin to the leader, then the lower speed at the contact, then the
    shorter distance, which is the harder braking.
    """
    xp = namespace(verdict.contact_s, scores)
    admissible = verdict.admissible & ~xp.isnan(scores)
    best = xp.argmax(xp.where(admissible, scores, -xp.inf))
    nothing = ~xp.any(admissible)
    late = xp.minimum(verdict.contact_s, TIMES_S[-1] + 1.0)
    # who drives through the leader has none ahead: its margin means nothing
    free = xp.isinf(verdict.contact_s)
    margin = xp.where(free, xp.clip(verdict.rss_margin, -400.0, 0.0), -400.0)
    way = candidates.trajectory.s[:, -1]
    urgency = 1e3 * late + margin - 0.1 * verdict.contact_v - 0.01 * way
    fallback = xp.argmax(xp.where(candidates.feasible, urgency, -xp.inf))
    return xp.where(nothing, fallback, best), nothing


def first_contact(scene: Scene, x: Motion, config: SafetyConfig) -> Array:
    """Start [s] of the first interval with a contact, [K]; inf without one."""
    xp = namespace(x.s, scene.obstacles.s_lower)
    touched = xp.zeros(x.s[:-1].shape, bool)
    for touched_one in _touches(scene, x, config):
        touched = touched | touched_one
    return xp.min(xp.where(touched, TIMES_S[:-1, None], xp.inf), axis=0)


def _touches(scene: Scene, x: Motion, config: SafetyConfig) -> Iterator[Array]:
    """For each obstacle, the intervals [T - 1, K] in which it is touched.

    Between two times the centres' distance runs on a straight segment with
    middle m and half extent h; the boxes, added up to half sides e, touch it
    if and only if no axis separates them (segment against box, exact):

        |m_s| <= e_s + |h_s|,   |m_l| <= e_l + |h_l|,
        |m_s h_l - m_l h_s| <= e_s |h_l| + e_l |h_s|

    Boxes that are tilted enter with their extents along the axes, which
    contain them. A body that overlaps the ego's corridor from behind does not count,
    nor does one that the ego has moved in ahead of, by rule 5.
    """
    obstacles, ego = scene.obstacles, scene.ego
    xp = namespace(x.s, obstacles.s_lower)
    # of a box tilted by arctan(dl)
    cosine = 1.0 / xp.sqrt(1.0 + x.dl**2)
    sine = xp.abs(x.dl) * cosine
    half_s = 0.5 * (ego.length * cosine + ego.width * sine)
    half_l = 0.5 * (ego.length * sine + ego.width * cosine)
    wide_s = xp.maximum(half_s[:-1], half_s[1:]) + config.margin_along
    wide_l = xp.maximum(half_l[:-1], half_l[1:]) + config.margin_across
    body = (obstacles.kind >= Kind.VEHICLE) & (obstacles.kind <= Kind.STATIC)
    known = (obstacles.valid[:, 1:] & obstacles.valid[:, :-1])[:, :, None]
    known = known & body[:, None, None]
    # what a body does when it is first there
    first = xp.argmax(obstacles.valid, axis=1)
    s_lower, s_upper, l_lower, l_upper, speed = (
        xp.take_along_axis(getattr(obstacles, name), first[:, None], axis=1)
        for name in ("s_lower", "s_upper", "l_lower", "l_upper", "speed")
    )
    aside = xp.abs(0.5 * (l_upper + l_lower) - x.l[first])
    in_way = aside < 0.5 * (l_upper - l_lower) + half_l[first]
    behind = (0.5 * (s_upper + s_lower) - x.s[first] < 0.0) & in_way  # [N, K]
    moves = (xp.abs(speed[:, 0]) > MOVING_MPS) & (obstacles.kind != Kind.STATIC)
    starts = TIMES_S[:-1, None]
    excused = behind[:, None]  # [N, 1 or T - 1, K]: bodies that have to brake
    if config.entry and config.track == "full":  # whom the ego has moved in ahead of
        is_in, enters, ahead = _entries(scene, x, config)
        drives = (obstacles.kind <= Kind.CYCLIST)[:, None]
        follows = drives & xp.any(enters & ~ahead[:, 1:], axis=1)
        follows = follows & ~xp.any(enters & ahead[:, 1:], axis=1)
        excused = excused | (is_in[:, :-1] & follows[:, None])
    for n in range(obstacles.kind.shape[0]):
        if xp is np and not known[n].any():  # XLA cannot see it, numpy can
            yield np.zeros(x.s[:-1].shape, bool)
            continue
        low_s, high_s = obstacles.s_lower[n][:, None], obstacles.s_upper[n][:, None]
        low_l, high_l = obstacles.l_lower[n][:, None], obstacles.l_upper[n][:, None]
        size_s, size_l = 0.5 * (high_s - low_s), 0.5 * (high_l - low_l)
        ds, dl = 0.5 * (high_s + low_s) - x.s, 0.5 * (high_l + low_l) - x.l
        m_s, h_s = 0.5 * (ds[1:] + ds[:-1]), 0.5 * (ds[1:] - ds[:-1])
        m_l, h_l = 0.5 * (dl[1:] + dl[:-1]), 0.5 * (dl[1:] - dl[:-1])
        grown = xp.where(moves[n], config.margin_growth * starts, 0.0)
        e_s = wide_s + grown + xp.maximum(size_s[1:], size_s[:-1])
        e_l = wide_l + xp.maximum(size_l[1:], size_l[:-1])
        h_s, h_l = xp.abs(h_s), xp.abs(h_l)
        cross = xp.abs(m_s * (dl[1:] - dl[:-1]) - m_l * (ds[1:] - ds[:-1]))
        near = (xp.abs(m_s) <= e_s + h_s) & (xp.abs(m_l) <= e_l + h_l)
        near = near & (0.5 * cross <= e_s * h_l + e_l * h_s)
        yield near & known[n] & ~excused[n]


def _crossings(scene: Scene, x: Motion, config: SafetyConfig) -> Array:
    """Finds [N, T, K] the front bumper past a line that demands a stop.

    A line that lies behind the front bumper now is none.
    """
    obstacles = scene.obstacles
    xp = namespace(x.s, obstacles.s_lower)
    front = x.s + 0.5 * scene.ego.length
    wall = obstacles.s_lower[:, :, None]
    left = wall - front[0]
    is_line = (obstacles.kind == Kind.STOP)[:, None, None]
    is_line = is_line & obstacles.valid[:, :, None] & (left >= 0.0)
    # nearer than twice the margin, half of the way that is left
    slack = xp.minimum(config.line_margin, 0.5 * left)
    return is_line & (front > wall - slack)


def _rss_distance(v: Array, lead: Array, config: SafetyConfig) -> Array:
    """Distance m to keep at speed v m/s behind a leader of some speed m/s.

    d = v rho + v^2 / (2 b_ego) - v_lead^2 / (2 b_lead) + standstill
    """
    xp = namespace(v, lead)
    lead = xp.maximum(lead, 0.0)
    needed = (
        v * config.reaction
        + v**2 / (2.0 * config.ego_braking)
        - lead**2 / (2.0 * config.leader_braking)
    )
    return xp.maximum(needed, 0.0) + config.standstill


def _entries(scene: Scene, x: Motion, config: SafetyConfig) -> tuple[Array, ...]:
    """The ego in corridors of bodies, where it did not have to be.

    The ego enters where its box comes beside or before one that it would be clear of at
    its offset of t = 0; whoever changes lane towards it is not its doing.

    Returns:
      Whether it is in [N, T, K], enters [N, T - 1, K], and has the body ahead
      [N, T, K].
    """
    o = scene.obstacles
    reach = 0.5 * scene.ego.width + config.margin_across
    body = (o.kind >= Kind.VEHICLE) & (o.kind <= Kind.STATIC)
    there = (o.valid & body[:, None])[..., None]
    near, clear = _beside(scene, x.l) < reach, _beside(scene, x.l[:1]) >= reach
    is_in = near & clear & there
    ahead = (0.5 * (o.s_lower + o.s_upper))[..., None] > x.s
    return is_in, is_in[:, 1:] & ~is_in[:, :-1], ahead


def _beside(scene: Scene, l: Array) -> Array:
    """Gap [N, T, K] m aside between obstacles and offsets l [T or 1, K]; < 0: none."""
    o = scene.obstacles
    xp = namespace(l, o.l_lower)
    return xp.maximum(o.l_lower[..., None] - l, l - o.l_upper[..., None])


def _crowds(scene: Scene, x: Motion, config: SafetyConfig) -> Array:
    """Finds [N, T - 1, K] the ego entering a body's corridor too near to it.

    Where it enters (`_entries`)

        ahead:   gap >= d of `_rss_distance`
        behind:  gap >= v_r rho_r + max(v_r^2 - v^2, 0) / (2 b_r) + standstill

    It also comes too near where it ends up nearer than `room` behind what never moves,
    and nearer than now.
    """
    o, half = scene.obstacles, 0.5 * scene.ego.length
    xp = namespace(x.s, o.s_lower)
    speed = o.speed[..., None]
    _, enters, ahead = _entries(scene, x, config)
    before = o.s_lower[..., None] - x.s - half
    after = x.s - half - o.s_upper[..., None]
    brakes = xp.maximum(speed**2 - x.v**2, 0.0) / (2.0 * config.rear_braking)
    behind = xp.maximum(speed, 0.0) * config.rear_reaction + brakes
    near = xp.where(
        ahead,
        before < _rss_distance(x.v, speed, config),
        after < xp.where(speed > 0.0, behind, 0.0) + config.standstill,
    )
    reach = 0.5 * scene.ego.width + config.margin_across
    stuck = ((o.kind == Kind.STATIC)[:, None] & o.valid & o.valid[:, :1])[..., None]
    stuck = stuck & (_beside(scene, x.l) < reach) & ahead & (before < config.room)
    stuck = stuck & (before < before[:, :1] - NEARER_M)
    last = xp.arange(1, x.s.shape[0])[:, None] == x.s.shape[0] - 1
    return (enters & near[:, 1:]) | (stuck[:, 1:] & last)


def _rss(scene: Scene, x: Motion, config: SafetyConfig) -> tuple[Array, Array]:
    """Margin [N, K] m to the RSS distance soon, and whether it is kept or grows."""
    obstacles, ego = scene.obstacles, scene.ego
    xp = namespace(x.s, obstacles.s_lower)
    body = (obstacles.kind >= Kind.VEHICLE) & (obstacles.kind <= Kind.STATIC)
    sideways = xp.abs(obstacles.l_lower[:, 1] - obstacles.l_lower[:, 0]) / DT_S
    seen = obstacles.valid[:, 1] & obstacles.valid[:, 0]
    along = (sideways < CROSSING_MPS) | ~seen

    def margin(i: int) -> Array:
        s_lower, s_upper, l_lower, l_upper, speed = (
            getattr(obstacles, name)[:, i, None]
            for name in ("s_lower", "s_upper", "l_lower", "l_upper", "speed")
        )
        gap = s_lower - x.s[i] - 0.5 * ego.length
        aside = xp.maximum(l_lower - x.l[i], x.l[i] - l_upper)
        needed = _rss_distance(x.v[i], speed, config)
        in_way = aside < 0.5 * ego.width + config.margin_across
        ahead = s_upper > x.s[i]
        leads = in_way & ahead & (body & along & obstacles.valid[:, i])[:, None]
        return xp.where(leads, gap - needed, FREE_M)

    now, soon = margin(0), margin(config.rss_index)
    return soon, (soon >= 0.0) | (soon >= now + config.rss_recovery)


def _inside_limits(
    scene: Scene, x: Motion, config: SafetyConfig
) -> tuple[Array, Array, Array]:
    """Tests speed, road edges and lateral acceleration later on, [T - 1, K] bool."""
    view = path_view(scene, x.s)
    xp = namespace(x.s, view.l)
    # the lower limit of an interval's two ends holds for all of it
    before = xp.concatenate([view.speed_limit[:1], view.speed_limit[:-1]])
    limit = xp.minimum(view.speed_limit, before) + config.speed_slack
    recovered = scene.ego.v - config.speed_recovery * TIMES_S[:, None]
    slow = x.v <= xp.maximum(limit, recovered)
    half = 0.5 * scene.ego.width
    outside = xp.maximum(x.l + half - view.road_left, view.road_right - (x.l - half))
    on_road = (outside <= 0.0) | (outside <= outside[0] + 0.01)
    gentle = xp.abs(x.v**2 * view.curvature(x)) <= config.max_lateral_acceleration
    return slow[1:], on_road[1:], gentle[1:]
