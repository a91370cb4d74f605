"""Flat rows of one scene each -> one batched Demonstration of numpy arrays."""

import functools
from typing import Any

import jax
import numpy as np

from rcirl_jax.sampling.kinematics import trajectory_from_positions
from rcirl_jax.types import Demonstration, Ego, Obstacles, Path, Scene, Trajectory

CHUNK = 512  # scenes per device call; padded, so that it compiles once


def stack_scenes(rows: list[dict]) -> Scene:
    """Scenes [n, ...] from flat rows; floats become float32."""

    def leaf(name: str) -> Any:  # noqa: ANN401
        values = np.array([row[name] for row in rows])
        return values.astype(np.float32) if values.dtype.kind == "f" else values

    def node(kind: type, prefix: str) -> Any:  # noqa: ANN401
        names = kind.__dataclass_fields__
        return kind(**{name: leaf(f"{prefix}.{name}") for name in names})

    return Scene(
        ego=node(Ego, "ego"),
        path=node(Path, "path"),
        obstacles=node(Obstacles, "obstacles"),
        time_valid=leaf("time_valid"),
        tags=leaf("tags"),
    )


@functools.cache
def _complete() -> jax.stages.Wrapped:
    return jax.jit(jax.vmap(trajectory_from_positions))


def human_trajectories(scene: Scene, s: np.ndarray, l: np.ndarray) -> Trajectory:
    """The humans' Trajectories [n, T] through the operator shared with candidates."""
    count = s.shape[0]
    parts = []
    for start in range(0, count, CHUNK):
        index = np.minimum(np.arange(start, start + CHUNK), count - 1)
        chunk = jax.tree.map(lambda x, index=index: x[index], scene)
        full = _complete()(chunk, s[index], l[index])
        keep = min(CHUNK, count - start)
        parts.append(jax.tree.map(lambda x, keep=keep: np.asarray(x)[:keep], full))
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def assemble(
    rows: list[dict], *, vehicles: list[int], groups: list[int], recording: int
) -> Demonstration:
    """One batched Demonstration of a recording's rows.

    Args:
      rows: at least one row as made by `collect.Collector`.
      vehicles: number of the ego's vehicle inside the dataset, per row.
      groups: number of the vehicle-disjoint group, per row.
      recording: number of the recording inside the dataset.

    Returns:
      Demonstration with numpy leaves [n, ...].
    """
    scene = stack_scenes(rows)
    s = np.array([row["human.s"] for row in rows], np.float32)
    l = np.array([row["human.l"] for row in rows], np.float32)
    leaves: dict[str, Any] = {
        "decisions": np.array([row["decisions"] for row in rows], np.int32),
        "future_s": np.array([row["future_s"] for row in rows], np.float32),
        "s_at_5s": np.array([row["s_at_5s"] for row in rows], np.float32),
        "vehicle": np.array(vehicles, np.int32),
        "recording": np.full(len(rows), recording, np.int32),
        "group": np.array(groups, np.int32),
        "frame": np.array([row["frame"] for row in rows], np.int32),
    }
    return Demonstration(
        scene=scene,
        human=human_trajectories(scene, s, l),
        **leaves,
    )
