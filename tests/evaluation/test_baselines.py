"""Tuned baselines: the searches, what they minimise, and their rows."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation import baselines
from rcirl_jax.evaluation.baselines import (
    DRIVER,
    HAND_SET,
    REACH,
    TUNABLE_IDM,
    ValuedScenes,
    as_numbers,
    idm_of,
    mean_fde,
    tune,
    tuned_baselines,
    valued_scenes,
)
from rcirl_jax.evaluation.ranking.score import (
    RankingSetup,
    measure_scenes,
    score_scenes,
)
from rcirl_jax.planner.baselines import TUNED_IDM_ROW, Idm, closeness, idm_trajectory
from rcirl_jax.reward import (
    TUNABLE,
    LatticeCost,
    tuned,
)
from rcirl_jax.reward.hand import LatticeTerms
from rcirl_jax.sampling import SamplerConfig, num_candidates
from tests.helpers.scenes import T
from tests.helpers.stored import long_rows

D = len(TUNABLE)
SMALL = SamplerConfig(num_random=16, cruise_times=(4.0,), edge_times=(4.0,))


# ------------------------------------------------------------------ the searches


class Counted:
    def __init__(self, function):
        self.function, self.seen = function, []

    def __call__(self, vectors):
        self.seen += list(vectors)
        return np.array([self.function(x) for x in vectors])


def sphere(x):
    return float(np.sum((x - np.arange(x.size) / 3.0) ** 2))


def search(function, budget, seed=0, d=D, by="cma"):
    if by == "optuna":
        pytest.importorskip("optuna")
    return tune(function, np.zeros(d), 0.5, budget, seed, by)


def test_cma_es_finds_the_minimum_of_a_shifted_sphere():
    best, value = search(Counted(sphere), 1500)
    np.testing.assert_allclose(best, np.arange(D) / 3.0, atol=1e-3)
    assert value == sphere(best) < 1e-6


def test_tpe_comes_near_the_minimum_of_a_shifted_sphere_within_its_box():
    counted = Counted(sphere)
    best, value = search(counted, 120, d=3, by="optuna")
    assert value == sphere(best) < 0.3 * sphere(np.zeros(3))
    assert np.abs(counted.seen).max() <= 0.5 * REACH


@pytest.mark.parametrize("by", ["cma", "optuna"])
@pytest.mark.parametrize("budget", [1, 31])
def test_it_takes_the_budget_and_never_more_from_the_start_on(budget, by):
    counted = Counted(sphere)
    assert search(counted, budget, by=by)[1] <= sphere(np.zeros(D))
    assert len(counted.seen) == budget
    np.testing.assert_array_equal(counted.seen[0], np.zeros(D))


@pytest.mark.parametrize("by", ["cma", "optuna"])
def test_the_seed_alone_decides(by):
    first = search(Counted(sphere), 50, seed=3, by=by)
    np.random.seed(17)  # noqa: NPY002  # a state that must not matter
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    again = search(Counted(sphere), 50, seed=3, by=by)
    np.testing.assert_array_equal(before, np.random.get_state()[1])  # noqa: NPY002
    np.testing.assert_array_equal(first[0], again[0])
    assert search(Counted(sphere), 50, seed=4, by=by)[1] != first[1]


@pytest.mark.parametrize("by", ["cma", "optuna"])
def test_nan_is_the_worst_and_nothing_finite_is_refused(by):
    walled = Counted(lambda x: sphere(x) if x[1] < 0.2 else np.nan)
    best, value = search(walled, 60, by=by)
    assert best[1] < 0.2
    assert np.isfinite(value)
    with pytest.raises(InputError, match="nowhere finite"):
        search(Counted(lambda _: np.nan), 30, by=by)


def test_an_equal_budget_is_in_queries(monkeypatch):
    class Scenes:
        def indices(self, split):
            return np.arange(2000)

    each, budgets = num_candidates(SMALL), []
    monkeypatch.setattr(baselines, "problem", lambda *_: (sphere, 256 * each))
    monkeypatch.setattr(baselines, "_best", lambda *given: budgets.append(given[2]))
    rows = functools.partial(
        tuned_baselines, Scenes(), RankingSetup(sampler=SMALL), seeds=[0], long=7
    )
    rows(epochs=20)
    assert budgets == [2000 * 20 // 256, 2000 * 20 // 256, 7]
    with pytest.raises(InputError, match=r"epochs: 0: 0 queries: expected"):
        rows(epochs=0)


# -------------------------------------------------------------------- the cost


def test_zeros_are_apollos_weights_exactly():
    weights = tuned(jnp.zeros(D))
    for name, value in LatticeCost().fields().items():
        assert float(getattr(weights, name)) == float(value)


def random_ranked(scenes, candidates, seed=0):
    rng = np.random.default_rng(seed)
    shape = (scenes, candidates)
    draw = lambda *tail: jnp.asarray(rng.uniform(0.1, 20.0, (*shape, *tail)), "float32")  # noqa: E731
    approach = jnp.where(draw(T) > 6.0, jnp.inf, draw(T))
    terms = {name: draw(T) for name in ("limit", "speed", "early")}
    for name in LatticeTerms._fields[4:-1]:
        terms[name] = draw()
    collides = jnp.asarray(rng.uniform(size=shape) < 0.1)
    terms = LatticeTerms(**terms, approach=approach, collides=collides)
    feasible = jnp.asarray(rng.uniform(size=shape) < 0.7).at[0].set(False)
    return ValuedScenes(known=terms, fde=draw(), feasible=feasible)


def slowly(scenes, vector):
    """Mean FDE in float64 numpy."""
    t = {k: np.asarray(x, np.float64) for k, x in scenes.known._asdict().items()}
    weights = tuned(jnp.asarray(vector, jnp.float32)).fields()
    w = {name: float(x) for name, x in weights.items()}
    reference = np.minimum(w["speed_share"] * t["limit"], t["approach"])
    off = np.sum(t["early"] * np.abs(reference - t["speed"]), -1) / t["early"].sum(-1)
    near, far = w["objective_speed"], w["objective_distance"]
    cost = w["objective"] * (near * off + far / (1 + t["travelled"])) / (near + far)
    for name in LatticeTerms._fields[5:-1]:
        cost = cost + w[name] * t[name]
    cost = cost + w["collision_check"] * t["collides"]
    cost = np.where(np.asarray(scenes.feasible), cost, np.inf)
    return np.asarray(scenes.fde)[np.arange(len(cost)), cost.argmin(axis=1)].mean()


def test_mean_fde_against_numpy_in_any_company():
    """More sums in one program than jaxlib 0.10.2 gets right at once on a CPU."""
    scenes = random_ranked(600, 70)
    vectors = np.random.default_rng(1).normal(size=(11, D))
    of = functools.partial(mean_fde, HAND_SET, scenes)
    together = of(vectors)
    expected = [slowly(scenes, x) for x in vectors]
    np.testing.assert_allclose(together, expected, atol=0.02)  # near ties
    np.testing.assert_array_equal(together[::-1], of(vectors[::-1]))
    np.testing.assert_array_equal(together[3:4], of(vectors[3:4]))


# ------------------------------------------------------------------ the driver

OF_DRIVER = 24
DRIVEN = np.arange(OF_DRIVER)
SETUP = RankingSetup(sampler=SMALL, horizon_s=8.0, futures="recorded")
HIDDEN_DRIVER = np.array([0.5, 0.3, -0.8, -0.5, -0.4])


@functools.cache
def driven_by_a_hidden_driver():
    """Demonstrations of 8 s whose human is the candidate nearest to a hidden driver."""
    rows = long_rows(OF_DRIVER)
    scenes = valued_scenes(DRIVER, rows, DRIVEN, SMALL, 8.0)
    driver = idm_of(jnp.asarray(HIDDEN_DRIVER, jnp.float32))

    def nearest(one):
        scene, everyone, mask = one.known
        way = idm_trajectory(scene, True, driver)
        near = jax.vmap(lambda x: closeness(x, way, mask))(everyone)
        best = jnp.argmax(jnp.where(one.feasible, near, -jnp.inf))
        return jax.tree.map(lambda x: x[best], everyone)

    human = jax.tree.map(np.asarray, jax.jit(jax.vmap(nearest))(scenes))
    return rows.replace(human=human)


def scored_baselines(rows, tuned):
    """`score_scenes` of the baselines alone, at 8 s."""
    runs = {name: [baseline] for name, baseline in tuned.items()}
    scored = score_scenes(rows, DRIVEN, dataclasses.replace(SETUP, tuned=runs), {})
    values = {name.removesuffix("#0"): x for name, x in scored.values.items()}
    return dataclasses.replace(scored, values=values)


def mean_chosen_fde(scored, name):
    """m, of the feasible candidate that a row values most."""
    values = np.where(scored.outcomes.feasible, scored.values[name], -np.inf)
    return scored.outcomes.fde[np.arange(len(values)), values.argmax(axis=1)].mean()


def test_zeros_are_the_usual_driver_and_bounds_hold():
    usual = idm_of(jnp.zeros(len(TUNABLE_IDM)))
    for name, value in Idm().fields().items():
        assert float(getattr(usual, name)) == float(value), name
    wild = idm_of(jnp.full(len(TUNABLE_IDM), 50.0))
    assert float(wild.headway) == pytest.approx(Idm().headway * np.exp(3.0))
    assert float(wild.max_braking) == Idm().max_braking
    (numbers,) = as_numbers([Idm(headway=1.2)])
    assert numbers["headway"] == pytest.approx(1.2)
    assert set(numbers) == set(Idm().fields())


def test_the_search_comes_close_to_a_hidden_driver_by_what_the_report_measures():
    rows = driven_by_a_hidden_driver()
    hidden = idm_of(jnp.asarray(HIDDEN_DRIVER, jnp.float32))
    tuned = {TUNED_IDM_ROW: hidden, "again": Idm(), "cost": LatticeCost()}
    scored = scored_baselines(rows, tuned)
    np.testing.assert_allclose(
        scored.values["again"], scored.values["IDM"], rtol=1e-5, atol=1e-4
    )
    np.testing.assert_allclose(
        scored.values["cost"], scored.values["hand-set"], rtol=1e-5, atol=1e-3
    )
    found = [mean_chosen_fde(scored, name) for name in ("IDM", TUNED_IDM_ROW)]
    scenes = valued_scenes(HAND_SET, rows, DRIVEN, SMALL, 8.0)
    (usual,) = mean_fde(HAND_SET, scenes, np.zeros((1, D)))
    assert mean_chosen_fde(scored, "hand-set") == pytest.approx(usual, abs=0.05)
    scenes = valued_scenes(DRIVER, rows, DRIVEN, SMALL, 8.0)
    both = np.stack([np.zeros(len(TUNABLE_IDM)), HIDDEN_DRIVER])
    usual, hidden = mean_fde(DRIVER, scenes, both)
    np.testing.assert_allclose(found, [usual, hidden], atol=0.05)
    assert hidden < 0.05
    _, best = tune(lambda x: mean_fde(DRIVER, scenes, x), both[0], 1.0, 200, 0)
    assert best < 0.5 * usual


def test_distances_alone_are_those_of_the_scores():
    """What an import's oracle floor measures, over a padded chunk."""
    rows = driven_by_a_hidden_driver()
    scored = scored_baselines(rows, {})
    near = measure_scenes(rows, DRIVEN, SETUP)
    for name in ("feasible", "fde", "ade"):
        found, wanted = getattr(near, name), getattr(scored.outcomes, name)
        np.testing.assert_allclose(found, wanted, atol=1e-4)
