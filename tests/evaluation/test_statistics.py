"""Intervals and tests against scipy, closed forms and plain loops."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy import stats

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.statistics import (
    ClusterBootstrap,
    bootstrap_median,
    clopper_pearson,
    cluster_t,
    combine_seeds,
    holm,
    paired_difference,
    paired_rates,
    tango_score,
)


def drawn_clusters(bootstrap, clusters):
    """[n, C] how often each cluster was drawn, read through the public means."""
    names = np.unique(clusters)
    sizes = np.array([np.sum(clusters == c) for c in names])
    assert np.all(sizes == sizes[0])  # then a mean is a share of draws
    shares = [bootstrap.means((clusters == c).astype(float)) for c in names]
    return np.stack(shares, axis=1) * names.size


@given(seed=st.integers(0, 10**6), runs=st.integers(1, 4))
def test_replicates_equal_a_loop_over_expanded_scenes(seed, runs):
    rng = np.random.default_rng(seed)
    size = 3
    clusters = rng.permutation(np.repeat([7, -2, 40, 5], size))
    values = rng.normal(size=(runs, clusters.size))
    weight = rng.integers(1, 5, clusters.size).astype(float)
    bootstrap = ClusterBootstrap(clusters, 8, seed)
    drawn = np.round(drawn_clusters(bootstrap, clusters)).astype(int)
    ones = np.zeros((runs, runs, clusters.size))
    ones[np.arange(runs), np.arange(runs)] = 1.0
    run_weight = np.stack([bootstrap.means(x) for x in ones], axis=1) * runs
    got = bootstrap.means(values, weight)
    medians = bootstrap.medians(values[0])
    for i in range(8):
        picked = [
            s
            for name, times in zip(np.unique(clusters), drawn[i], strict=True)
            for _ in range(times)
            for s in np.flatnonzero(clusters == name)
        ]
        ratios = [np.average(v[picked], weights=weight[picked]) for v in values]
        want = np.mean([u * x for u, x in zip(run_weight[i], ratios, strict=True)])
        assert got[i] == pytest.approx(want, abs=1e-12)
        assert medians[i] == pytest.approx(np.median(values[0, picked]), abs=1e-12)


def test_standard_error_of_single_scene_vehicles_is_the_textbook_one():
    """Copies of a scene add no certainty."""
    x = np.random.default_rng(0).normal(size=400)
    found = combine_seeds(x, ClusterBootstrap(np.arange(400), 8000))
    textbook = x.std() / np.sqrt(400)
    assert found.value == pytest.approx(x.mean())
    assert found.se == pytest.approx(textbook, rel=0.04)
    assert found.low == pytest.approx(x.mean() - 1.96 * textbook, abs=0.1 * textbook)
    assert found.high == pytest.approx(x.mean() + 1.96 * textbook, abs=0.1 * textbook)
    assert (found.seed_sd, found.seed_se) == (None, None)
    copied = combine_seeds(np.repeat(x, 10), np.repeat(np.arange(400), 10))
    assert copied.low == pytest.approx(combine_seeds(x, np.arange(400)).low)


@pytest.mark.parametrize(("runs", "spread"), [(2, 0.0), (8, 4.0)])
def test_runs_and_vehicles_add_in_variance(runs, spread):
    """The spread between runs enters unbiased."""
    rng = np.random.default_rng(3)
    offsets, scenes = rng.normal(size=(runs, 1)), spread * rng.normal(size=(1, 60))
    found = combine_seeds(offsets + scenes, ClusterBootstrap(np.arange(60), 8000))
    assert found.seed_sd == pytest.approx(offsets.std(ddof=1))
    assert found.seed_se == pytest.approx(offsets.std(ddof=1) / np.sqrt(runs))
    want = np.hypot(found.seed_se, scenes.std() / np.sqrt(60))
    assert found.se == pytest.approx(want, rel=0.04)


def test_paired_difference_sees_what_the_scenes_share():
    rng = np.random.default_rng(6)
    clusters = np.repeat(np.arange(60), 4)
    hard = 5.0 * rng.normal(size=240)
    a, b = hard + 0.1 * rng.normal(size=240), hard + 0.1 * rng.normal(size=240) + 0.05
    found = paired_difference(a, b, clusters)
    assert found.mean == pytest.approx(np.mean(a - b))
    assert found.high < 0.0
    assert found.p == pytest.approx(2 / 2001)
    apart = np.hypot(*(combine_seeds(x, clusters).se for x in (a, b)))
    assert found.se < 0.1 * apart
    mirrored = paired_difference(b, a, clusters)
    assert mirrored.mean == -found.mean
    assert mirrored.low == pytest.approx(-found.high)
    assert mirrored.p == found.p


def test_paired_difference_counts_the_runs_of_both_sides():
    rng = np.random.default_rng(9)
    a, b = rng.normal(size=(5, 1)), rng.normal(size=(7, 1))
    bootstrap, wide = ClusterBootstrap(np.arange(20), 8000), np.ones((1, 20))
    found = paired_difference(a * wide, b * wide, bootstrap)
    want = np.hypot(a.std(ddof=1) / np.sqrt(5), b.std(ddof=1) / np.sqrt(7))
    assert found.mean == pytest.approx(a.mean() - b.mean())
    assert found.se == pytest.approx(want, rel=0.04)


def test_median_interval_holds_the_median():
    # binomial order statistics for independent scenes, as a closed form
    y = np.sort(np.random.default_rng(11).exponential(size=200))
    got = bootstrap_median(y, np.arange(200))
    low, high = stats.binom.ppf([0.025, 0.975], 200, 0.5).astype(int)
    assert y[low - 4] <= got.low <= y[low + 3]
    assert y[high - 4] <= got.high <= y[high + 3]


def test_nothing_seen_in_n_trials():
    n = 3420
    exact = 1.0 - 0.05 ** (1.0 / n)
    assert clopper_pearson(0, n, 0.90)[1] == pytest.approx(exact, rel=1e-10)
    assert clopper_pearson(n, n, 0.90)[0] == pytest.approx(1.0 - exact, rel=1e-10)


@pytest.mark.parametrize("pairs", [(0, 0), (9, 14)])
def test_tangos_interval_ends_where_its_score_is_a_normal_quantile(pairs):
    found, z = paired_rates(pairs, 60), stats.norm.ppf(0.975)
    for end, score in ((found.low, z), (found.high, -z)):
        assert float(tango_score(*pairs, 60, end)) == pytest.approx(score, abs=1e-6)
    assert found.mean == (pairs[0] - pairs[1]) / 60


@example([0.02, 0.022, 0.9])  # the second, alone, would be rejected at 0.05
@given(st.lists(st.floats(0.0, 1.0), min_size=0, max_size=8))
def test_holm_equals_the_step_down_rule(p):
    adjusted = holm(np.array(p))
    order = sorted(range(len(p)), key=lambda i: p[i])
    for alpha in (0.01, 0.05, 0.3):
        rejected = set()
        for step, i in enumerate(order):
            if p[i] * (len(p) - step) > alpha:
                break
            rejected.add(i)
        assert {i for i in range(len(p)) if adjusted[i] <= alpha} == rejected


def test_student_over_clusters_is_the_textbook_interval():
    rng = np.random.default_rng(5)
    difference, cluster = rng.normal(0.4, 1.0, 24), np.arange(24) // 4
    found = cluster_t(difference, np.zeros(24), cluster)
    means = difference.reshape(6, 4).mean(axis=1)
    want = stats.ttest_1samp(means, 0.0)
    assert found.p == pytest.approx(want.pvalue)
    interval = want.confidence_interval(0.95)
    assert (found.low, found.high) == pytest.approx((interval.low, interval.high))


@pytest.mark.parametrize(("groups", "named"), [(2, False), (5, False), (6, True)])
def test_clusters_that_all_say_the_same_are_no_certainty(groups, named):
    """p is that of their signs; before enough of them, the interval has no ends."""
    cluster = np.arange(groups)
    found = cluster_t(np.ones(groups), np.zeros(groups), cluster)
    assert (found.mean, found.p) == (1.0, 2.0 ** (1 - groups))
    assert found.is_apart == named
    same = cluster_t(np.ones(groups), np.ones(groups), cluster)
    assert (same.mean, same.low, same.high, same.p) == (0.0, 0.0, 0.0, 1.0)


BOOTSTRAP = ClusterBootstrap(np.arange(5))


@pytest.mark.parametrize(
    ("work", "says"),
    [
        (lambda: ClusterBootstrap(np.zeros(5, int)), "at least 2"),
        (lambda: BOOTSTRAP.means(np.full(5, np.nan)), "all finite"),
        (lambda: BOOTSTRAP.means(np.ones(5), np.arange(5.0)), "weight"),
        (lambda: holm(np.array([0.2, np.nan])), "holm"),
    ],
)
def test_bad_input_is_refused(work, says):
    with pytest.raises(InputError, match=says):
        work()
