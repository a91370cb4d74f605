"""A sweep's search by Optuna: where it looks, resume, what it leaves alone."""

import math
import sys

import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.sweep import point_name
from rcirl_jax.export import sweep as folders
from rcirl_jax.export.sweep import ROUND, Found, read_sweep, run_sweep, searched, table
from rcirl_jax.report.charts import sweep_picture
from rcirl_jax.runtime.executors import Serial
from tests.helpers.commands import refused
from tests.train.test_sweep import MADE_BY, config_of, data, untimed

pytest.importorskip("optuna")
__all__ = ["data"]  # a fixture
BEST = ((6,), 0.1, 0.01)  # network, leaky rate, step size


def config(**changes):
    return config_of("d", **{"trials": 40, "leaky_rates": (0.01, 0.5), **changes})


def scored(points, _):
    """What training would find: worse with every tenfold of a rate off the best."""

    def value(shape, *rates):
        off = [math.log10(x / y) ** 2 for x, y in zip(rates, BEST[1:], strict=True)]
        return 1.0 + sum(off) + (shape != BEST[0])

    values = {point_name(point): value(*point) for point in points}
    return Found(
        rows=dict.fromkeys(values, ()), groups={}, members={},
        configurations={
            row: {"finite": x < 2.5, "validation": {"top1_fde": {"value": x}}}
            for row, x in values.items()
        },
    )  # fmt: skip


def test_it_looks_where_the_values_are_better():
    rounds = []
    found = searched(config(), lambda *x: rounds.append(x) or scored(*x))
    assert [len(points) for points, _ in rounds] == [ROUND] * 5
    assert [number for _, number in rounds] == [1, 2, 3, 4, 5]
    asked = [point for points, _ in rounds for point in points]
    assert all(0.01 <= a <= 0.5 and 0.003 <= r <= 0.03 for _, a, r in asked)
    last = [shape for shape, _, _ in asked[-2 * ROUND :]]
    assert last.count(BEST[0]) > ROUND
    values = [found.value(row, "top1_fde") for row in found.rows]
    assert min(values) < 1.1
    again = searched(config(), scored)
    assert [*again.rows] == [*found.rows]


def test_what_was_tried_before_is_not_trained_again():
    only = {"leaky_rates": (0.05,), "learning_rates": (0.01,)}
    rounds = []
    found = searched(config(**only), lambda *x: rounds.append(x) or scored(*x))
    assert len(found.rows) == sum(len(points) for points, _ in rounds) == 2


def test_a_search_goes_on_and_more_trials_go_on_where_it_ended(
    data, tmp_path, monkeypatch
):
    monkeypatch.setattr(folders, "ROUND", 2)
    small = {"hidden_sizes": ((),), "seeds": 1}
    trained, real = [], folders.train_group

    def seen(hidden, config):
        trained.append(len(config.points))
        return real(hidden, config)

    def search(folder, trials):
        trained.clear()
        made = run_sweep(
            config_of(data, trials=trials, **small), folder, Serial(), MADE_BY
        )
        return untimed(made)

    monkeypatch.setattr(folders, "train_group", seen)
    whole = search(tmp_path / "a", 4)
    assert trained == [2, 2]
    assert search(tmp_path / "a", 4) == whole
    assert trained == []
    search(tmp_path / "b", 2)
    assert search(tmp_path / "b", 4) == whole
    assert trained == [2]
    report = read_sweep(tmp_path / "b")
    assert report["search"] == "optuna"
    assert table(report).count("<- chosen") == 1
    picture = sweep_picture(tmp_path / "sweep.png", report)
    assert picture.read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(InputError, match="search: optuna: expected grid to resume"):
        run_sweep(config_of(data, **small), tmp_path / "b", Serial(), MADE_BY)


def test_nothing_to_search_is_one_line():
    one = {"hidden_sizes": ((),), "leaky_rates": (0.1,), "learning_rates": (0.01,)}
    with pytest.raises(InputError, match=r"trials: .*: expected two values"):
        config(**one)


@pytest.mark.multiprocess
def test_trials_of_a_grid_are_one_line(tmp_path):
    given = (f"--data={tmp_path}", f"--output={tmp_path}/out", "--trials=9")
    said = refused("rcirl_jax", "sweep", *given)
    assert "--trials: 9: expected --search=optuna" in said


def test_without_optuna_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(InputError, match=r"pip install 'rcirl-jax\[optuna\]'"):
        searched(config(), scored)
