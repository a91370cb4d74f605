"""Batches: every row once an epoch, resumed to the bit, the same from disk."""

import threading

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rcirl_jax.data.store import batches as pipeline
from rcirl_jax.data.store.batches import (
    BatchIterator,
    Prefetch,
    RowStream,
    epoch_order,
    split_batches,
)
from rcirl_jax.data.store.dataset import BLOCK_ROWS, open_dataset
from rcirl_jax.types import Demonstration
from tests.data.store.test_dataset import make_rows, write

SIZES = (300, 40, 7, 25, 60, 18)


def all_of(rows, **settings):
    """Batches of a dataset, or of rows in memory, which are one block."""
    is_memory = isinstance(rows, Demonstration)
    index = np.arange(rows.vehicle.size) if is_memory else rows.indices(None)
    blocks = 0 * index if is_memory else rows.blocks(index)
    return BatchIterator(rows, index, blocks, **settings)


def take(batches, count):
    return [next(batches) for _ in range(count)]


def equal(one, other):
    flat = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(a.tobytes() == b.tobytes() for a, b in flat)


@given(count=st.integers(1, 23), size=st.integers(1, 30), seed=st.integers(0, 2**40))
def test_an_epoch_visits_every_row_once(count, size, seed):
    rows = make_rows(count)
    batches = all_of(rows, batch_size=size, seed=seed)
    for epoch in range(2):
        assert batches.state() == {"epoch": epoch, "position": 0, "seed": seed}
        seen = []
        for batch, weight, index in take(batches, batches.batches_per_epoch):
            assert weight.shape == index.shape == (size,)
            assert weight.dtype == np.float32
            assert np.array_equal(batch.frame, rows.frame[index])
            assert equal(batch.human.s, rows.human.s[index])
            assert np.all(np.diff(weight) <= 0.0)
            seen += index[weight == 1.0].tolist()
        assert sorted(seen) == list(range(count))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stream") / "d"
    write(folder, SIZES)
    return open_dataset(folder)


class Recorded:
    """A dataset that remembers which rows were read."""

    def __init__(self, dataset):
        self._dataset, self.rows = dataset, []

    def __getattr__(self, name):
        return getattr(self._dataset, name)

    def read(self, indices):
        self.rows += indices.tolist()
        return self._dataset.read(indices)


@pytest.fixture
def narrow(monkeypatch):
    """A window of three blocks, so that small data slide through it."""
    monkeypatch.setattr(pipeline, "WINDOW_BLOCKS", 3)


@given(
    count=st.integers(1, 400),
    per_block=st.integers(1, 20),
    window=st.integers(1, 30),
    epoch=st.integers(0, 5),
)
def test_order_visits_all_rows_and_few_blocks_at_a_time(
    count, per_block, window, epoch
):
    blocks = np.arange(count) // per_block
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "WINDOW_BLOCKS", window)
        order = epoch_order(3, epoch, blocks)
    assert sorted(order.tolist()) == list(range(count))
    first = np.unique(blocks[order], return_index=True)[1]
    last = count - 1 - np.unique(blocks[order][::-1], return_index=True)[1]
    live = np.zeros(count + 1, int)
    np.add.at(live, first, 1)
    np.add.at(live, last + 1, -1)
    assert np.cumsum(live).max() <= window + 1


@pytest.mark.parametrize("processes", [1, 2, 4])
def test_streamed_batches_are_those_of_memory(dataset, narrow, processes):
    settings = {"batch_size": 16, "seed": 5}
    memory = split_batches(dataset, "train", in_memory_mb=100.0, **settings)
    parts = [
        split_batches(
            dataset, "train", in_memory_mb=0.0, **settings, shard_index=i,
            num_shards=processes,
        )
        for i in range(processes)
    ]  # fmt: skip
    for _ in range(2 * memory.batches_per_epoch + 3):
        batch, weight, index = next(memory)
        joined = jax.tree.map(lambda *x: np.concatenate(x), *map(next, parts))
        assert equal(joined, (batch, weight, index))
        assert equal(batch, dataset.read(index))
    assert all(part.state() == memory.state() for part in parts)


@given(cut=st.integers(0, 60))
def test_streams_restart_anywhere_to_the_bit(dataset, cut):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "WINDOW_BLOCKS", 3)
        batches = all_of(dataset, batch_size=16, seed=4)
        take(batches, cut)
        resumed = all_of(dataset, batch_size=16, seed=4)
        resumed.restore(batches.state())
        assert equal(take(resumed, 5), take(batches, 5))


def test_a_process_reads_its_own_rows_once_an_epoch(dataset, narrow):
    read = []
    for part in range(2):
        watched = Recorded(dataset)
        settings = {"shard_index": part, "num_shards": 2}
        batches = all_of(watched, batch_size=16, seed=0, **settings)
        given = take(batches, batches.batches_per_epoch)
        due = np.concatenate([index for _, _, index in given])
        assert sorted(watched.rows) == sorted(due.tolist())
        read += due[np.concatenate([weight for _, weight, _ in given]) > 0].tolist()
    assert sorted(read) == list(range(sum(SIZES)))


def test_memory_is_bounded_by_the_window(dataset, narrow):
    """Not the 450 rows: at most three blocks and the one coming in."""
    index = np.arange(sum(SIZES))
    whole = RowStream(dataset, index, dataset.blocks(index), 1)
    assert whole.capacity == BLOCK_ROWS
    small = np.arange(300, sum(SIZES))
    blocks = np.sort(dataset.blocks(small))
    order = epoch_order(0, 0, blocks)
    assert RowStream(dataset, small[order], blocks[order], 1).capacity < small.size


def test_prefetch_is_bounded_and_ends_in_order():
    made, full = [], threading.Event()

    def produce():
        if len(made) == 7:
            raise StopIteration
        made.append(len(made))
        if len(made) == 4:
            full.set()
        return made[-1]

    with Prefetch(produce, 3) as ahead:
        assert full.wait(10.0)
        assert made == [0, 1, 2, 3]  # three wait, the fourth is in hand
        assert list(ahead) == list(range(7))
        with pytest.raises(StopIteration):
            next(ahead)


def test_prefetch_hands_on_errors_and_stops_while_full():
    def produce():
        raise OSError("disk gone")

    with Prefetch(produce, 2) as ahead, pytest.raises(OSError, match="disk gone"):
        next(ahead)
    before = threading.active_count()
    with Prefetch(lambda: 1, 1) as ahead:
        assert next(ahead) == 1
    assert threading.active_count() == before
