"""One step on one or many devices. The only file that names pmap or a mesh.

The same pure step becomes a function of (state, batch) with replicated state in
and out; the batch is [B, ...] in all cases and B must be a multiple of the number
of devices, which are those of all processes together. A process holds its
contiguous part of the batch; `place` makes one global batch of the parts.

On a CPU wait for every step before the next (the loop does): its devices share one
pool of threads, and steps that run ahead may wait for each other's sums for ever.
"""

import contextlib
import dataclasses
import os
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.compiling import wide_vectors
from rcirl_jax.runtime.provenance import processor

AXIS = "data"  # the one mesh axis: data parallel
Step = Callable[..., tuple]
Place = Callable[[Any], Any]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Parallel:
    """A step and how its arguments get to its devices."""

    step: Step  # (state, batch) -> (state, metrics)
    place: Place  # this process's rows [B / processes, ...], numpy -> the batch
    replicate: Place  # state made in every process -> the state of process 0 in all


def single(step: Step) -> Step:
    """The step under jit on the default device."""
    return jax.jit(step, compiler_options=wide_vectors())


def pmapped(step: Step, num_devices: int) -> Step:
    """The step under pmap, which takes this process's rows only.

    It knows no compiler options; XLA chooses the width of vectors.
    """
    here = len(_local(num_devices))
    everywhere, _ = _shardings(num_devices)
    mapped = jax.pmap(
        lambda state, batch: step(state, batch, axis_name=AXIS),
        axis_name=AXIS,
        in_axes=(None, 0),
        out_axes=None,
        devices=_devices(num_devices),
    )

    def run(state: object, batch: object) -> tuple:
        split = jax.tree.map(
            lambda x: x.reshape(here, x.shape[0] // here, *x.shape[1:]), batch
        )
        # pmap gives copies on the devices of this process: name all of them
        return jax.tree.map(lambda x: _global(x, everywhere), mapped(state, split))

    return run


def sharded(step: Step, num_devices: int) -> Step:
    """The step under jit(shard_map) over a one-axis mesh."""
    mesh, spec = _mesh(num_devices), jax.sharding.PartitionSpec
    return jax.jit(
        jax.shard_map(
            lambda state, batch: step(state, batch, axis_name=AXIS),
            mesh=mesh,
            in_specs=(spec(), spec(AXIS)),
            out_specs=spec(),
            # With the check on, the gradient of a replicated input is summed
            # over the axis by itself, and the step's own psum would count twice.
            check_vma=False,
        ),
        compiler_options=wide_vectors(),
    )


MANY = {"pmap": pmapped, "shard_map": sharded}
PARALLEL = ("auto", "jit", *MANY)
LEAST_SCENES = 8  # of a batch that a CPU core gets; with fewer its sums take as long


def share_cores(batch_size: int) -> None:
    """Make JAX count the cores of a CPU as devices, as many as share a batch evenly.

    Before JAX is first used; afterwards, or where XLA_FLAGS or JAX_NUM_CPU_DEVICES say
    how many there are, nothing happens. Other devices are not touched.
    """
    by_flag = "host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if by_flag or "JAX_NUM_CPU_DEVICES" in os.environ:
        return
    most = min(processor()["cores"], batch_size // LEAST_SCENES)
    count = next((n for n in range(most, 1, -1) if batch_size % n == 0), 1)
    with contextlib.suppress(RuntimeError):  # JAX is in use
        jax.config.update("jax_num_cpu_devices", count)


def chosen(batch_size: int) -> str:
    """What "auto" is: all devices where they share a batch evenly, else the first."""
    many = jax.device_count() > 1 and batch_size % jax.device_count() == 0
    return "shard_map" if many or jax.process_count() > 1 else "jit"


def parallelise(step: Step, how: str, batch_size: int) -> Parallel:
    """The step run as `how` on all devices of all processes.

    Raises:
      InputError: unknown `how`, one device for several processes, or a batch that
        does not divide evenly.
    """
    if how not in PARALLEL:
        raise InputError(f"parallel: {how}: expected one of {', '.join(PARALLEL)}")
    how = chosen(batch_size) if how == "auto" else how
    if how == "jit":
        if jax.process_count() > 1:
            raise InputError(
                f"parallel: jit: {jax.process_count()} processes: "
                f"expected one of {', '.join(MANY)}"
            )
        return Parallel(step=single(step), place=jax.device_put, replicate=lambda x: x)
    count = jax.device_count()
    if batch_size % count:
        raise InputError(
            f"batch_size: {batch_size}: expected a multiple of {count} devices"
        )
    everywhere, rows = _shardings(count)

    def place(batch: Any) -> Any:  # noqa: ANN401
        return jax.make_array_from_process_local_data(rows, batch)

    return Parallel(
        step=MANY[how](step, count),
        # pmap takes each process's own rows
        place=jax.device_put if how == "pmap" else place,
        replicate=lambda state: _replicate(state, everywhere),
    )


def _replicate(state: Any, everywhere: jax.NamedSharding) -> Any:  # noqa: ANN401
    """The state of process 0 on every device; typed keys travel as numbers."""
    numbers = jax.tree.map(
        lambda x: np.asarray(jax.random.key_data(x) if _is_key(x) else x), state
    )
    numbers = multihost_utils.broadcast_one_to_all(numbers)

    def put(leaf: jax.Array, value: np.ndarray) -> jax.Array:
        made = jax.make_array_from_process_local_data(everywhere, value, value.shape)
        if not _is_key(leaf):
            return made
        return jax.random.wrap_key_data(made, impl=jax.random.key_impl(leaf))

    return jax.tree.map(put, state, numbers)


def _global(leaf: jax.Array, everywhere: jax.NamedSharding) -> jax.Array:
    """Copies on the devices of this process as part of those on all devices."""
    copies = [shard.data for shard in leaf.addressable_shards]
    return jax.make_array_from_single_device_arrays(leaf.shape, everywhere, copies)


def _is_key(leaf: jax.Array) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _shardings(num_devices: int) -> tuple[jax.NamedSharding, jax.NamedSharding]:
    """(a copy on every device, rows split over the devices)."""
    mesh, spec = _mesh(num_devices), jax.sharding.PartitionSpec
    return jax.NamedSharding(mesh, spec()), jax.NamedSharding(mesh, spec(AXIS))


def _mesh(num_devices: int) -> jax.sharding.Mesh:
    return jax.sharding.Mesh(np.array(_devices(num_devices)), (AXIS,))


def _devices(count: int) -> list[Any]:
    devices = jax.devices()
    if count > len(devices):
        raise InputError(f"devices: {count}: expected at most {len(devices)}")
    return devices[:count]


def _local(count: int) -> list[Any]:
    """Those of the first devices that belong to this process."""
    own = jax.process_index()
    return [device for device in _devices(count) if device.process_index == own]
