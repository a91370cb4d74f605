"""What the data support: sums over time, choices, doubts, reasons."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.insight import data_support
from rcirl_jax.evaluation.insight.data_support import (
    choices_of,
    growth,
    rank_correlation,
    reasons,
    sums_over_time,
    weights_supported,
)
from rcirl_jax.evaluation.ranking.learners import Learned, train_learner
from rcirl_jax.features import feature_map
from rcirl_jax.reward import RewardConfig, pinned
from rcirl_jax.train.frozen import freeze
from rcirl_jax.units import TIMES_S
from tests.train.test_step import CONFIG, rows

FREE = dataclasses.replace(
    CONFIG,
    loss="logistic",
    positive="nearest",
    epochs=3,
    reward=RewardConfig(pin="none"),
)
LINEAR = dataclasses.replace(FREE, reward=RewardConfig(hidden=(), pin="none"))
STRICT = dataclasses.replace(
    FREE, reward=RewardConfig(hidden=(), pin="none", constraint="nonnegative")
)
NAMES = feature_map("paper21").names
VEHICLE = np.arange(16) // 2


@functools.cache
def frozen():
    return freeze(rows(), np.arange(16), FREE)


@functools.cache
def trained(config, seeds=(0, 1)):
    return train_learner(frozen(), config, list(seeds))


def values(run: Learned):
    made = frozen()
    return run.scorer(np.asarray(made.points), np.asarray(made.points_valid))


@pytest.mark.parametrize(
    "config", [FREE, LINEAR, STRICT], ids=["network", "linear", "strict"]
)
def test_sums_over_time_times_the_output_weights_are_the_values(config):
    (run, _) = trained(config)
    w = np.asarray(pinned(run.params, config.reward).kernels[-1])[:, 0]
    human, candidates = sums_over_time(run, frozen())
    np.testing.assert_allclose(candidates @ w, values(run), rtol=1e-4, atol=1e-4)
    assert human.shape == (16, w.size)


def test_reasons_add_up_to_the_gap():
    (run, _) = trained(FREE)
    a, b = np.arange(16) % 7, np.arange(16) % 5 + 7
    v, at = values(run), np.arange(16)
    got = reasons(run, frozen(), a, b)
    assert got.shape == (16, len(NAMES))
    np.testing.assert_allclose(got.sum(axis=1), v[at, a] - v[at, b], atol=2e-3)


def test_the_choice_is_the_best_feasible_one_and_its_error_its_distance():
    runs = trained(FREE)
    made = choices_of(runs, frozen(), frozen(), VEHICLE)
    mean = np.mean([values(run) for run in runs], axis=0)
    distance = np.asarray(frozen().facts.distance)
    near = distance == np.asarray(frozen().facts.human_distance)[:, None]
    allowed = np.asarray(frozen().feasible) | near
    for s in range(16):
        best = max(np.flatnonzero(allowed[s]), key=lambda k, s=s: mean[s, k])
        assert mean[s, made.chosen[s]] == pytest.approx(mean[s, best], abs=1e-4)
        assert near[s, made.nearest[s]]
        assert made.error[s] == distance[s, made.chosen[s]]
        last = int(np.asarray(frozen().time_valid)[s].sum()) - 1
        station = frozen().points[s, made.chosen[s], last, NAMES.index("station")]
        assert made.station[s] == float(station)
        chosen, human = frozen().points[s, made.chosen[s]], frozen().human[s]
        gap = np.asarray(chosen, np.float64) - np.asarray(human, np.float64)
        np.testing.assert_array_equal(made.ahead[s], gap[:, NAMES.index("station")])
    assert (made.spread_of_posterior > 0.0).any()


def test_a_positive_that_is_no_candidate_is_refused():
    """Nothing is nearest then, and the first candidate is no answer."""
    curves = freeze(rows(), np.arange(16), dataclasses.replace(FREE, positive="human"))
    with pytest.raises(InputError, match="expected the positive `nearest`"):
        choices_of(trained(FREE), frozen(), curves, VEHICLE)


def test_growth_of_a_constant_error_of_acceleration():
    ahead = np.stack([0.5 * 0.4 * TIMES_S**2, -0.5 * 0.4 * TIMES_S**2])
    valid = np.tile(TIMES_S < 6.0, (2, 1))
    size, bias, worth = growth(ahead, valid).T
    seen = valid[0]
    np.testing.assert_allclose(size[seen], 0.2 * TIMES_S[seen] ** 2, rtol=1e-6)
    np.testing.assert_allclose(bias[seen], 0.0, atol=1e-6)
    np.testing.assert_allclose(worth[seen][1:], 0.4, rtol=1e-5)
    assert np.isnan(size[~seen]).all()


def test_equal_runs_never_disagree():
    (run, _) = trained(FREE)
    assert not choices_of([run, run], frozen(), frozen(), VEHICLE).spread_of_seeds.any()


def test_a_sure_posterior_has_no_spread_at_all(monkeypatch):
    """Not the rounding of equal float32 ends, which would rank scenes by station."""
    sure = lambda human, *_: 1e16 * np.eye(human.shape[1])  # noqa: E731
    monkeypatch.setattr(data_support, "laplace", sure)
    made = choices_of(trained(FREE), frozen(), frozen(), VEHICLE)
    assert not made.spread_of_posterior.any()


def test_more_drivers_leave_less_doubt_but_not_the_same_ones_again():
    """Every scene counted fifty times: as of others, and as of the same vehicles."""
    runs, made = trained(FREE), frozen()
    many = jax.tree.map(lambda x: np.repeat(np.asarray(x), 50, axis=0), made)
    once = choices_of(runs, made, made, VEHICLE).spread_of_posterior
    others = choices_of(runs, many, made, np.arange(800)).spread_of_posterior
    same = choices_of(runs, many, made, np.repeat(VEHICLE, 50)).spread_of_posterior
    assert others.mean() < 0.6 * once.mean()
    assert same.mean() > 0.8 * once.mean()


def test_a_feature_that_is_left_out_says_nothing():
    (run,) = train_learner(frozen(), FREE, [0], keep=("velocity", "acceleration"))
    made = frozen()
    points = np.asarray(made.points)
    valid = np.asarray(made.points_valid)
    before = run.scorer(points, valid)
    for name in NAMES:
        other = points.copy()
        other[..., NAMES.index(name)] += 3.0
        same = np.array_equal(run.scorer(other, valid), before)
        assert same == (name not in {"velocity", "acceleration"})


def test_supported_weights_name_the_presets_features():
    (run, _) = trained(LINEAR)
    report = weights_supported(run, frozen(), VEHICLE)
    assert [row.name for row in report.features] == list(NAMES)
    assert report.pairs == int(np.asarray(frozen().feasible).sum())
    assert report.clusters == 8


def test_costs_of_departures_are_two_for_each_feature():
    """One for each side of the median; what the data ask for may have any sign."""
    (run, _) = trained(STRICT)
    report = weights_supported(run, frozen(), VEHICLE)
    names = [row.name for row in report.features]
    assert names == [f"{n} {s}" for s in ("above", "below") for n in NAMES]
    units = [row.unit for row in report.features]
    assert units[: len(NAMES)] == units[len(NAMES) :]
    assert any(row.varies for row in report.features)
    scale = np.asarray(run.normaliser.scale)
    for row, of in zip(report.features, np.tile(scale, 2), strict=True):
        assert row.normalised == pytest.approx(row.weight * of, rel=1e-5)


def test_supported_weights_do_not_depend_on_the_size_and_sign_of_gamma():
    """Gamma and the weights change together; their product is the reward."""
    (run, _) = trained(LINEAR)
    other = run.params.replace(gamma=-3.0 * run.params.gamma)
    a, b = (
        weights_supported(one, frozen(), VEHICLE).features
        for one in (run, dataclasses.replace(run, params=other))
    )
    for x, y in zip(a, b, strict=True):
        assert x.verdict == y.verdict
        assert x.low == pytest.approx(y.low, rel=1e-3, abs=1e-9)


def test_supported_weights_do_not_depend_on_gamma_where_no_scene_has_a_time():
    """At a horizon of 5 s the last gammas stay where they were drawn."""
    (run, _) = trained(LINEAR)
    made = frozen()
    early = np.arange(len(TIMES_S)) < 11
    short = made.replace(time_valid=made.time_valid & early)
    late = np.where(early, 1.0, 7.0)
    other = run.params.replace(gamma=run.params.gamma * late)
    a, b = (
        weights_supported(one, short, VEHICLE).features
        for one in (run, dataclasses.replace(run, params=other))
    )
    for x, y in zip(a, b, strict=True):
        assert (x.weight, x.low) == pytest.approx((y.weight, y.low), rel=1e-5)


def test_rank_correlation_of_known_cases():
    x, vehicle = np.arange(40.0), np.arange(40) // 2
    rho, low, high = rank_correlation(x, np.exp(0.1 * x), vehicle)
    assert (rho, low, high) == pytest.approx((1.0, 1.0, 1.0))
    assert rank_correlation(x, -x, vehicle)[0] == pytest.approx(-1.0)
    rng = np.random.default_rng(3)
    rho, low, high = rank_correlation(x, rng.normal(size=40), vehicle)
    assert low < 0.0 < high
    assert low < rho < high
