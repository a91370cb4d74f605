"""Batches: seeded, endless, resumable to the bit, shared between processes."""

from collections.abc import Mapping

import jax
import numpy as np

from rcirl_jax.data.store import Dataset
from rcirl_jax.errors import InputError
from rcirl_jax.types import Demonstration


class BatchIterator:
    """Endless batches over rows in memory or on disk.

    Epoch e visits the rows in the order `default_rng([seed, e]).permutation(n)`:
    any position can be computed without the ones before it, so the whole state
    is three integers. The last batch of an epoch is filled up with rows of the
    epoch's beginning at weight 0. With `num_shards` processes, each is given its
    contiguous part of the same global batches, whatever their number.

    `next` gives (batch, weight, index): numpy rows `[b, ...]`; float32 `[b]`, 1
    for a row and 0 for padding; int64 `[b]`, row numbers inside `rows`; with
    b = batch_size / num_shards.
    """

    def __init__(
        self,
        rows: Demonstration | Dataset,
        *,
        batch_size: int,
        seed: int,
        indices: np.ndarray | None = None,
        shard_index: int = 0,
        num_shards: int = 1,
    ) -> None:
        """Start at epoch 0, position 0.

        Args:
          rows: Demonstration with numpy leaves [n, ...], or an open Dataset, which
            is read batch by batch.
          batch_size: rows of a batch over all processes.
          seed: of the order of rows, >= 0.
          indices: [m] row numbers to visit, e.g. `dataset.indices("train")`;
            all rows when absent.
          shard_index: number of this process.
          num_shards: number of processes; divides `batch_size`.

        Raises:
          InputError: no rows, or a size or seed out of range.
        """
        self._rows = rows
        total = rows.count if isinstance(rows, Dataset) else rows.vehicle.shape[0]
        self._chosen = np.arange(total) if indices is None else np.asarray(indices)
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
        self._part = slice(shard_index * local, (shard_index + 1) * local)
        self._epoch = self._position = 0
        self._order: tuple[int, np.ndarray] | None = None

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

    def __iter__(self) -> "BatchIterator":
        return self

    def __next__(self) -> tuple[Demonstration, np.ndarray, np.ndarray]:
        count = self._chosen.size
        start = self._position * self._batch_size
        places = np.arange(start, start + self._batch_size)[self._part]
        index = self._chosen[self._permutation()[places % count]]
        weight = (places < count).astype(np.float32)
        batch = self._take(index)
        self._position += 1
        if self._position == self.batches_per_epoch:
            self._epoch, self._position = self._epoch + 1, 0
        return batch, weight, index

    def _permutation(self) -> np.ndarray:
        if self._order is None or self._order[0] != self._epoch:
            rng = np.random.default_rng([self._seed, self._epoch])
            self._order = (self._epoch, rng.permutation(self._chosen.size))
        return self._order[1]

    def _take(self, index: np.ndarray) -> Demonstration:
        if isinstance(self._rows, Dataset):
            return self._rows.read(index)
        return jax.tree.map(lambda leaf: leaf[index], self._rows)
