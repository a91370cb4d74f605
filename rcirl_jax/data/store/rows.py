"""The rows of a dataset: shape and dtype of every leaf of a Demonstration."""

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


def _leaf(*shape: int, dtype: type = np.float32) -> jax.Array:
    # a description in an array's place, as jax.eval_shape has it
    return cast(jax.Array, jax.ShapeDtypeStruct(shape, dtype))


def _node(kind: type[_T], /, *shape: int, **other: jax.Array) -> _T:
    """Returns a pytree node of float32 leaves of one shape, but for `other`."""
    names = (field.name for field in dataclasses.fields(cast(Any, kind)))
    return kind(**{name: other.get(name, _leaf(*shape)) for name in names})


def row_spec() -> Demonstration:
    """Returns shape and dtype of every leaf of one stored row."""
    slots, numbers = _leaf(NUM_OBSTACLES), _leaf(NUM_OBSTACLES, dtype=np.int32)
    valid = _leaf(NUM_OBSTACLES, NUM_TIMES, dtype=np.bool_)
    motion = {"valid": valid, "kind": numbers, "a": slots, "l_dot": slots}
    scene = Scene(
        ego=_node(Ego),
        path=_node(Path, NUM_STATIONS),
        obstacles=_node(Obstacles, NUM_OBSTACLES, NUM_TIMES, **motion),
        time_valid=_leaf(NUM_TIMES, dtype=np.bool_),
        tags=_leaf(NUM_TAGS, dtype=np.bool_),
    )
    whole = ("vehicle", "recording", "group", "frame")
    return _node(
        Demonstration,
        scene=cast(jax.Array, scene),
        human=cast(jax.Array, _node(Trajectory, NUM_TIMES)),
        decisions=numbers,
        **{name: _leaf(dtype=np.int32) for name in whole},
    )


def named_leaves(rows: Demonstration) -> dict[str, Any]:
    """Returns leaves by path, e.g. "scene.path.kappa", in the order of the tree."""
    flat, _ = jax.tree_util.tree_flatten_with_path(rows)
    return {".".join(key.name for key in path): leaf for path, leaf in flat}


@functools.cache
def leaf_specs() -> dict[str, jax.ShapeDtypeStruct]:
    """Returns shape and dtype of one row's leaves by name."""
    return named_leaves(row_spec())


def scene_name(rows: Demonstration, at: int, row: int) -> str:
    """Names a scene in one line: its dataset row and the numbers that it carries.

    Recording and vehicle number the manifest's tables, the frame those of the
    recording.

    Args:
      rows: demonstrations (numpy).
      at: place of the scene among them.
      row: its row in the dataset.
    """
    numbers = ", ".join(
        f"{name} {int(np.asarray(getattr(rows, name))[at])}"
        for name in ("recording", "vehicle", "frame")
    )
    return f"scene {row} ({numbers})"


def unusable_leaves(rows: Demonstration, at: int) -> list[str]:
    """Returns names of a scene's leaves that hold a NaN or an infinity."""
    return [
        name
        for name, leaf in named_leaves(rows).items()
        if not np.isfinite(np.asarray(leaf[at])).all()
    ]


def refuse_scenes(
    what: str, rows: Demonstration, index: np.ndarray, bad: Mapping[str, np.ndarray]
) -> None:
    """Refuses scenes of which something is no finite number.

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


def check_some(what: str, index: np.ndarray) -> None:
    """Refuses a split without scenes.

    Raises:
      InputError: `index` is empty.
    """
    if len(index) == 0:
        raise InputError(
            f"{what}: 0 scenes: expected at least one; import with test_fraction "
            "above 0, or more recordings"
        )


def check_finite(what: str, rows: Demonstration, index: np.ndarray) -> None:
    """`refuse_scenes` for what n scenes (numpy) hold themselves, or if n is 0."""
    check_some(what, index)
    bad = {
        name: ~np.isfinite(leaf).reshape(len(index), -1).all(axis=1)
        for name, leaf in named_leaves(rows).items()
        if leaf.dtype == np.float32
    }
    refuse_scenes(what, rows, index, bad)
