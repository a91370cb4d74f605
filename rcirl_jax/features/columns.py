"""One pure function per feature: (frame) -> [T].

`COLUMNS` maps the name used in data_specs/features/*.toml to the function that
computes it. To add a feature: write a function here, name it there.
"""

from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.features.path import path_view
from rcirl_jax.features.relations import Relations, closest_body, nearest, relate
from rcirl_jax.types import Scene, Trajectory
from rcirl_jax.units import TIMES_S

OBSTACLE_CAP_M = 100.0  # m, Apollo: follow, overtake, side-pass "none" distance
LINE_CAP_M = 60.0  # m, Apollo: stop, virtual and nudge "none" distance
LATERAL_CAP_M = 10.0  # m, Apollo: lateral "none" distance
MIN_COLLISION_M = -10.0  # m, deepest penetration told apart


class Frame(flax.struct.PyTreeNode, kw_only=True):
    """What the columns read: the inputs and what several of them share."""

    scene: Scene
    trajectory: Trajectory
    relations: Relations
    kappa: jax.Array  # [T] 1/m, curvature of the path driven


def make_frame(scene: Scene, trajectory: Trajectory) -> Frame:
    """Compute the shared quantities once for one trajectory."""
    return Frame(
        scene=scene,
        trajectory=trajectory,
        relations=relate(scene, trajectory),
        kappa=driven_curvature(scene, trajectory),
    )


def driven_curvature(scene: Scene, trajectory: Trajectory) -> jax.Array:
    """Curvature [T] 1/m of the path driven: reference line plus lateral motion."""
    return path_view(scene, trajectory.s).curvature(trajectory)


def _speed_limit(frame: Frame) -> jax.Array:
    return path_view(frame.scene, frame.trajectory.s).speed_limit


def _collision_distance(frame: Frame) -> jax.Array:
    overrun = frame.relations.line_overrun
    signed = closest_body(frame.relations)
    signed = jnp.where(overrun > 0.0, jnp.minimum(signed, -overrun), signed)
    return jnp.clip(signed, MIN_COLLISION_M, OBSTACLE_CAP_M)


def _collision(frame: Frame) -> jax.Array:
    return (_collision_distance(frame) < 0.0).astype(jnp.float32)


def _longitudinal(name: str, cap: float, index: int) -> Callable[[Frame], jax.Array]:
    """Distance (index 0) or relative speed (index 1) of the nearest of a class."""

    def column(frame: Frame) -> jax.Array:
        relations = frame.relations
        member = getattr(relations, name)
        distance = jnp.maximum(relations.gap, 0.0)
        return nearest(member, distance, relations.speed, cap)[index]

    return column


def _nudge(index: int) -> Callable[[Frame], jax.Array]:
    """Lateral gap (0) or relative speed (1) of the laterally nearest abreast."""

    def column(frame: Frame) -> jax.Array:
        relations = frame.relations
        distance = jnp.maximum(relations.lateral_gap, 0.0)
        return nearest(relations.nudge, distance, relations.speed, LATERAL_CAP_M)[index]

    return column


COLUMNS: dict[str, Callable[[Frame], jax.Array]] = {
    "l": lambda frame: frame.trajectory.l,
    "dl": lambda frame: frame.trajectory.dl,
    "ddl": lambda frame: frame.trajectory.ddl,
    "curvature": lambda frame: frame.kappa,
    "station": lambda frame: frame.trajectory.s - frame.scene.ego.s,
    "time": lambda frame: jnp.asarray(TIMES_S),
    "velocity": lambda frame: frame.trajectory.v,
    "speed_limit": _speed_limit,
    "acceleration": lambda frame: frame.trajectory.a,
    "jerk": lambda frame: frame.trajectory.j,
    "lateral_acceleration": lambda frame: frame.trajectory.v**2 * frame.kappa,
    "collision_distance": _collision_distance,
    "collision": _collision,
    "follow_distance": _longitudinal("follow", OBSTACLE_CAP_M, 0),
    "follow_speed": _longitudinal("follow", OBSTACLE_CAP_M, 1),
    "overtake_distance": _longitudinal("overtake", OBSTACLE_CAP_M, 0),
    "overtake_speed": _longitudinal("overtake", OBSTACLE_CAP_M, 1),
    "stop_distance": _longitudinal("stop", LINE_CAP_M, 0),
    "stop_speed": _longitudinal("stop", LINE_CAP_M, 1),
    "virtual_distance": _longitudinal("virtual", LINE_CAP_M, 0),
    "virtual_speed": _longitudinal("virtual", LINE_CAP_M, 1),
    "nudge_distance": _longitudinal("nudge", LINE_CAP_M, 0),
    "nudge_lateral": _nudge(0),
    "nudge_speed": _nudge(1),
    "sidepass_front_distance": _longitudinal("sidepass_front", OBSTACLE_CAP_M, 0),
    "sidepass_front_speed": _longitudinal("sidepass_front", OBSTACLE_CAP_M, 1),
    "sidepass_rear_distance": _longitudinal("sidepass_rear", OBSTACLE_CAP_M, 0),
    "sidepass_rear_speed": _longitudinal("sidepass_rear", OBSTACLE_CAP_M, 1),
}
