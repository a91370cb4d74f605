"""What a row of a dataset is: shape and dtype of every leaf of a Demonstration."""

import dataclasses
import functools
from typing import Any, TypeVar, cast

import jax
import numpy as np

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
    """A pytree node whose leaves have one shape and dtype, but for `other`."""
    leaves = {}
    for field in dataclasses.fields(cast(Any, kind)):
        size, of = other.get(field.name, (shape, dtype))
        leaves[field.name] = _leaf(size, of)
    return kind(**leaves)


def _leaf(shape: tuple, dtype: type) -> jax.Array:
    # a description in an array's place, as jax.eval_shape has it
    return cast(jax.Array, jax.ShapeDtypeStruct(shape, dtype))


def row_spec() -> Demonstration:
    """Shape and dtype of every leaf of one stored row."""
    slots, motion = (NUM_OBSTACLES,), (NUM_OBSTACLES, NUM_TIMES)
    scene = Scene(
        ego=_node(Ego, ()),
        path=_node(Path, (NUM_STATIONS,)),
        obstacles=_node(
            Obstacles,
            motion,
            valid=(motion, np.bool_),
            kind=(slots, np.int32),
            is_recorded=(slots, np.bool_),
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
    """Leaves by path, e.g. "scene.path.kappa", in the order of the tree."""
    flat, _ = jax.tree_util.tree_flatten_with_path(rows)
    return {".".join(key.name for key in path): leaf for path, leaf in flat}


@functools.cache
def leaf_specs() -> dict[str, jax.ShapeDtypeStruct]:
    """Shape and dtype of one row's leaves by name."""
    return named_leaves(row_spec())


def checked_leaves(rows: Demonstration) -> dict[str, np.ndarray]:
    """Leaves as contiguous arrays; ValueError where one is not `[n, *spec]`."""
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
