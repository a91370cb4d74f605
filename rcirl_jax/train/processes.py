"""Several processes, perhaps on several machines, as one training."""

import contextlib
import os
import sys
from collections.abc import Iterator

import jax
from jax.experimental import multihost_utils

from rcirl_jax.errors import InputError

EXIT_LOST = 2  # status of a process that lost another, as of other lost work


def join_processes(
    coordinator_address: str | None,
    num_processes: int | None,
    process_id: int | None,
) -> None:
    """Connect to the other processes; nothing when all three are None.

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
    """Whether this process writes what a run writes once."""
    return jax.process_index() == 0


def all_stop_after(step: int) -> bool:
    """Whether a process was told to end (SIGTERM), and all of them stop at this step.

    Every process calls it after every step.
    """
    return jax.process_count() > 1 and multihost_utils.reached_preemption_sync_point(
        step
    )


@contextlib.contextmanager
def with_the_others(step: int) -> Iterator[None]:
    """What all processes do together; if one of them is lost, this one ends at once.

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
