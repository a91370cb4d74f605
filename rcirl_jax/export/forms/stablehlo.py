"""A reward as StableHLO: one compiled scorer for any number of candidates.

    (features [K, T, F] float32, valid [T] bool) -> values [K] float32

Two forms of the same program: `jax.export`'s own bytes, which
`jax.export.deserialize` calls again, and portable StableHLO bytecode for other
compilers (IREE, XLA). K is symbolic; T, F and the weights are constants.
"""

import functools
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.export.loading import reward_params, scored
from rcirl_jax.export.reader import Reward
from rcirl_jax.runtime.atomic_files import write_whole

Form = Literal["jax", "stablehlo"]


def exported(reward: Reward) -> jax.export.Exported:
    """The scorer with K left open, for CPUs and NVIDIA GPUs.

    Raises:
      InputError: a file with an output bias, which this package never writes and
        its own scorers leave out because it cancels.
    """
    if np.any(reward.biases[-1]):
        raise InputError(f"{reward.file}: layers: output bias: expected 0")
    effective, normaliser = reward_params(reward)
    program = functools.partial(
        scored, effective, normaliser, activation=reward.activation
    )
    (count,) = jax.export.symbolic_shape("k")
    times, features = len(reward.times), len(reward.names)
    shapes = (
        jax.ShapeDtypeStruct((count, times, features), jnp.float32),
        jax.ShapeDtypeStruct((times,), jnp.bool_),
    )
    return jax.export.export(jax.jit(program), platforms=("cpu", "cuda"))(*shapes)


def write_stablehlo(path: Path, reward: Reward, form: Form) -> None:
    """Write the scorer.

    Raises:
      InputError: the package flatbuffers, which jax.export needs, is missing.
    """
    made = exported(reward)
    if form == "stablehlo":
        content = bytes(made.mlir_module_serialized)
    else:
        try:
            content = bytes(made.serialize())
        except ImportError as error:
            raise InputError(
                "--jax_export: flatbuffers: not installed: expected the extra [export]"
            ) from error
    write_whole(path, content)
