import json

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rcirl_jax.data.store.order import BatchIterator
from tests.data.store.test_dataset import make_rows
from tests.helpers.logs import refused


def take(batches, count):
    return [next(batches) for _ in range(count)]


def equal(one, other):
    flat = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(a.tobytes() == b.tobytes() for a, b in flat)


@given(count=st.integers(1, 23), size=st.integers(1, 30), seed=st.integers(0, 2**40))
def test_an_epoch_visits_every_row_once(count, size, seed):
    rows = make_rows(count)
    batches = BatchIterator(rows, batch_size=size, seed=seed)
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


@given(count=st.integers(1, 20), size=st.integers(1, 8), cut=st.integers(0, 30))
def test_restored_iterator_continues_to_the_bit(count, size, cut):
    rows = make_rows(count)
    batches = BatchIterator(rows, batch_size=size, seed=4)
    take(batches, cut)
    state = json.loads(json.dumps(batches.state()))
    resumed = BatchIterator(rows, batch_size=size, seed=4)
    resumed.restore(state)
    assert equal(take(resumed, 7), take(batches, 7))
    assert resumed.state() == batches.state()


@pytest.mark.parametrize("processes", [2, 4])
def test_processes_share_the_same_global_batches(processes):
    rows = make_rows(21)
    whole = BatchIterator(rows, batch_size=8, seed=2)
    parts = [
        BatchIterator(rows, batch_size=8, seed=2, shard_index=i, num_shards=processes)
        for i in range(processes)
    ]
    for _ in range(7):
        batch, weight, index = next(whole)
        pieces = [next(part) for part in parts]
        joined = jax.tree.map(lambda *x: np.concatenate(x), *pieces)
        assert equal(joined, (batch, weight, index))
    assert all(part.state() == whole.state() for part in parts)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"batch_size": 0}, "batch_size: 0"),
        ({"batch_size": 5, "num_shards": 2}, "batch_size: 5"),
        ({"num_shards": 2, "shard_index": 2}, "shard_index: 2"),
        ({"seed": -1}, "seed: -1"),
        ({"indices": np.arange(0)}, "rows: 0"),
    ],
)
def test_bad_settings(settings, words):
    known = {"batch_size": 4, "seed": 0, **settings}
    assert words in refused(BatchIterator, make_rows(6), **known)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seed": 1}, "seed: 1: expected 0"),
        ({"position": 2}, "position 2"),
        ({"position": -1}, "position -1"),
        ({"epoch": -1}, "epoch -1"),
    ],
)
def test_states_of_other_runs_are_refused(change, words):
    batches = BatchIterator(make_rows(6), batch_size=4, seed=0)
    assert words in refused(batches.restore, {**batches.state(), **change})
    line = refused(batches.restore, {"position": 0, "seed": 0})
    assert "epoch: missing" in line


def test_order_depends_on_epoch_and_seed():
    rows = make_rows(50)

    def order(seed, epochs):
        batches = BatchIterator(rows, batch_size=50, seed=seed)
        return [index.tolist() for _, _, index in take(batches, epochs)]

    first, second = order(0, 2)
    assert first != second
    assert order(0, 2) == [first, second]
    assert order(1, 1) != [first]
