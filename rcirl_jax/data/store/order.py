"""Batches: seeded, endless, resumable to the bit, shared between processes."""

import concurrent.futures
import dataclasses
import math
from collections.abc import Mapping

import jax
import numpy as np

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.data.store.rows import leaf_specs
from rcirl_jax.data.store.stream import RowStream
from rcirl_jax.errors import InputError
from rcirl_jax.types import Demonstration

# blocks over which rows are mixed; it decides the order, so it is no setting.
# Half of them are in memory at a time: 32,768 rows, 340 MB.
WINDOW_BLOCKS = 256
PLAN_AHEAD = 0.1  # share of an epoch before whose end the next one is planned
ROW_BYTES = sum(math.prod(x.shape) * x.dtype.itemsize for x in leaf_specs().values())


def epoch_order(seed: int, epoch: int, blocks: np.ndarray) -> np.ndarray:
    """[n] the order in which an epoch visits n rows.

        key(row) = place(block of row) + WINDOW_BLOCKS * u(row),   u ~ U(0, 1)

    sorted by key, `place` being a permutation of the blocks: a window slides over
    shuffled blocks, so that a block is needed for a while, once an epoch. Rows of
    a batch come from WINDOW_BLOCKS blocks, fewer at both ends of an epoch. When
    there are no more blocks than that, the order is a permutation of all rows.

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


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Epoch:
    """The plan of an epoch: its order, and what reads it from disk."""

    order: np.ndarray  # [n] which of the chosen rows are visited
    stream: RowStream | None  # from the position on that it was planned for


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
    """Batches of a split, named by their rows in the dataset.

    A split of at most `in_memory_mb` MiB is loaded, a larger one is read as the
    batches need it: the batches are the same to the bit.
    """
    index = dataset.indices(split)
    blocks = dataset.blocks(index)
    small = index.size * ROW_BYTES <= in_memory_mb * 2**20
    return BatchIterator(
        dataset.load(split) if small else dataset,
        indices=None if small else index,
        blocks=blocks,
        numbers=index,
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
        *,
        batch_size: int,
        seed: int,
        indices: np.ndarray | None = None,
        blocks: np.ndarray | None = None,
        numbers: np.ndarray | None = None,
        shard_index: int = 0,
        num_shards: int = 1,
    ) -> None:
        """Start at epoch 0, position 0.

        Args:
          rows: Demonstration with numpy leaves [n, ...], or an open dataset, which
            is read as the batches need it.
          batch_size: rows of a batch over all processes.
          seed: of the order of rows, >= 0.
          indices: [m] row numbers to visit, e.g. `dataset.indices("train")`;
            all rows when absent.
          blocks: [m] block of each row to visit; the dataset's own when absent,
            and one for all rows in memory. Equal blocks, equal order.
          numbers: [m] what `next` calls each row to visit; `indices` when absent.
          shard_index: number of this process.
          num_shards: number of processes; divides `batch_size`.

        Raises:
          InputError: no rows, or a size or seed out of range.
        """
        self._rows = rows
        stored = not isinstance(rows, Demonstration)
        total = rows.indices(None).size if stored else rows.vehicle.shape[0]
        self._chosen = np.arange(total) if indices is None else np.asarray(indices)
        if blocks is None:
            alone = np.zeros(self._chosen.size, np.int64)
            blocks = rows.blocks(self._chosen) if stored else alone
        self._blocks = np.unique(blocks, return_inverse=True)[1].astype(np.int32)
        self._numbers = self._chosen if numbers is None else numbers
        if self._chosen.size == 0:
            raise InputError("batches: rows: 0: expected at least one scene")
        if batch_size < 1 or num_shards < 1 or batch_size % num_shards:
            raise InputError(
                f"batches: batch_size: {batch_size}: expected a positive multiple "
                f"of the number of processes, {num_shards}"
            )
        if not 0 <= shard_index < num_shards:
            raise InputError(
                f"batches: shard_index: {shard_index}: expected 0 to {num_shards - 1}"
            )
        if seed < 0:
            raise InputError(f"batches: seed: {seed}: expected >= 0")
        self._batch_size, self._seed = batch_size, seed
        local = batch_size // num_shards
        self._part = np.arange(shard_index * local, (shard_index + 1) * local)
        self._epoch = self._position = 0
        self._plan: _Epoch | None = None
        self._planner = concurrent.futures.ThreadPoolExecutor(1)
        self._later: concurrent.futures.Future[_Epoch] | None = None

    @property
    def batches_per_epoch(self) -> int:
        """Batches of one epoch, the padded one included."""
        return -(-self._chosen.size // self._batch_size)

    def state(self) -> dict[str, int]:
        """Where the next batch stands; JSON-ready, the same in every process."""
        return {"epoch": self._epoch, "position": self._position, "seed": self._seed}

    def restore(self, state: Mapping[str, int]) -> None:
        """Continue as the iterator that gave `state` would have.

        Raises:
          InputError: the state is of another seed, or lies outside an epoch of
            these rows.
        """
        missing = sorted({"epoch", "position", "seed"} - set(state))
        if missing:
            raise InputError(
                f"batches: state: {missing[0]}: missing: expected a number"
            )
        if state["seed"] != self._seed:
            raise InputError(
                f"batches: state: seed: {state['seed']}: expected {self._seed}"
            )
        inside = 0 <= state["position"] < self.batches_per_epoch
        if not inside or state["epoch"] < 0:
            raise InputError(
                f"batches: state: epoch {state['epoch']}, position "
                f"{state['position']}: expected a position below "
                f"{self.batches_per_epoch}: same dataset and batch size"
            )
        self._epoch, self._position = int(state["epoch"]), int(state["position"])
        self._plan = self._later = None

    def __iter__(self) -> "BatchIterator":
        return self

    def __next__(self) -> tuple[Demonstration, np.ndarray, np.ndarray]:
        plan = self._plan or self._planned(self._epoch, self._position)
        self._plan = plan
        places = self._position * self._batch_size + self._part
        visited = self._visited(plan.order, places)
        weight = (places < self._chosen.size).astype(np.float32)
        batch = self._take(plan, self._chosen[visited])
        self._position += 1
        if self._position == self.batches_per_epoch:
            self._epoch, self._position = self._epoch + 1, 0
            self._plan = self._later.result() if self._later else None
            self._later = None
        elif self._later is None and self._is_late():
            # the step need not wait for the plan of the next epoch
            self._later = self._planner.submit(self._planned, self._epoch + 1, 0)
        return batch, weight, self._numbers[visited]

    def _is_late(self) -> bool:
        return self._position >= (1.0 - PLAN_AHEAD) * self.batches_per_epoch

    def _visited(self, order: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Which of the chosen rows stand at some places of an epoch's order."""
        return order[places % self._chosen.size]

    def _planned(self, epoch: int, position: int) -> _Epoch:
        """An epoch, to be read from a position on."""
        order, stream = epoch_order(self._seed, epoch, self._blocks), None
        if not isinstance(self._rows, Demonstration):
            batches = np.arange(position, self.batches_per_epoch)
            places = batches[:, None] * self._batch_size + self._part
            ahead = self._visited(order, places.reshape(-1))
            stream = RowStream(
                self._rows, self._chosen[ahead], self._blocks[ahead], self._part.size
            )
        return _Epoch(order=order, stream=stream)

    def _take(self, plan: _Epoch, index: np.ndarray) -> Demonstration:
        if isinstance(self._rows, Demonstration):
            return jax.tree.map(lambda leaf: leaf[index], self._rows)
        assert plan.stream is not None
        return next(plan.stream)
