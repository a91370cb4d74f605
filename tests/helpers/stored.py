"""Datasets of random demonstrations, and states of a training to the bit."""

import jax
import numpy as np

from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.data.store.writer import DatasetWriter
from rcirl_jax.units import HORIZON_S
from tests.data.store.test_dataset import finish_fields, lineage
from tests.helpers.scenes import T, batch, demonstration


def rows_of(seeds):
    """Demonstrations [n] of the seeds, numpy leaves."""
    return jax.tree.map(np.asarray, batch([demonstration(seed) for seed in seeds]))


def long_rows(count):
    """Demonstrations in random scenes, all of 8 s."""
    rows = rows_of(range(count))
    scene = rows.scene.replace(time_valid=np.ones((count, T), bool))
    return rows.replace(scene=scene, future_s=np.full(count, HORIZON_S, np.float32))


def stored(folder, shards):
    """A dataset with these rows, one shard each."""
    writer = DatasetWriter(folder)
    for index, rows in enumerate(shards):
        writer.write_shard(index, rows, lineage(index))
    writer.finish(finish_fields())
    return open_dataset(folder)


def leaves(state):
    """All arrays of a training's state, its key among them."""
    plain = state.replace(key=jax.random.key_data(state.key))
    return [np.asarray(leaf) for leaf in jax.tree.leaves(plain)]


def assert_same_bits(one, other):
    """Of two states."""
    for a, b in zip(leaves(one), leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)
