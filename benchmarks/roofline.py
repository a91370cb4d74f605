"""Least cost of a query, and the peaks of the machine.

Peaks are measured: a matrix product and an update a + s b of long arrays under jit.
The network is counted by hand, sampler and features from their jaxprs.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.common import timed

MATRIX = 2048  # rows of the product
TRIAD = 1 << 26  # values of the update: 256 MB each, far more than any cache
REPEATS = 8  # the best counts
TRANSCENDENTAL = ("exp", "log", "tanh", "sin", "cos", "sqrt", "rsqrt", "pow", "atan2")
FREE = (
    *("broadcast_in_dim", "reshape", "transpose", "squeeze", "concatenate", "pad"),
    *("slice", "dynamic_slice", "gather", "scatter", "convert_element_type", "copy"),
    *("iota", "rev", "split", "stop_gradient", "bitcast_convert_type", "random_wrap"),
    *("random_unwrap", "random_fold_in", "random_bits", "random_split", "threefry2x32"),
)


def _best(call: Callable[[], object]) -> float:
    return min(timed(call, REPEATS, warm_up=1))


def peaks() -> dict[str, float]:
    """GFLOP/s of a float32 matrix product and GB/s of a <- a + s b."""
    square = jax.random.normal(jax.random.key(0), (MATRIX, MATRIX))
    product = jax.jit(jnp.matmul)
    flops = 2.0 * MATRIX**3 / _best(lambda: product(square, square))
    update = jax.jit(lambda a, b: a + 0.5 * b, donate_argnums=0)
    held, other = [jnp.ones(TRIAD)], jnp.ones(TRIAD)

    def triad() -> jax.Array:
        held[0] = update(held[0], other)
        return held[0]

    return {
        "gflop_per_s": round(flops / 1e9, 1),
        "gb_per_s": round(12.0 * TRIAD / _best(triad) / 1e9, 1),
    }


def network_flops(features: int, hidden: int) -> dict[str, int]:
    """Operations of one point through F-H-1, forward and backward; tanh apart.

    The least that is needed: a normaliser may go into the first layer (ours takes
    2 F for it), and units that fill up a vector are not counted.

    forward   clip 2 F, first layer 2 F H, bias H, output 2 H, time weight 2
    backward  output kernel 2 H, hidden H, tanh' 3 H, first kernel 2 F H, bias H
    """
    forward = 2 * features + 2 * features * hidden + 3 * hidden + 2
    backward = 2 * features * hidden + 7 * hidden
    return {"forward": forward, "backward": backward, "tanh": hidden}


def operations(function: Callable, *arguments: object) -> dict[str, float]:
    """Arithmetic of a function of arrays, from its jaxpr, before any compiler.

    One per result of an elementwise operation (comparisons and selections too), one
    per operand of a sum or extremum, two per product of a matrix product; a scan's
    body as often as it runs; transcendental functions apart; moving data is free.
    """
    found = {"flops": 0.0, "transcendentals": 0.0}
    _count(jax.make_jaxpr(function)(*arguments).jaxpr, 1.0, found)
    return found


def _count(jaxpr: Any, times: float, found: dict[str, float]) -> None:  # noqa: ANN401
    for equation in jaxpr.eqns:
        name, params = equation.primitive.name, equation.params
        inner = [p for v in params.values() for p in _jaxprs(v)]
        if inner:
            runs = params["length"] if name == "scan" else 1
            for one in inner:
                _count(one, times * runs, found)
        elif name not in FREE:
            size = equation.outvars[0].aval.size
            if name.startswith(("reduce_", "arg", "cum")):
                size = equation.invars[0].aval.size
            if name == "dot_general":
                (contracted, _), _ = params["dimension_numbers"]
                shape = equation.invars[0].aval.shape
                size *= 2 * math.prod(shape[axis] for axis in contracted)
            kind = "transcendentals" if name in TRANSCENDENTAL else "flops"
            found[kind] += times * size


def _jaxprs(value: Any) -> list:  # noqa: ANN401
    """The programs in a parameter of an operation."""
    values = value if isinstance(value, tuple) else (value,)
    found = [getattr(v, "jaxpr", v) for v in values]
    return [v for v in found if hasattr(v, "eqns")]
