import jax
import numpy as np
import pytest

from rcirl_jax.data.store import dataset as joined
from rcirl_jax.errors import InputError
from tests.helpers.scenes import batch, demonstration


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


def test_sources_count_by_their_shares_whatever_their_size():
    """Two training scenes and one: shares 1 and 1 give 3/4, 3/4 and 3/2."""
    parts = [Part([0, 1, 2], [1]), Part([3, 4], [0])]
    equal = joined.JoinedDatasets(parts, (1.0, 1.0))
    np.testing.assert_allclose(equal.weights(np.array([0, 2, 4])), [0.75, 0.75, 1.5])
    threefold = joined.JoinedDatasets(parts, (1.0, 3.0))
    np.testing.assert_allclose(
        threefold.weights(np.array([4, 0])), [2.25, 0.375], rtol=1e-6
    )
    train = threefold.indices("train")
    assert threefold.weights(train).mean() == pytest.approx(1.0)
    plain = joined.JoinedDatasets(parts)
    np.testing.assert_array_equal(plain.weights(train), 1.0)
    turned = joined.JoinedDatasets(parts[::-1])
    assert len({x.hash for x in (plain, equal, threefold, turned)}) == 4


def test_shares_from_a_flag():
    assert joined.shares_of("scenes", 3) is None
    assert joined.shares_of("equal", 3) == (1.0, 1.0, 1.0)
    assert joined.shares_of("1,0.5,2", 3) == (1.0, 0.5, 2.0)
    assert joined.shares_of("equal", 1) is None
    for bad in ("1,2", "1,2,0", "1,2,x", "1,2,nan", "1,2,inf", "half"):
        with pytest.raises(InputError, match="data_weights"):
            joined.shares_of(bad, 3)
