"""A sweep's search by Optuna: where it looks, resume, what it leaves alone."""

import math
import sys

import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.export import sweep
from rcirl_jax.export.sweep import ROUND, Point, read_sweep, rounds, run_sweep, table
from rcirl_jax.runtime.executors import Serial
from tests.train.test_sweep import MADE_BY, config_of, data, untimed

pytest.importorskip("optuna")
__all__ = ["data"]  # a fixture
BEST = Point((6,), 0.1, 0.01)


def config(**changes):
    return config_of("d", **{"trials": 40, "leaky_rates": (0.01, 0.5), **changes})


def searched(config):
    """Rounds and values of a search that finds what training would.

    Worse with every tenfold of a rate off the best; far off it does not train.
    """
    values, found = {}, []
    for number, points in rounds(config, values):
        found.append((number, points))
        for at in points:
            pairs = zip(at[1:], BEST[1:], strict=True)
            off = [math.log10(x / y) ** 2 for x, y in pairs]
            value = 1.0 + sum(off) + (at.hidden != BEST.hidden)
            values[at] = value if value < 2.5 else math.nan
    return found, values


def test_it_looks_where_the_values_are_better():
    found, values = searched(config())
    assert [len(points) for _, points in found] == [ROUND] * 5
    assert [number for number, _ in found] == [1, 2, 3, 4, 5]
    asked = [point for _, points in found for point in points]
    assert all(0.01 <= a <= 0.5 and 0.003 <= r <= 0.03 for _, a, r in asked)
    last = [point.hidden for point in asked[-2 * ROUND :]]
    assert last.count(BEST.hidden) > ROUND
    assert min(values.values()) < 1.1
    assert searched(config())[0] == found


def test_what_was_tried_before_is_not_trained_again():
    found, values = searched(config(leaky_rates=(0.05,), learning_rates=(0.01,)))
    assert len(values) == sum(len(points) for _, points in found) == 2


def test_a_search_goes_on_and_more_trials_go_on_where_it_ended(
    data, tmp_path, monkeypatch
):
    monkeypatch.setattr(sweep, "ROUND", 1)
    small = {"hidden_sizes": ((),), "seeds": 1}
    trained, real = [], sweep.train_group

    def seen(points, config):
        trained.append(len(points))
        return real(points, config)

    def search(folder, trials):
        trained.clear()
        config = config_of(data, trials=trials, **small)
        return untimed(run_sweep(config, folder, Serial(), MADE_BY))

    monkeypatch.setattr(sweep, "train_group", seen)
    whole = search(tmp_path / "a", 2)
    assert trained == [1, 1]
    search(tmp_path / "b", 1)
    assert search(tmp_path / "b", 2) == whole
    assert trained == [1]
    report = read_sweep(tmp_path / "b")
    assert report["search"] == "optuna"
    assert table(report).count("<- chosen") == 1
    with pytest.raises(InputError, match="search: optuna: expected grid to resume"):
        run_sweep(config_of(data, **small), tmp_path / "b", Serial(), MADE_BY)


def test_nothing_to_search_is_one_line():
    one = {"hidden_sizes": ((),), "leaky_rates": (0.1,), "learning_rates": (0.01,)}
    with pytest.raises(InputError, match=r"trials: .*: expected two values"):
        config(**one)


def test_without_optuna_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(InputError, match=r"pip install 'rcirl-jax\[optuna\]'"):
        searched(config())
