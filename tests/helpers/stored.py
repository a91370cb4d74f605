"""Datasets of random demonstrations, states to the bit, and what a sweep says."""

import dataclasses

import jax
import numpy as np

from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.data.store.writer import DatasetWriter
from rcirl_jax.evaluation.ranking.metrics import METRICS
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


def sweep_result() -> dict[str, object]:
    """Return what a sweep of two leaky rates and two seeds says, made up."""
    estimate = {"value": 1.5, "low": 1.0, "high": 2.0, "seed_sd": 0.1}
    members, rows = {}, {}
    for rate in (0.01, 0.1):
        names = [f"15_a{rate:g}_s{seed}" for seed in (0, 1)]
        of = {"hidden": "15", "leaky_rate": rate, "learning_rate": 1e-3}
        for name in names:
            members[name] = {**of, "validation": {"top1_fde": 1.5}, "finite": True}
        held_out = {"top1_fde": estimate}
        rows[f"15_a{rate:g}"] = {
            **of, "members": names, "finite": True, "validation": held_out,
        }  # fmt: skip
    chosen, test = next(iter(rows)), {"top1_fde": estimate}
    facts = {"members": 4, "seconds": 3.0, "compiles": 1, "compile_seconds": 0.5}
    return {
        "validation_by": "vehicles",
        "scenes": {"train": 8, "validation": 4, "test": 4},
        "groups": {"15": facts},
        "choose_by": {
            "metric": "top1_fde", **dataclasses.asdict(METRICS["top1_fde"])
        },
        "members": members,
        "configurations": rows,
        "chosen": {"configuration": chosen, "member": names[0], "test": test},
    }  # fmt: skip
