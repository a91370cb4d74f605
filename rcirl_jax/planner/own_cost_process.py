"""The process in which an own cost of numpy or C is computed; see `own_cost`.

    python -m rcirl_jax.planner.own_cost_process costs.py:my_cost

Reads batches as named arrays from standard input (`runtime.answering`), and writes
costs [n, K], or a line on what is wrong. Knows nothing of JAX, so that it starts at
once. What the cost prints goes to standard error.
"""

import ctypes
import os
import struct
import sys
import types
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.answering import packed, unpacked
from rcirl_jax.runtime.user_code import python_object
from rcirl_jax.units import STATION_STEP_M, TIMES_S

ABI = 1  # RCIRL_COST_ABI
_FLOATS, _INTS = ctypes.POINTER(ctypes.c_float), ctypes.POINTER(ctypes.c_int32)
_BYTES = ctypes.POINTER(ctypes.c_uint8)
EGO = ("s", "l", "dl", "ddl", "v", "a", "length", "width")
PATH = (
    *("kappa", "l", "speed_limit", "lane_left", "lane_right"),
    *("road_left", "road_right"),
)
BOXES = ("s_lower", "s_upper", "l_lower", "l_upper", "speed")
MOTION = ("s", "v", "a", "j", "l", "dl", "ddl")


class CScene(ctypes.Structure):
    """`rcirl_scene` of cost_abi.h."""

    _fields_ = [
        *((f"ego_{name}", ctypes.c_float) for name in EGO),
        ("num_stations", ctypes.c_int32),
        ("station_step", ctypes.c_float),
        *((f"path_{name}", _FLOATS) for name in PATH),
        ("num_times", ctypes.c_int32),
        ("times", _FLOATS),
        ("time_valid", _BYTES),
        ("num_obstacles", ctypes.c_int32),
        ("kind", _INTS),
        ("obstacle_a", _FLOATS),
        ("obstacle_l_dot", _FLOATS),
        *((name, _FLOATS) for name in BOXES),
        ("valid", _BYTES),
    ]


class CCandidates(ctypes.Structure):
    """`rcirl_candidates` of cost_abi.h."""

    _fields_ = [
        ("count", ctypes.c_int32),
        ("num_times", ctypes.c_int32),
        *((name, _FLOATS) for name in MOTION),
        ("feasible", _BYTES),
    ]


def library_cost(path: str) -> Callable[[Any, Any], np.ndarray]:
    """Makes the cost of a C library."""
    library = ctypes.CDLL(os.path.abspath(path))
    for name in ("rcirl_cost_abi", "rcirl_cost"):
        if not hasattr(library, name):
            raise InputError(
                f"{name}: missing in the library: expected both functions of "
                'cost_abi.h, in C++ as extern "C"'
            )
    if (found := library.rcirl_cost_abi()) != ABI:
        raise InputError(
            f"rcirl_cost_abi: {found}: expected {ABI}; compile it with this cost_abi.h"
        )

    def cost(scene: Any, candidates: Any) -> np.ndarray:  # noqa: ANN401
        kept = []  # arrays that pointers point into

        def pointer(values: Any, kind: type, to: Any) -> Any:  # noqa: ANN401
            array = np.ascontiguousarray(values, kind)
            kept.append(array)
            return array.ctypes.data_as(to)

        floats = lambda values: pointer(values, np.float32, _FLOATS)  # noqa: E731
        flags = lambda values: pointer(values, np.uint8, _BYTES)  # noqa: E731
        ego, path, others = scene.ego, scene.path, scene.obstacles
        given = CScene(
            **{f"ego_{name}": float(getattr(ego, name)) for name in EGO},
            num_stations=len(path.kappa),
            station_step=STATION_STEP_M,
            **{f"path_{name}": floats(getattr(path, name)) for name in PATH},
            num_times=len(TIMES_S),
            times=floats(TIMES_S),
            time_valid=flags(scene.time_valid),
            num_obstacles=len(others.kind),
            kind=pointer(others.kind, np.int32, _INTS),
            obstacle_a=floats(others.a),
            obstacle_l_dot=floats(others.l_dot),
            **{name: floats(getattr(others, name)) for name in BOXES},
            valid=flags(others.valid),
        )
        motion = candidates.trajectory
        count = len(candidates.feasible)
        chosen = CCandidates(
            count=count,
            num_times=len(TIMES_S),
            **{name: floats(getattr(motion, name)) for name in MOTION},
            feasible=flags(candidates.feasible),
        )
        costs = (ctypes.c_double * count)(*[float("nan")] * count)
        status = library.rcirl_cost(ctypes.byref(given), ctypes.byref(chosen), costs)
        if status:
            raise InputError(f"rcirl_cost: it returned {status}: expected 0")
        return np.array(costs)

    return cost


def _node(arrays: Mapping[str, np.ndarray], number: int) -> types.SimpleNamespace:
    """One of a batch, with attributes for the parts of names."""
    root = types.SimpleNamespace()
    for name, array in arrays.items():
        *path, last = name.split(".")
        at = root
        for part in path:
            if not hasattr(at, part):
                setattr(at, part, types.SimpleNamespace())
            at = getattr(at, part)
        setattr(at, last, array[number])
    return root


def main() -> None:
    """Answers until standard input ends."""
    place, answers = sys.argv[1], os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    cost: Any = None
    while head := sys.stdin.buffer.read(8):
        given = unpacked(sys.stdin.buffer.read(*struct.unpack("<Q", head)))
        try:
            if cost is None:
                is_library = place.endswith(".so")
                cost = (library_cost if is_library else python_object)(place)
            count = len(given["candidates.feasible"]) if given else 0
            each = [_node(given, number) for number in range(count)]
            costs = [np.asarray(cost(x.scene, x.candidates), float) for x in each]
            made = {"costs": np.stack(costs) if costs else np.zeros(0)}
        except Exception as error:
            kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
            made = {"wrong": np.array(f"{kind}{error}")}
        answers.write(packed(made))
        answers.flush()


if __name__ == "__main__":
    main()
