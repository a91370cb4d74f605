"""One step on one or many devices and processes: the only file naming pmap or a mesh.

The same pure step becomes a function of (state, batch) with replicated state in
and out; the batch is [B, ...] in all cases and B must be a multiple of the number
of devices, which are those of all processes together. A process holds its
contiguous part of the batch; `place` makes one global batch of the parts.

"shard_map" is `jit` over arrays with a NamedSharding, where every device scans over
its own scenes; it is what "auto" takes on several devices. Without it `jit` gives every
device all scenes of the scan, which takes twice as long on two CPU devices; under
`jax.vmap` over the shards it takes 8 % longer. On a CPU wait for every step
before the next (the loop does): its devices share one pool of threads, and steps that
run ahead may wait for each other's sums for ever.
"""

import contextlib
import dataclasses
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.compiling import wide_vectors
from rcirl_jax.runtime.provenance import processor

AXIS = "data"  # the one mesh axis: data parallel
EXIT_LOST = 2  # status of a process that lost another, as of other lost work
LEAST_SCENES = 8  # of a batch that a CPU core gets; with fewer its sums take as long
MANY = ("pmap", "shard_map")
PARALLEL = ("auto", "jit", *MANY)
Step = Callable[..., tuple]
Place = Callable[[Any], Any]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Parallel:
    """A step and how its arguments get to its devices."""

    step: Step  # (state, batch) -> (state, metrics)
    place: Place  # this process's rows [B / processes, ...], numpy -> the batch
    replicate: Place  # state made in every process -> the state of process 0 in all


def parallelise(step: Step, how: str, batch_size: int) -> Parallel:
    """Runs a step as `how` on all devices of all processes.

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
        compiled = jax.jit(step, compiler_options=wide_vectors())
        return Parallel(step=compiled, place=jax.device_put, replicate=lambda x: x)
    if batch_size % jax.device_count():
        raise InputError(
            f"batch_size: {batch_size}: expected a multiple of "
            f"{jax.device_count()} devices"
        )
    mesh = Mesh(np.array(jax.devices()), (AXIS,))
    everywhere = NamedSharding(mesh, PartitionSpec())
    replicate = lambda state: _replicate(state, everywhere)  # noqa: E731
    if how == "pmap":  # takes each process's own rows
        mapped = _pmapped(step, everywhere)
        return Parallel(step=mapped, place=jax.device_put, replicate=replicate)
    rows = NamedSharding(mesh, PartitionSpec(AXIS))
    sharded = jax.shard_map(
        lambda state, batch: step(state, batch, axis_name=AXIS),
        mesh=mesh,
        in_specs=(PartitionSpec(), PartitionSpec(AXIS)),
        out_specs=PartitionSpec(),
        # With the check on, the gradient of a replicated input is summed over the
        # axis by itself, and the step's own psum would count twice.
        check_vma=False,
    )
    return Parallel(
        step=jax.jit(sharded, compiler_options=wide_vectors()),
        place=lambda batch: jax.make_array_from_process_local_data(rows, batch),
        replicate=replicate,
    )


def _pmapped(step: Step, everywhere: NamedSharding) -> Step:
    """The step under pmap, which takes this process's rows only.

    It knows no compiler options; XLA chooses the width of vectors.
    """
    mapped = jax.pmap(
        lambda state, batch: step(state, batch, axis_name=AXIS),
        axis_name=AXIS,
        in_axes=(None, 0),
        out_axes=None,
    )
    here = jax.local_device_count()

    def named(leaf: jax.Array) -> jax.Array:
        """Copies on the devices of this process as part of those on all devices."""
        copies = [shard.data for shard in leaf.addressable_shards]
        return jax.make_array_from_single_device_arrays(leaf.shape, everywhere, copies)

    def run(state: object, batch: object) -> tuple:
        split = lambda x: x.reshape(here, x.shape[0] // here, *x.shape[1:])  # noqa: E731
        return jax.tree.map(named, mapped(state, jax.tree.map(split, batch)))

    return run


def _replicate(state: Any, everywhere: NamedSharding) -> Any:  # noqa: ANN401
    """The state of process 0 on every device; typed keys travel as numbers."""
    is_key = lambda x: jnp.issubdtype(x.dtype, jax.dtypes.prng_key)  # noqa: E731
    numbers = jax.tree.map(
        lambda x: np.asarray(jax.random.key_data(x) if is_key(x) else x), state
    )
    numbers = multihost_utils.broadcast_one_to_all(numbers)

    def put(leaf: jax.Array, value: np.ndarray) -> jax.Array:
        made = jax.make_array_from_process_local_data(everywhere, value, value.shape)
        if not is_key(leaf):
            return made
        return jax.random.wrap_key_data(made, impl=jax.random.key_impl(leaf))

    return jax.tree.map(put, state, numbers)


def share_cores(batch_size: int) -> None:
    """Makes JAX count the cores of a CPU as devices, as many as share a batch evenly.

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
    """Resolves "auto": all devices where they share a batch evenly, else the first."""
    many = jax.device_count() > 1 and batch_size % jax.device_count() == 0
    return "shard_map" if many or jax.process_count() > 1 else "jit"


def join_processes(
    coordinator_address: str | None,
    num_processes: int | None,
    process_id: int | None,
) -> None:
    """Connects to the other processes; nothing when all three are None.

    Comes before anything that asks JAX for its devices. Afterwards `jax.devices()`
    are those of all processes, in the order of their numbers. On CPUs the
    processes exchange by gloo.

    Args:
      coordinator_address: host:port that process 0 listens on.
      num_processes: how many processes there are.
      process_id: number of this one.

    Raises:
      InputError: one given without the others, or out of range.
    """
    given = (coordinator_address, num_processes, process_id)
    if given == (None, None, None):
        return
    if coordinator_address is None or num_processes is None or process_id is None:
        raise InputError(
            f"coordinator_address, num_processes, process_id: {given}: "
            "expected all three or none"
        )
    host, _, port = coordinator_address.rpartition(":")
    if not host or not port.isdecimal() or not 1 <= int(port) <= 65535:
        raise InputError(
            f"coordinator_address: {coordinator_address}: expected host:port, "
            "port 1 to 65535"
        )
    if num_processes < 1:
        raise InputError(f"num_processes: {num_processes}: expected >= 1")
    if not 0 <= process_id < num_processes:
        raise InputError(f"process_id: {process_id}: expected 0 to {num_processes - 1}")
    jax.distributed.initialize(coordinator_address, num_processes, process_id)


def is_first() -> bool:
    """True if this process writes what a run writes once."""
    return jax.process_index() == 0


def all_stop_after(step: int) -> bool:
    """True if a process was told to end (SIGTERM): all of them stop at this step.

    Every process calls it after every step.
    """
    return jax.process_count() > 1 and multihost_utils.reached_preemption_sync_point(
        step
    )


@contextlib.contextmanager
def exit_if_peer_lost(step: int) -> Iterator[None]:
    """Exits at once when a collective fails because a peer process died.

    Without the others nothing can be saved or closed: each call would wait for them for
    minutes. The checkpoints hold all that is needed to go on.
    """
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if jax.process_count() == 1:
            raise
        reason = str(error).splitlines()[0][:200]
        sys.stderr.write(
            f"\nerror: step {step}: another process is lost ({reason}): start all of "
            "them again to go on from the last checkpoint\n"
        )
        sys.stderr.flush()
        os._exit(EXIT_LOST)
