"""Batches: seeded, endless, resumable to the bit, shared between processes.

Rows in memory are taken by number. Rows on disk are read ahead in the order of their
use: reading single rows at random would unpack a block of 256 for each, so every block
is unpacked once, and its rows wait in memory for their turn.
"""

import collections
import math
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Generic, TypeVar

import jax
import numpy as np

from rcirl_jax.data.store.dataset import Demonstrations
from rcirl_jax.data.store.rows import leaf_specs, row_spec
from rcirl_jax.errors import InputError
from rcirl_jax.types import Demonstration

# blocks over which rows are mixed; it decides the order, so it is no setting.
# Half of them are in memory at a time: 32,768 rows, 340 MB.
WINDOW_BLOCKS = 256
READ_ROWS = 4096  # rows read at a time at most, so that reading needs little memory
ROW_BYTES = sum(math.prod(x.shape) * x.dtype.itemsize for x in leaf_specs().values())

T = TypeVar("T")


def epoch_order(seed: int, epoch: int, blocks: np.ndarray) -> np.ndarray:
    """Returns the order [n] in which an epoch visits n rows.

        key(row) = place(block of row) + WINDOW_BLOCKS * u(row),   u ~ U(0, 1)

    sorted by key, `place` being a permutation of the blocks: a window slides over
    shuffled blocks, so that a block is needed for a while, once an epoch.

    Args:
      seed: of the run.
      epoch: number of the epoch.
      blocks: [n] number of each row's block, from 0 without gaps.
    """
    rng, count = np.random.default_rng([seed, epoch]), int(blocks.max()) + 1
    if count <= WINDOW_BLOCKS:
        return rng.permutation(blocks.size)
    key = rng.permutation(count)[blocks] + WINDOW_BLOCKS * rng.random(blocks.size)
    return np.argsort(key, kind="stable")


