"""One step on one or many devices. The only file that names pmap or a mesh.

`single`, `pmapped` and `sharded` turn the same pure step into a function of
(state, batch) with replicated state in and out; the batch is [B, ...] in all
three and B must be a multiple of the number of devices.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from rcirl_jax.errors import InputError

AXIS = "data"  # the one mesh axis: data parallel
Step = Callable[..., tuple]


def single(step: Step) -> Step:
    """The step under jit on the default device."""
    return jax.jit(step)


def pmapped(step: Step, num_devices: int) -> Step:
    """The step under pmap over `num_devices` local devices."""
    devices = _devices(num_devices)
    mapped = jax.pmap(
        lambda state, batch: step(state, batch, axis_name=AXIS),
        axis_name=AXIS,
        in_axes=(None, 0),
        out_axes=None,
        devices=devices,
    )

    def run(state: object, batch: object) -> tuple:
        split = jax.tree.map(
            lambda x: x.reshape(num_devices, x.shape[0] // num_devices, *x.shape[1:]),
            batch,
        )
        return mapped(state, split)

    return run


def sharded(step: Step, num_devices: int) -> Step:
    """The step under jit(shard_map) over a one-axis mesh."""
    mesh = jax.sharding.Mesh(np.array(_devices(num_devices)), (AXIS,))
    spec = jax.sharding.PartitionSpec
    return jax.jit(
        jax.shard_map(
            lambda state, batch: step(state, batch, axis_name=AXIS),
            mesh=mesh,
            in_specs=(spec(), spec(AXIS)),
            out_specs=spec(),
            # With the check on, the gradient of a replicated input is summed
            # over the axis by itself, and the step's own psum would count twice.
            check_vma=False,
        )
    )


PARALLEL = ("jit", "pmap", "shard_map")


def parallelise(step: Step, how: str, batch_size: int) -> Step:
    """The step run as `how` on all local devices.

    Raises:
      InputError: unknown `how`, or a batch that does not divide evenly.
    """
    if how == "jit":
        return single(step)
    count = jax.local_device_count()
    if batch_size % count:
        raise InputError(
            f"--batch_size: {batch_size}: expected a multiple of {count} devices"
        )
    if how == "pmap":
        return pmapped(step, count)
    if how == "shard_map":
        return sharded(step, count)
    raise InputError(f"--parallel: {how}: expected one of {', '.join(PARALLEL)}")


def _devices(count: int) -> list[Any]:
    devices = jax.local_devices()
    if count > len(devices):
        raise InputError(f"devices: {count}: expected at most {len(devices)}")
    return devices[:count]
