"""What a row of a dataset is: shape and dtype of every leaf of a Demonstration."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, TypeVar, cast

import jax
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.types import (
    NUM_TAGS,
    Demonstration,
    Ego,
    Obstacles,
    Path,
    Scene,
    Trajectory,
)
from rcirl_jax.units import NUM_OBSTACLES, NUM_STATIONS, NUM_TIMES

_T = TypeVar("_T")


def _node(
    kind: type[_T], shape: tuple, dtype: type = np.float32, /, **other: tuple
) -> _T:
    """Return a pytree node whose leaves have one shape and dtype, but for `other`."""
    names = (field.name for field in dataclasses.fields(cast(Any, kind)))
    return kind(**{x: _leaf(*other.get(x, (shape, dtype))) for x in names})


def _leaf(shape: tuple, dtype: type) -> jax.Array:
    # a description in an array's place, as jax.eval_shape has it
    return cast(jax.Array, jax.ShapeDtypeStruct(shape, dtype))


def row_spec() -> Demonstration:
    """Return shape and dtype of every leaf of one stored row."""
    slots, motion = (NUM_OBSTACLES,), (NUM_OBSTACLES, NUM_TIMES)
    scene = Scene(
        ego=_node(Ego, ()),
        path=_node(Path, (NUM_STATIONS,)),
        obstacles=_node(
            Obstacles,
            motion,
            valid=(motion, np.bool_),
            kind=(slots, np.int32),
            a=(slots, np.float32),
            l_dot=(slots, np.float32),
        ),
        time_valid=_leaf((NUM_TIMES,), np.bool_),
        tags=_leaf((NUM_TAGS,), np.bool_),
    )
    return Demonstration(
        scene=scene,
        human=_node(Trajectory, (NUM_TIMES,)),
        decisions=_leaf(slots, np.int32),
        **{name: _leaf((), np.float32) for name in ("future_s", "s_at_5s")},
        **{
            name: _leaf((), np.int32)
            for name in ("vehicle", "recording", "group", "frame")
        },
    )


def named_leaves(rows: Demonstration) -> dict[str, Any]:
    """Return leaves by path, e.g. "scene.path.kappa", in the order of the tree."""
    flat, _ = jax.tree_util.tree_flatten_with_path(rows)
    return {".".join(key.name for key in path): leaf for path, leaf in flat}


@functools.cache
def leaf_specs() -> dict[str, jax.ShapeDtypeStruct]:
    """Return shape and dtype of one row's leaves by name."""
    return named_leaves(row_spec())


def checked_leaves(rows: Demonstration) -> dict[str, np.ndarray]:
    """Return leaves as contiguous arrays; ValueError if one is not `[n, *spec]`."""
    leaves = {k: np.ascontiguousarray(v) for k, v in named_leaves(rows).items()}
    count = leaves["vehicle"].size
    for name, spec in leaf_specs().items():
        shape, dtype = (count, *spec.shape), spec.dtype
        if leaves[name].shape != shape or leaves[name].dtype != dtype:
            raise ValueError(
                f"{name}: {leaves[name].dtype} {leaves[name].shape}: "
                f"expected {dtype} {shape}"
            )
    if count == 0:
        raise ValueError("shard: 0 rows: expected at least one")
    return leaves


def scene_name(rows: Demonstration, at: int, row: int) -> str:
    """Name a scene in one line: its dataset row and the numbers that it carries.

    Recording and vehicle number the manifest's tables, the frame those of the
    recording.

    Args:
      rows: demonstrations (numpy).
      at: place of the scene among them.
      row: its row in the dataset.
    """
    number = lambda name: int(np.asarray(getattr(rows, name))[at])  # noqa: E731
    names = ("recording", "vehicle", "frame")
    return f"scene {row} ({', '.join(f'{name} {number(name)}' for name in names)})"


def unusable_leaves(rows: Demonstration, at: int) -> list[str]:
    """Return names of a scene's leaves that hold a NaN or an infinity."""
    return [
        name
        for name, leaf in named_leaves(rows).items()
        if not np.isfinite(np.asarray(leaf[at])).all()
    ]


def refuse_scenes(
    what: str, rows: Demonstration, index: np.ndarray, bad: Mapping[str, np.ndarray]
) -> None:
    """Refuse scenes of which something is no finite number.

    Args:
      what: first in the line, who read or made it.
      rows: n demonstrations (numpy), or more than n.
      index: [n] their rows in the dataset.
      bad: name -> [n] bool, what is not finite of each scene.

    Raises:
      InputError: names the first such scene and all that is bad of it.
    """
    table = np.array(list(bad.values())).reshape(len(bad), -1)
    if table.any():
        at = int(np.argmax(table.any(axis=0)))
        found = [name for name, is_bad in zip(bad, table[:, at], strict=True) if is_bad]
        raise InputError(
            f"{what}: {scene_name(rows, at, int(index[at]))}: {', '.join(found)}: not "
            "finite: expected finite numbers"
        )


def check_finite(what: str, rows: Demonstration, index: np.ndarray) -> None:
    """`refuse_scenes` for what n scenes (numpy) hold themselves, or if n is 0."""
    if len(index) == 0:
        raise InputError(
            f"{what}: 0 scenes: expected at least one; import with test_fraction "
            "above 0, or more recordings"
        )
    bad = {
        name: ~np.isfinite(leaf).reshape(len(index), -1).all(axis=1)
        for name, leaf in named_leaves(rows).items()
        if leaf.dtype == np.float32
    }
    refuse_scenes(what, rows, index, bad)
