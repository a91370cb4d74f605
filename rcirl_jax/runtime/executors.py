"""Executors of independent pieces of work: here, in processes, on a Ray cluster.

A piece is an item; `function(item)` yields its results. Every executor gives the
results of all items in the order of the items, so what comes out does not depend
on where it was made. Pieces have to be idempotent: one that is lost with its
process or node is done again.

Ray does the scheduling, the transport and the retries; this module only keeps
the order and bounds what is in flight. Processes are the standard library's: loky's,
and so joblib's, outlive a killed parent, do no lost piece again and start a third
slower.
"""

import concurrent.futures as futures
import importlib
import multiprocessing
import os
import signal
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from multiprocessing.synchronize import Barrier
from typing import Protocol, TypeVar

from rcirl_jax.errors import InputError, LostWorkError

EXECUTORS = ("local", "ray")
AHEAD = 2  # pieces in flight per worker: one running, one waiting
REACH_S = 5.0  # s, for the head of a cluster to answer
RETRIES = 10  # of a piece whose node or process is lost, on a cluster
ATTEMPTS = 3  # pools tried before a piece that kills its process is given up

Item = TypeVar("Item")
Result = TypeVar("Result")


class Executor(Protocol):
    """Runs pieces; `workers` is how many can run at once."""

    @property
    def workers(self) -> int:
        """Pieces that run side by side."""
        ...

    def stream(
        self, function: Callable[[Item], Iterable[Result]], items: Iterable[Item]
    ) -> Iterator[Result]:
        """Yields the results of all items, in their order.

        Raises:
          LostWorkError: a piece was lost with its process or node again and again.
        """
        ...


class Serial:
    """In this process, one after the other; results as they come."""

    workers = 1

    def stream(
        self, function: Callable[[Item], Iterable[Result]], items: Iterable[Item]
    ) -> Iterator[Result]:
        """Yields the results of all items, in their order."""
        for item in items:
            yield from function(item)


class Processes:
    """In processes of this machine, on its CPUs. Items, results, function are sent."""

    def __init__(self, workers: int) -> None:
        self.workers = workers
        # kept from stream to stream: what a process has compiled stays compiled
        self._pool: futures.ProcessPoolExecutor | None = None

    def stream(
        self, function: Callable[[Item], Iterable[Result]], items: Iterable[Item]
    ) -> Iterator[Result]:
        """Yields the results of all items, in their order.

        Raises:
          LostWorkError: a piece killed its process ATTEMPTS times (out of memory).
        """
        source, failures = iter(items), 0
        waiting: deque[Item] = deque()  # items without a result
        running: deque[futures.Future] = deque()  # of the first of them
        try:
            while True:
                # after a loss one piece at a time, so that the guilty one is known
                width = 1 if failures else self.workers * AHEAD
                waiting.extend(islice(source, max(width - len(waiting), 0)))
                if not waiting:
                    return
                self._pool = self._pool or _started(self.workers)
                try:
                    for item in islice(waiting, len(running), width):
                        running.append(self._pool.submit(_listed, function, item))
                    results = running.popleft().result()
                except BrokenProcessPool as error:
                    self._pool, failures = None, failures + 1
                    running.clear()
                    if failures < ATTEMPTS:
                        continue
                    raise LostWorkError(
                        f"{_name(waiting[0])}: its process was killed {failures} "
                        "times: expected enough memory; use fewer workers"
                    ) from error
                failures = 0
                waiting.popleft()
                yield from results
        finally:
            for future in running:
                future.cancel()


def _started(workers: int) -> futures.ProcessPoolExecutor:
    """Starts a pool and all its processes.

    Spawned, since a fork of a process that runs JAX's threads can hang. All of them
    before any piece: a pool (of Python 3.11) that starts one while it finds another
    killed loses its own thread.
    """
    spawn = multiprocessing.get_context("spawn")
    pool = futures.ProcessPoolExecutor(
        workers,
        mp_context=spawn,
        initializer=_as_worker,
        initargs=(spawn.Barrier(workers),),
    )
    for _ in range(workers):
        pool.submit(os.getpid)
    return pool


