"""Optuna's search as a baseline's tuner: budget, seed, values that are not finite."""

import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.baselines.tpe import REACH, tune
from tests.evaluation.baselines.test_cma_es import Counted, sphere

pytest.importorskip("optuna")
D = 3


def search(function, budget, seed=0):
    return tune(function, np.zeros(D), 0.5, budget, seed)


def test_it_comes_near_the_minimum_of_a_shifted_sphere_within_its_box():
    seen = []
    counted = Counted(lambda x: seen.append(x) or sphere(x))
    best, value = search(counted, 120)
    assert value == sphere(best) < 0.3 * sphere(np.zeros(D))
    np.testing.assert_array_equal(seen[0], np.zeros(D))
    assert np.abs(seen).max() <= 0.5 * REACH
    assert counted.used == 120


@pytest.mark.parametrize("budget", [1, 2, 7, 8, 9])
def test_it_takes_the_budget_and_never_more(budget):
    counted = Counted(sphere)
    assert search(counted, budget)[1] <= sphere(np.zeros(D))
    assert counted.used == budget


def test_the_seed_alone_decides():
    first = search(sphere_of_many, 40, seed=3)
    np.random.seed(17)  # noqa: NPY002  # a state that must not matter
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    again = search(sphere_of_many, 40, seed=3)
    np.testing.assert_array_equal(before, np.random.get_state()[1])  # noqa: NPY002
    np.testing.assert_array_equal(first[0], again[0])
    assert search(sphere_of_many, 40, seed=4)[1] != first[1]


def sphere_of_many(vectors):
    return np.array([sphere(x) for x in vectors])


def test_nan_is_the_worst_and_nothing_finite_is_refused():
    walled = Counted(lambda x: sphere(x) if x[1] < 0.2 else np.nan)
    best, value = search(walled, 60)
    assert best[1] < 0.2
    assert np.isfinite(value)
    with pytest.raises(InputError, match="nowhere finite"):
        search(Counted(lambda _: np.nan), 20)
