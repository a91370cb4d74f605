"""Rows read from a dataset ahead of their use, in a known order.

Reading single rows at random unpacks a block of 256 for each. Here every block is
unpacked once, its rows wait in memory for their turn, and a thread does that for
some batches ahead.
"""

import queue
import threading
import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any, Generic, TypeVar

import jax
import numpy as np

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.data.store.rows import row_spec
from rcirl_jax.types import Demonstration

READ_ROWS = 4096  # rows read at a time at most, so that reading needs little memory

T = TypeVar("T")


class RowStream:
    """Rows of a dataset in a given order, `size` at a time.

    Rows of a block are read when the first of them is due, in one piece, and each
    is forgotten once it has been given. Memory is what the order demands, known
    beforehand and allocated once.
    """

    def __init__(
        self, dataset: Demonstrations, rows: np.ndarray, blocks: np.ndarray, size: int
    ) -> None:
        """Plan the reads.

        Args:
          dataset: the open dataset.
          rows: [m] row numbers in the order of use, repeats allowed.
          blocks: [m] number of the block that each of them lies in.
          size: rows given at a time; divides m.
        """
        self._dataset, self._rows, self._size = dataset, rows, size
        first = np.zeros(int(blocks.max()) + 1, np.int64)
        first[blocks[::-1]] = np.arange(blocks.size)[::-1]  # the last written stays
        due = (first // size)[blocks]  # turn in which the row is read
        self._by_turn = np.argsort(due, kind="stable")
        loaded = np.cumsum(np.bincount(due, minlength=rows.size // size))
        self._bounds = np.concatenate([[0], loaded])
        self.capacity = int(np.max(loaded - size * np.arange(loaded.size)))
        self._held: Demonstration | None = None  # allocated when the first row is due
        self._slot = np.empty(rows.size, np.int32)  # where a row in memory stands
        self._free = np.arange(self.capacity, dtype=np.int32)
        self._turn = 0

    def __iter__(self) -> "RowStream":
        return self

    def __next__(self) -> Demonstration:
        turn, size = self._turn, self._size
        if self._held is None:
            self._held = self._allocated()
        if turn * size >= self._rows.size:
            raise StopIteration
        new = self._by_turn[self._bounds[turn] : self._bounds[turn + 1]]
        new = new[np.argsort(self._rows[new], kind="stable")]
        for start in range(0, new.size, READ_ROWS):
            self._read(new[start : start + READ_ROWS])
        slots = self._slot[turn * size : (turn + 1) * size]
        given = jax.tree.map(lambda leaf: leaf[slots], self._held)
        self._free = np.concatenate([self._free, slots])
        self._turn += 1
        return given

    def _allocated(self) -> Demonstration:
        """Room for the rows in memory."""
        room = lambda leaf: np.empty((self.capacity, *leaf.shape), leaf.dtype)  # noqa: E731
        return jax.tree.map(room, row_spec())

    def _read(self, places: np.ndarray) -> None:
        slots, self._free = np.split(self._free, [places.size])
        self._slot[places] = slots
        found = self._dataset.read(self._rows[places])
        for leaf, values in zip(
            jax.tree.leaves(self._held), jax.tree.leaves(found), strict=True
        ):
            leaf[slots] = values


class Prefetch(Generic[T]):
    """Calls a function in a thread, a bounded number of results ahead.

    `waited_s` is the time that `next` spent waiting for results.
    """

    def __init__(self, produce: Callable[[], T], depth: int) -> None:
        """Start producing.

        Args:
          produce: gives the next result; StopIteration ends, any other exception
            reaches the caller in its turn.
          depth: finished results that may wait, >= 1.
        """
        self._results: queue.Queue[tuple[bool, Any]] = queue.Queue(depth)
        self._stopped = threading.Event()
        self._produce = produce
        self.waited_s = 0.0
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stopped.is_set():
            try:
                result = (True, self._produce())
            except BaseException as error:
                result = (False, error)
            while not self._stopped.is_set():
                try:
                    self._results.put(result, timeout=0.1)
                    break
                except queue.Full:
                    continue
            if not result[0]:
                return

    def __iter__(self) -> Iterator[T]:
        return self

    def __next__(self) -> T:
        begin = time.perf_counter()
        fine, result = self._results.get()
        self.waited_s += time.perf_counter() - begin
        if not fine:
            self._results.put((fine, result))
            raise result
        return result

    def __enter__(self) -> "Prefetch[T]":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stopped.set()
        self._thread.join()
