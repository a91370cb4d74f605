import jax
import numpy as np
import pytest

from rcirl_jax.data import joined
from rcirl_jax.errors import InputError
from tests.scenes import batch, demonstration


class Part:
    def __init__(self, seeds, test):
        self.rows = jax.tree.map(np.asarray, batch([demonstration(s) for s in seeds]))
        self.count, self.hash, self.test = len(seeds), f"part {seeds}", set(test)

    def indices(self, split):
        everyone = range(self.count)
        keep = {"test": self.test, None: set(everyone)}.get(
            split, set(everyone) - self.test
        )
        return np.array([i for i in everyone if i in keep], np.int64)

    def read(self, indices):
        return jax.tree.map(lambda x: x[indices], self.rows)


def test_rows_of_parts_follow_each_other_in_the_order_asked_for():
    parts = [Part([0, 1, 2], [1]), Part([3, 4], [0])]
    both = joined.JoinedDatasets(parts)
    assert both.count == 5
    np.testing.assert_array_equal(both.indices("train"), [0, 2, 4])
    np.testing.assert_array_equal(both.indices("test"), [1, 3])
    order = np.array([4, 0, 3, 2])
    found = both.read(order)
    whole = np.concatenate([part.rows.scene.ego.v for part in parts])
    np.testing.assert_array_equal(found.scene.ego.v, whole[order])
    np.testing.assert_array_equal(both.load("test").scene.ego.v, whole[[1, 3]])


def test_identity_depends_on_parts_and_order():
    one, two = Part([0], []), Part([1], [])
    hashes = {joined.JoinedDatasets(p).hash for p in ([one, two], [two, one], [one])}
    assert len(hashes) == 3


def test_a_dataset_named_twice_is_refused():
    with pytest.raises(InputError, match="distinct"):
        joined.open_datasets(["a", "a"])
