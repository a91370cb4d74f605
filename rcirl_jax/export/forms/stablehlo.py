"""A reward as StableHLO: one compiled scorer for any number of candidates.

    (features [K, T, F] float32, valid [T] bool) -> values [K] float32

Two forms of the same program: `jax.export`'s own bytes, which
`jax.export.deserialize` calls again, and portable StableHLO bytecode for other
compilers (IREE, XLA). K is symbolic; T, F and the weights are constants.
"""

from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.export.from_run import read_config
from rcirl_jax.export.loading import reward_params
from rcirl_jax.export.reader import Reward
from rcirl_jax.reward import (
    Normaliser,
    RewardModel,
    RewardParams,
    effective_model,
    value,
)
from rcirl_jax.runtime.atomic_files import write_whole
from rcirl_jax.train.loop import restore_run

Form = Literal["jax", "stablehlo"]


def exported(reward: Reward) -> jax.export.Exported:
    """The scorer of a weights file.

    Raises:
      InputError: a file with an output bias, which this package never writes and
        its own scorers leave out because it cancels.
    """
    if np.any(reward.biases[-1]):
        raise InputError(f"{reward.file}: layers: output bias: expected 0")
    effective, normaliser = reward_params(reward)
    model = effective_model(effective, str(reward.activation))
    return exported_module(model, effective, normaliser)


def exported_run(workdir: Path) -> jax.export.Exported:
    """The scorer of a run's newest checkpoint, whatever its R_theta is.

    Raises:
      InputError: no run, or no whole checkpoint.
    """
    config, _ = read_config(workdir)
    state = restore_run(workdir, config)
    return exported_module(RewardModel(config.reward), state.params, state.normaliser)


def exported_module(
    model: RewardModel, params: RewardParams, normaliser: Normaliser
) -> jax.export.Exported:
    """V of a module with K left open, for CPUs and NVIDIA GPUs."""

    def program(features: jax.Array, valid: jax.Array) -> jax.Array:
        # each trajectory with its own gates, as the readers of a file value it
        masks = jnp.broadcast_to(valid, features.shape[:2])
        return value(model, params, normaliser, features, masks)

    (count,) = jax.export.symbolic_shape("k")
    shape = (count, model.times, normaliser.scale.shape[0])
    shapes = (
        jax.ShapeDtypeStruct(shape, jnp.float32),
        jax.ShapeDtypeStruct((model.times,), jnp.bool_),
    )
    return jax.export.export(jax.jit(program), platforms=("cpu", "cuda"))(*shapes)


def write_stablehlo(path: Path, made: jax.export.Exported, form: Form) -> None:
    """Write a scorer.

    Raises:
      InputError: the package flatbuffers, which jax.export needs, is missing.
    """
    if form == "stablehlo":
        content = bytes(made.mlir_module_serialized)
    else:
        try:
            content = bytes(made.serialize())
        except ImportError as error:
            raise InputError(
                "flatbuffers: not installed: expected pip install 'rcirl-jax[export]'"
            ) from error
    write_whole(path, content)
