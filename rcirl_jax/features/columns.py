"""One pure function per feature: (frame of one point) -> scalar.

`COLUMNS` maps the name used in data_specs/features/*.toml to the function that
computes it. To add a feature: write a function here, name it there. The
functions are elementwise, so a Frame whose leaves carry further axes gives a
column with these axes.
"""

from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.features.path import PathView, path_view
from rcirl_jax.features.relations import (
    LATERAL_CAP_M,
    LINE_CAP_M,
    OBSTACLE_CAP_M,
    Nearest,
    Relations,
    relate,
    slots,
)
from rcirl_jax.types import Scene, Trajectory
from rcirl_jax.units import TIMES_S

MIN_COLLISION_M = -10.0  # m, deepest penetration told apart
BEFORE_M = 1e6  # m, how far back the ego is taken to be before the first time

__all__ = ["COLUMNS", "LINE_CAP_M", "OBSTACLE_CAP_M", "Frame", "make_frame"]


class Frame(flax.struct.PyTreeNode, kw_only=True):
    """What the columns read at one point; all leaves scalars."""

    time: jax.Array  # s
    advance: jax.Array  # m, station since t = 0
    point: Trajectory  # leaves [] instead of [T]
    relations: Relations
    path: PathView
    kappa: jax.Array  # 1/m, curvature of the path driven


def make_frame(scene: Scene, trajectory: Trajectory) -> Frame:
    """The frames of one trajectory; every leaf is [T]."""
    view = path_view(scene, trajectory.s)
    points = jax.tree.map(lambda x: x[:, None], (trajectory, view))
    frame = _grid(scene, *points)
    return jax.tree.map(lambda x: x[:, 0], frame)


def candidate_frames(scene: Scene, trajectories: Trajectory) -> Frame:
    """The frames of K trajectories [K, T] of a scene; every leaf is [T, K].

    Candidates run along the last axis, so that XLA's loops are long and all
    lanes of the processor's vectors are filled.
    """
    view = jax.vmap(path_view, in_axes=(None, 0))(scene, trajectories.s)
    leaves, tree = jax.tree.flatten((trajectories, view))
    points = jnp.stack(leaves).swapaxes(1, 2)  # one copy instead of one a leaf
    return _grid(scene, *jax.tree.unflatten(tree, points))


def _grid(scene: Scene, trajectory: Trajectory, view: PathView) -> Frame:
    """Frames of a [T, K] grid of points; the one place that maps over points."""
    s = trajectory.s
    before = jnp.concatenate([jnp.full_like(s[:1], -BEFORE_M), s[:-1]])
    kappa = view.curvature(trajectory)

    def row(time: jax.Array, obstacles: tuple, s: jax.Array, *rest: jax.Array) -> tuple:
        one = jax.vmap(relate, in_axes=(None, 0, 0, 0, 0))
        return jnp.broadcast_to(time, s.shape), one(obstacles, s, *rest)

    everyone = slots(scene.ego, scene.obstacles)
    time, relations = jax.vmap(row)(
        jnp.asarray(TIMES_S), everyone, s, trajectory.l, trajectory.v, before
    )
    return Frame(
        time=time,
        advance=s - scene.ego.s,
        point=trajectory,
        relations=relations,
        path=view,
        kappa=kappa,
    )


def driven_curvature(scene: Scene, trajectory: Trajectory) -> jax.Array:
    """Curvature [T] 1/m of the path driven: reference line plus lateral motion."""
    return path_view(scene, trajectory.s).curvature(trajectory)


def _collision_distance(frame: Frame) -> jax.Array:
    overrun, signed = frame.relations.line_overrun, frame.relations.body
    signed = jnp.where(overrun > 0.0, jnp.minimum(signed, -overrun), signed)
    return jnp.clip(signed, MIN_COLLISION_M, OBSTACLE_CAP_M)


def _nearest(name: str, attribute: str) -> Callable[[Frame], jax.Array]:
    """Distance or relative speed of the nearest of a class."""

    def column(frame: Frame) -> jax.Array:
        nearest: Nearest = getattr(frame.relations, name)
        return getattr(nearest, attribute)

    return column


def _nudge_distance(frame: Frame) -> jax.Array:
    """Along the road: 0 while something is abreast, the cap otherwise."""
    abreast = frame.relations.nudge.distance < LATERAL_CAP_M
    return jnp.where(abreast, 0.0, LINE_CAP_M)


COLUMNS: dict[str, Callable[[Frame], jax.Array]] = {
    "l": lambda frame: frame.point.l,
    "dl": lambda frame: frame.point.dl,
    "ddl": lambda frame: frame.point.ddl,
    "curvature": lambda frame: frame.kappa,
    "station": lambda frame: frame.advance,
    "time": lambda frame: frame.time,
    "velocity": lambda frame: frame.point.v,
    "speed_limit": lambda frame: frame.path.speed_limit,
    "acceleration": lambda frame: frame.point.a,
    "jerk": lambda frame: frame.point.j,
    "lateral_acceleration": lambda frame: frame.point.v**2 * frame.kappa,
    "collision_distance": _collision_distance,
    "collision": lambda frame: (_collision_distance(frame) < 0.0).astype(jnp.float32),
    "follow_distance": _nearest("follow", "distance"),
    "follow_speed": _nearest("follow", "speed"),
    "overtake_distance": _nearest("overtake", "distance"),
    "overtake_speed": _nearest("overtake", "speed"),
    "stop_distance": _nearest("stop", "distance"),
    "stop_speed": _nearest("stop", "speed"),
    "virtual_distance": _nearest("virtual", "distance"),
    "virtual_speed": _nearest("virtual", "speed"),
    "nudge_distance": _nudge_distance,
    "nudge_lateral": _nearest("nudge", "distance"),
    "nudge_speed": _nearest("nudge", "speed"),
    "sidepass_front_distance": _nearest("sidepass_front", "distance"),
    "sidepass_front_speed": _nearest("sidepass_front", "speed"),
    "sidepass_rear_distance": _nearest("sidepass_rear", "distance"),
    "sidepass_rear_speed": _nearest("sidepass_rear", "speed"),
}

# features that candidates of a scene do not share at t = 0: they say how a candidate
# begins, not where (`FeatureMap.context` leaves them out)
OF_CANDIDATE_AT_START = frozenset({"acceleration", "jerk"})
