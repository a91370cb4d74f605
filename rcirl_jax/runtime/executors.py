"""Where independent pieces of work run: here, in other processes, on a Ray cluster.

A piece is an item; `function(item)` yields its results. Every executor gives the
results of all items in the order of the items, so what comes out does not depend
on where it was made. Pieces have to be idempotent: one that is lost with its
process or node is done again.

Ray does the scheduling, the transport and the retries; this module only keeps
the order and bounds what is in flight. Processes are the standard library's, because
loky's outlive a killed parent, do no lost piece again and start a third slower.
"""

import collections
import concurrent.futures as futures
import importlib
import itertools
import multiprocessing
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.synchronize import Barrier
from typing import Any, Protocol, TypeVar

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
        """Results of all items, in their order."""
        ...


class Here:
    """In this process, one after the other; results as they come."""

    workers = 1

    def stream(
        self, function: Callable[[Item], Iterable[Result]], items: Iterable[Item]
    ) -> Iterator[Result]:
        """Results of all items, in their order."""
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
        """Results of all items, in their order.

        Raises:
          LostWorkError: a piece killed its process ATTEMPTS times (out of memory).
        """
        rest: collections.deque[Item] = collections.deque()
        source, failures = iter(items), 0
        while True:
            # after a loss one piece at a time, so that the guilty one is known
            width = self.workers * AHEAD if failures == 0 else 1
            try:
                for result in self._results(function, source, rest, width):
                    failures = 0
                    yield from result
                    if width == 1:
                        break
                else:
                    return
            except BrokenProcessPool as error:
                failures += 1
                if failures >= ATTEMPTS:
                    raise LostWorkError(
                        f"{_name(rest[0])}: its process was killed {failures} times: "
                        "expected enough memory; use fewer --workers"
                    ) from error

    def _results(
        self,
        function: Callable[[Item], Iterable[Result]],
        source: Iterator[Item],
        rest: "collections.deque[Item]",
        width: int,
    ) -> Iterator[list[Result]]:
        """Work off `rest`, then `source`; `rest` keeps what has no result yet."""
        if self._pool is None:
            # forking a process that runs JAX's threads can hang
            start = multiprocessing.get_context("spawn")
            self._pool = futures.ProcessPoolExecutor(
                self.workers,
                mp_context=start,
                initializer=_as_worker,
                initargs=(start.Barrier(self.workers),),
            )
            # all processes before any piece: a pool (of Python 3.11) that starts one
            # while it finds another killed loses its own thread
            for _ in range(self.workers):
                self._pool.submit(os.getpid)
        pool = self._pool
        running: collections.deque[futures.Future] = collections.deque()
        try:
            while True:
                for item in itertools.islice(source, max(width - len(rest), 0)):
                    rest.append(item)
                for item in itertools.islice(rest, len(running), width):
                    running.append(pool.submit(_listed, function, item))
                if not running:
                    return
                result = running.popleft().result()
                rest.popleft()
                yield result
        except BrokenProcessPool:
            self._pool = None
            raise
        finally:
            for future in running:
                future.cancel()


def _as_worker(all_started: Barrier) -> None:
    """On the CPU, and no longer than the process that started this one.

    Numbers must not depend on an accelerator, nor processes fight over one. A parent
    that is killed cannot tell its workers to end: each waits for that itself.

    Args:
      all_started: met by every worker of the pool before its first piece.
    """
    os.environ["JAX_PLATFORMS"] = "cpu"
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a terminal: the parent decides
    parent = multiprocessing.parent_process()

    def outlive_nobody() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=outlive_nobody, daemon=True).start()
    all_started.wait()


def _listed_in(
    folder: str, function: Callable[[Item], Iterable[Result]], item: Item
) -> list[Result]:
    """As from `folder`, so that relative paths mean the same files on every node."""
    os.chdir(folder)
    return _listed(function, item)


def _listed(function: Callable[[Item], Iterable[Result]], item: Item) -> list[Result]:
    return list(function(item))


def _name(item: object) -> str:
    """A piece in a message: its input file, if it has one."""
    first = item[0] if isinstance(item, tuple) and item else item
    return str(getattr(first, "input", first))[:200]


class Ray:
    """On a Ray cluster. Every node needs this package and sees the same files."""

    def __init__(self, address: str) -> None:
        try:
            self._ray = importlib.import_module("ray")
        except ImportError as error:
            raise InputError(
                "--executor: ray: not installed: expected pip install 'rcirl-jax[ray]'"
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
                f"--ray_address: {address}: {error}: expected a running cluster"
            ) from error

    def stream(
        self, function: Callable[[Item], Iterable[Result]], items: Iterable[Item]
    ) -> Iterator[Result]:
        """Results of all items, in their order; lost pieces are done again."""
        # where nodes or processes are lost; errors of the function, which would
        # come again, are not retried
        remote = self._ray.remote(max_retries=RETRIES)(_listed_in)
        shared, folder = self._ray.put(function), os.getcwd()
        source, running = iter(items), collections.deque()
        while True:
            room = self.workers * AHEAD - len(running)
            for item in itertools.islice(source, max(room, 0)):
                running.append((_name(item), remote.remote(folder, shared, item)))
            if not running:
                return
            yield from self._result(*running.popleft())

    def _result(self, name: str, reference: Any) -> list:  # noqa: ANN401
        """The value, or the function's own error in place of Ray's."""
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


def two_at_a_time(
    work: Callable[[Item], Result], items: Iterable[Item]
) -> list[Result]:
    """`work` of every item in their order, in two threads of this process.

    For work that compiles longer than it computes: one compiles, another computes.
    """
    with futures.ThreadPoolExecutor(2) as pool:
        return list(pool.map(work, items))


def make_executor(
    name: str, *, workers: int = 1, ray_address: str = "auto"
) -> Executor:
    """The executor of the flags --executor, --workers, --ray_address.

    Raises:
      InputError: unknown name, fewer than one worker, no Ray or no cluster.
    """
    if name not in EXECUTORS:
        raise InputError(f"--executor: {name}: expected one of {EXECUTORS}")
    if workers < 1:
        raise InputError(f"--workers: {workers}: expected at least 1")
    if name == "ray":
        return Ray(ray_address)
    return Here() if workers == 1 else Processes(workers)