def _as_worker(all_started: Barrier) -> None:
    """Computes on the CPU, and no longer than the process that started this one lives.

    Numbers must not depend on an accelerator, nor processes fight over one. A parent
    that is killed cannot tell its workers to end: each waits for that itself.

    Args:
      all_started: met by every worker of the pool before its first piece.
    """
    os.environ["JAX_PLATFORMS"] = "cpu"
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a terminal: the parent decides
    parent = multiprocessing.parent_process()

    def end_with_parent() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    all_started.wait()


class Ray:
    """On a Ray cluster. Every node needs this package and sees the same files."""

    def __init__(self, address: str) -> None:
        try:
            self._ray = importlib.import_module("ray")
        except ImportError as error:
            raise InputError(
                "ray: not installed: expected pip install 'rcirl-jax[ray]'"
            ) from error
        if not self._ray.is_initialized():
            self._connect(address)
        cpus = self._ray.cluster_resources().get("CPU", 1.0)
        self.workers = max(int(cpus), 1)

    def _connect(self, address: str) -> None:
        # numbers must not depend on which accelerator a node has
        environment = {"env_vars": {"JAX_PLATFORMS": "cpu"}}
        try:
            host, _, port = address.rpartition(":")
            if port.isdigit() and "/" not in host:  # Ray itself would try for minutes
                socket.create_connection((host, int(port)), REACH_S).close()
            self._ray.init(
                address=address,
                runtime_env=environment,
                log_to_driver=False,
                logging_level="ERROR",
            )
        except (OSError, RuntimeError, ValueError) as error:
            raise InputError(
                f"ray_address: {address}: {error}: expected a running cluster"
            ) from error

    def stream(
        self, function: Callable[[Item], Iterable[Result]], items: Iterable[Item]
    ) -> Iterator[Result]:
        """Yields the results of all items, in their order; lost pieces are done again.

        Raises:
          LostWorkError: a piece was lost RETRIES times.
        """
        # where nodes or processes are lost; errors of the function, which would
        # come again, are not retried
        remote = self._ray.remote(max_retries=RETRIES)(_listed)
        shared, folder = self._ray.put(function), os.getcwd()
        source, running = iter(items), deque()
        while True:
            room = self.workers * AHEAD - len(running)
            for item in islice(source, max(room, 0)):
                running.append((_name(item), remote.remote(shared, item, folder)))
            if not running:
                return
            yield from self._result(*running.popleft())

    def _result(self, name: str, reference: object) -> list:
        """Returns the value, or raises the function's own error in place of Ray's."""
        try:
            return self._ray.get(reference)
        except self._ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, Exception):
                raise error.cause from None
            raise
        except self._ray.exceptions.RayError as error:
            raise LostWorkError(
                f"{name}: lost {RETRIES} times ({type(error).__name__}): expected "
                "nodes with enough memory that stay up"
            ) from error


def _listed(
    function: Callable[[Item], Iterable[Result]], item: Item, folder: str | None = None
) -> list[Result]:
    """Runs a piece; from `folder`, relative paths mean the same files on every node."""
    if folder is not None:
        os.chdir(folder)
    return list(function(item))


def _name(item: object) -> str:
    """A piece in a message: its input file, if it has one."""
    while isinstance(item, tuple) and item:
        item = item[0]
    return str(getattr(item, "input", item))[:200]


def two_at_a_time(
    work: Callable[[Item], Result], items: Iterable[Item]
) -> list[Result]:
    """Does `work` of every item in two threads of this process; in their order.

    For work that compiles longer than it computes: one compiles, another computes.
    """
    with futures.ThreadPoolExecutor(2) as pool:
        return list(pool.map(work, items))


def make_executor(
    name: str, *, workers: int = 1, ray_address: str = "auto"
) -> Executor:
    """Makes an executor.

    Args:
      name: one of EXECUTORS.
      workers: processes at once, of "local".
      ray_address: of the cluster's head, of "ray".

    Raises:
      InputError: unknown name, fewer than one worker, no Ray or no cluster.
    """
    if name not in EXECUTORS:
        raise InputError(f"executor: {name}: expected one of {EXECUTORS}")
    if workers < 1:
        raise InputError(f"workers: {workers}: expected at least 1")
    if name == "ray":
        return Ray(ray_address)
    return Serial() if workers == 1 else Processes(workers)