class RowStream:
    """Rows of a dataset in a given order, `size` at a time.

    Rows of a block are read when the first of them is due, in one piece, and each
    is forgotten once it has been given. Memory is what the order demands, known
    beforehand and allocated once.

    Args:
      dataset: the open dataset.
      rows: [m] row numbers in the order of use, repeats allowed.
      blocks: [m] number of the block that each of them lies in.
      size: rows given at a time; divides m.
    """

    def __init__(
        self, dataset: Demonstrations, rows: np.ndarray, blocks: np.ndarray, size: int
    ) -> None:
        self._dataset, self._rows, self._size = dataset, rows, size
        first = np.zeros(int(blocks.max()) + 1, np.int64)
        first[blocks[::-1]] = np.arange(blocks.size)[::-1]  # the last written stays
        due = (first // size)[blocks]  # turn in which the row is read
        self._by_turn = np.argsort(due, kind="stable")
        loaded = np.cumsum(np.bincount(due, minlength=rows.size // size))
        self._bounds = np.concatenate([[0], loaded])
        self.capacity = int(np.max(loaded - size * np.arange(loaded.size)))
        self._slot = np.empty(rows.size, np.int32)  # where a row in memory stands
        self._free = np.arange(self.capacity, dtype=np.int32)
        self._held: Demonstration | None = None  # the rows in memory, [capacity, ...]
        self._turn = 0

    def __next__(self) -> Demonstration:
        turn, size = self._turn, self._size
        if self._held is None:
            self._held = jax.tree.map(
                lambda leaf: np.empty((self.capacity, *leaf.shape), leaf.dtype),
                row_spec(),
            )
        new = self._by_turn[self._bounds[turn] : self._bounds[turn + 1]]
        new = new[np.argsort(self._rows[new], kind="stable")]
        for start in range(0, new.size, READ_ROWS):
            places = new[start : start + READ_ROWS]
            slots, self._free = np.split(self._free, [places.size])
            self._slot[places] = slots
            found = self._dataset.read(self._rows[places])
            for leaf, values in zip(
                jax.tree.leaves(self._held), jax.tree.leaves(found), strict=True
            ):
                leaf[slots] = values
        slots = self._slot[turn * size : (turn + 1) * size]
        given = jax.tree.map(lambda leaf: leaf[slots], self._held)
        self._free = np.concatenate([self._free, slots])
        self._turn += 1
        return given


def split_batches(
    dataset: Demonstrations,
    split: str,
    *,
    in_memory_mb: float,
    batch_size: int,
    seed: int,
    shard_index: int = 0,
    num_shards: int = 1,
) -> "BatchIterator":
    """Returns batches of a split, named by their rows in the dataset.

    A split of at most `in_memory_mb` MiB is loaded, a larger one is read as the
    batches need it: the batches are the same to the bit.
    """
    index = dataset.indices(split)
    small = index.size * ROW_BYTES <= in_memory_mb * 2**20
    return BatchIterator(
        dataset.load(split) if small else dataset,
        index,
        dataset.blocks(index),
        batch_size=batch_size,
        seed=seed,
        shard_index=shard_index,
        num_shards=num_shards,
    )


class BatchIterator:
    """Endless batches over rows in memory or on disk.

    Epoch e visits the rows in `epoch_order(seed, e, blocks)`: any position can be
    computed without the ones before it, so the whole state is three integers. The
    last batch of an epoch is filled up with rows of the epoch's beginning at
    weight 0. With `num_shards` processes, each is given its contiguous part of the
    same global batches, whatever their number, and holds no other rows in memory.

    `next` gives (batch, weight, index): numpy rows `[b, ...]`; float32 `[b]`, 1
    for a row and 0 for padding; int64 `[b]`, row numbers; with
    b = batch_size / num_shards.
    """

    def __init__(
        self,
        rows: Demonstration | Demonstrations,
        numbers: np.ndarray,
        blocks: np.ndarray,
        *,
        batch_size: int,
        seed: int,
        shard_index: int = 0,
        num_shards: int = 1,
    ) -> None:
        """Starts at epoch 0, position 0.

        Args:
          rows: those to visit, numpy leaves [m, ...], or the dataset, read as needed.
          numbers: [m] their numbers in the dataset.
          blocks: [m] block of each. Equal blocks, equal order.
          batch_size: rows of a batch over all processes.
          seed: of the order of rows, >= 0.
          shard_index: number of this process.
          num_shards: number of processes; divides `batch_size`.
        """
        self._rows, self._numbers = rows, numbers
        self._blocks = np.unique(blocks, return_inverse=True)[1].astype(np.int32)
        if numbers.size == 0:
            raise InputError("batches: rows: 0: expected at least one scene")
        if batch_size < 1 or batch_size % num_shards or seed < 0:
            raise InputError(
                f"batches: batch_size: {batch_size}, seed: {seed}: expected a positive "
                f"multiple of the number of processes, {num_shards}, and a seed >= 0"
            )
        self._batch_size, self._seed = batch_size, seed
        local = batch_size // num_shards
        self._part = np.arange(shard_index * local, (shard_index + 1) * local)
        self._epoch = self._position = 0
        self._order: np.ndarray | None = None  # of the epoch's rows, once planned
        self._stream: RowStream | None = None  # that reads them from disk

    @property
    def batches_per_epoch(self) -> int:
        """Batches of one epoch, the padded one included."""
        return -(-self._numbers.size // self._batch_size)

    def state(self) -> dict[str, int]:
        """Returns where the next batch stands; JSON-ready, equal in every process."""
        return {"epoch": self._epoch, "position": self._position, "seed": self._seed}

    def restore(self, state: Mapping[str, int]) -> None:
        """Continues as the iterator that gave `state` would have.

        Raises:
          InputError: the state is of another seed, or lies outside an epoch of
            these rows.
        """
        epoch, position = state.get("epoch", -1), state.get("position", -1)
        inside = epoch >= 0 and 0 <= position < self.batches_per_epoch
        if not inside or state.get("seed") != self._seed:
            raise InputError(
                f"batches: state: {dict(state)}: expected the seed {self._seed} and a "
                f"position below {self.batches_per_epoch}: same dataset and batch size"
            )
        self._epoch, self._position = int(epoch), int(position)
        self._order = None

    def __iter__(self) -> "BatchIterator":
        return self

    def __next__(self) -> tuple[Demonstration, np.ndarray, np.ndarray]:
        count, size = self._numbers.size, self._batch_size
        if self._order is None:
            self._order = epoch_order(self._seed, self._epoch, self._blocks)
            if not isinstance(self._rows, Demonstration):
                rest = np.arange(self._position, self.batches_per_epoch)
                places = (rest[:, None] * size + self._part).reshape(-1)
                ahead = self._order[places % count]
                self._stream = RowStream(
                    self._rows,
                    self._numbers[ahead],
                    self._blocks[ahead],
                    self._part.size,
                )
        places = self._position * size + self._part
        visited = self._order[places % count]
        if isinstance(self._rows, Demonstration):
            batch = jax.tree.map(lambda leaf: leaf[visited], self._rows)
        else:
            assert self._stream is not None
            batch = next(self._stream)
        self._position += 1
        if self._position == self.batches_per_epoch:
            self._epoch, self._position, self._order = self._epoch + 1, 0, None
        return batch, (places < count).astype(np.float32), self._numbers[visited]


class Prefetch(Generic[T]):
    """Calls a function in a thread, a bounded number of results ahead.

    Args:
      produce: gives the next result; StopIteration ends, any other exception reaches
        the caller in its turn.
      depth: finished results that may wait, >= 1.

    `waited_s` is the time that `next` spent waiting for results.
    """

    def __init__(self, produce: Callable[[], T], depth: int) -> None:
        self._produce, self._thread = produce, ThreadPoolExecutor(1)
        self._ahead = collections.deque(
            self._thread.submit(produce) for _ in range(depth + 1)
        )
        self.waited_s = 0.0

    def __iter__(self) -> Iterator[T]:
        return self

    def __next__(self) -> T:
        begin = time.perf_counter()
        try:
            result = self._ahead[0].result()  # an end or failure stays the first
        finally:
            self.waited_s += time.perf_counter() - begin
        self._ahead.popleft()
        self._ahead.append(self._thread.submit(self._produce))
        return result

    def __enter__(self) -> "Prefetch[T]":
        return self

    def __exit__(self, *_: object) -> None:
        self._thread.shutdown(cancel_futures=True)
