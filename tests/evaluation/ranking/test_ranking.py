"""Ranking metrics against loops over scenes and candidates, written apart."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.metrics import (
    METRICS,
    Outcomes,
    fit_temperature,
    random_scorer,
    scene_metrics,
)


def make(seed, scenes=30, candidates=7, feasible=0.7):
    rng, shape = np.random.default_rng(seed), (scenes, candidates)
    fde = rng.gamma(2.0, 3.0, shape)
    ade = np.round(rng.gamma(2.0, 1.0, shape), 1)  # some ties
    crash, possible = rng.random(shape) < 0.3, rng.random(shape) < feasible
    cluster, human = rng.integers(0, 8, scenes), rng.random(scenes) < 0.1
    return Outcomes(
        fde=fde, ade=ade, crash=crash, feasible=possible, cluster=cluster,
        human_crash=human,
    )  # fmt: skip


def integer_values(seed, outcomes):
    """Values with many ties, also with the human."""
    rng = np.random.default_rng(seed)
    shape = outcomes.fde.shape
    values = rng.integers(0, 4, shape).astype(float)
    # must never be read, and wins and loses nothing
    odd = rng.choice([np.nan, -1e9, 1e9], shape)
    values = np.where(outcomes.feasible, values, odd)
    return values, rng.integers(0, 4, shape[0]).astype(float)


def one_scene(values, human, o, s, temperature):
    """The definitions, one scene at a time, with lists."""
    allowed = [k for k in range(o.fde.shape[1]) if o.feasible[s, k]]
    limit = 6.0 + (o.horizon_s - 5.0) * 2.0 / 3.0
    if not allowed:
        fde, crash = o.fde[s, 0], o.crash[s, 0] and not o.human_crash[s]
        zero = ("percentile_rank", "pairwise_accuracy", "mrr", "human_top1")
        one = ("num_pairs", "failure_rate", "miss")
        return (
            dict.fromkeys(zero, 0.0)
            | dict.fromkeys(one, 1.0)
            | {
                **dict.fromkeys(("top1_fde", "top3_fde"), fde),
                **{f"top{n}_fde_failure": max(fde, o.failure_m) for n in (1, 3)},
                "top1_ade": o.ade[s, 0],
                "nll": math.log(o.fde.shape[1]),
                "crash_rate": float(crash),
            }
        )

    def charged(k):
        crash = o.crash[s, k] and not o.human_crash[s]
        return max(o.fde[s, k], o.failure_m) if crash else o.fde[s, k]

    points = sum(
        1.0 if values[s, k] < human[s] else 0.5 if values[s, k] == human[s] else 0.0
        for k in allowed
    )
    ranked = sorted(allowed, key=lambda k: (-values[s, k], k))
    near = min(allowed, key=lambda k: (o.ade[s, k], k))
    places = [i + 1 for i, k in enumerate(ranked) if values[s, k] == values[s, near]]
    chances = log_softmax([values[s, k] / temperature for k in allowed])
    crash = float(o.crash[s, ranked[0]] and not o.human_crash[s])
    return {
        "percentile_rank": points / len(allowed),
        "pairwise_accuracy": points / len(allowed),
        "num_pairs": float(len(allowed)),
        "human_top1": float(all(values[s, k] < human[s] for k in allowed)),
        "top1_fde": o.fde[s, ranked[0]],
        "top1_ade": o.ade[s, ranked[0]],
        "top3_fde": min(o.fde[s, k] for k in ranked[:3]),
        "top1_fde_failure": charged(ranked[0]),
        "top3_fde_failure": min(charged(k) for k in ranked[:3]),
        "mrr": 1.0 / (sum(places) / len(places)),
        "nll": -chances[allowed.index(near)],
        "crash_rate": crash,
        "failure_rate": crash,
        "miss": float(o.fde[s, ranked[0]] > limit),
    }


@given(
    seed=st.integers(0, 10**6),
    candidates=st.integers(1, 9),
    feasible=st.sampled_from([0.1, 0.5, 1.0]),
    horizon=st.sampled_from([3.0, 5.0, 8.0]),
)
def test_every_metric_equals_the_loop(seed, candidates, feasible, horizon):
    o = make(seed, scenes=12, candidates=candidates, feasible=feasible)
    o = dataclasses.replace(o, horizon_s=horizon)
    values, human = integer_values(seed + 1, o)
    got = scene_metrics(values, human, o, temperature=0.7)
    assert set(METRICS) | {"num_pairs"} == set(got)
    for s in range(12):
        want = one_scene(values, human, o, s, 0.7)
        assert set(want) == set(got)
        for name, number in want.items():
            assert got[name][s] == pytest.approx(number, abs=1e-12), (name, s)


def test_random_scorer_is_at_chance_and_repeats():
    o = make(7, scenes=4000, candidates=20, feasible=1.0)
    values, human = random_scorer(11, o.fde.shape)
    again, _ = random_scorer(11, o.fde.shape)
    other, _ = random_scorer(12, o.fde.shape)
    np.testing.assert_array_equal(values, again)
    assert np.mean(values == other) < 1e-3
    got = scene_metrics(values, human, o)
    assert got["percentile_rank"].mean() == pytest.approx(0.5, abs=0.02)
    assert got["human_top1"].mean() == pytest.approx(1 / 21, abs=0.015)
    harmonic = np.mean(1.0 / np.arange(1, 21))
    assert got["mrr"].mean() == pytest.approx(harmonic, abs=0.02)


def mean_nll(values, o, temperature):
    some = o.feasible.any(axis=1)
    found = scene_metrics(values, np.zeros(len(values)), o, temperature)
    return found["nll"][some].mean()


@settings(max_examples=10)
@given(seed=st.integers(0, 10**6), noise=st.floats(0.3, 3.0))
def test_fitted_temperature_is_where_scipy_finds_it(seed, noise):
    o = make(seed, scenes=200)
    rng = np.random.default_rng(seed)
    values = -o.ade + noise * rng.normal(size=o.ade.shape)
    found = minimize_scalar(
        lambda u: mean_nll(values, o, math.exp(u)),
        bounds=(-6.0, 8.0),
        method="bounded",
        options={"xatol": 1e-9},
    )
    got = fit_temperature(values, o)
    assert math.log(got) == pytest.approx(found.x, abs=1e-5)


def test_temperature_stays_finite_at_both_ends():
    o = make(2, feasible=1.1)
    sure = np.zeros(o.ade.shape)
    sure[np.arange(30), np.argmin(o.ade, axis=1)] = 1.0
    spread = sure.std(axis=1).mean()
    assert fit_temperature(sure, o) == pytest.approx(1e-4 * spread, rel=1e-9)
    assert fit_temperature(-sure, o) == pytest.approx(1e4 * spread, rel=1e-9)
    assert fit_temperature(np.full(sure.shape, 3.3), o) == 1.0


def test_bad_input_is_one_clear_line():
    o = make(1)
    values, human = random_scorer(0, o.fde.shape)
    o = dataclasses.replace(o, feasible=np.ones_like(o.feasible))
    with pytest.raises(InputError, match="scenes, first 0"):
        scene_metrics(values, np.full(30, np.nan), o)
    values[4:, 0] = np.inf
    with pytest.raises(InputError, match="scenes, first 4"):
        scene_metrics(values, human, o)
    nothing = dataclasses.replace(o, feasible=np.zeros_like(o.feasible))
    with pytest.raises(InputError, match="no scene has a candidate"):
        fit_temperature(values, nothing)
