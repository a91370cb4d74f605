"""The driver model tuned on the ranking; its search, its row."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.evaluation.baselines.cma_es import tune
from rcirl_jax.evaluation.baselines.objectives import (
    DRIVER,
    TUNABLE_IDM,
    Problem,
    idm_of,
    mean_fde,
    valued_scenes,
)
from rcirl_jax.evaluation.baselines.tuned import SEARCHES, _best, as_numbers
from rcirl_jax.evaluation.ranking.score import candidates_key, measure_scenes
from rcirl_jax.planner.baselines import TUNED_IDM_ROW, Idm, closeness, idm_trajectory
from rcirl_jax.reward import LatticeCost
from rcirl_jax.sampling import SamplerConfig
from tests.evaluation.driven import mean_chosen_fde, scored_baselines
from tests.helpers.scenes import sampled
from tests.helpers.stored import long_rows

SMALL = SamplerConfig(num_random=16, cruise_times=(4.0,), edge_times=(4.0,))
SCENES = 24
INDEX = np.arange(SCENES)
HIDDEN = np.array([0.5, 0.3, -0.8, -0.5, -0.4])


@functools.cache
def driven_by_a_hidden_driver():
    """Demonstrations of 8 s whose human is the candidate nearest to a hidden driver."""
    rows = long_rows(SCENES)
    scenes = valued_scenes(DRIVER, rows, INDEX, SMALL, 8.0)
    driver = idm_of(jnp.asarray(HIDDEN, jnp.float32))

    def nearest(one):
        scene, everyone, mask = one.known
        way = idm_trajectory(scene, True, driver)
        near = jax.vmap(lambda x: closeness(x, way, mask))(everyone)
        best = jnp.argmax(jnp.where(one.feasible, near, -jnp.inf))
        return jax.tree.map(lambda x: x[best], everyone)

    human = jax.tree.map(np.asarray, jax.jit(jax.vmap(nearest))(scenes))
    return rows.replace(human=human)


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
    rows, hidden = driven_by_a_hidden_driver(), idm_of(jnp.asarray(HIDDEN, jnp.float32))
    tuned = {TUNED_IDM_ROW: hidden, "again": Idm(), "cost": LatticeCost()}
    scored = scored_baselines(rows, SMALL, tuned)
    np.testing.assert_allclose(
        scored.values["again"], scored.values["IDM"], rtol=1e-5, atol=1e-4
    )
    np.testing.assert_allclose(
        scored.values["cost"], scored.values["hand-set"], rtol=1e-5, atol=1e-3
    )
    found = [mean_chosen_fde(scored, name) for name in ("IDM", TUNED_IDM_ROW)]
    scenes = valued_scenes(DRIVER, rows, INDEX, SMALL, 8.0)
    both = np.stack([np.zeros(len(TUNABLE_IDM)), HIDDEN])
    usual, hidden = mean_fde(DRIVER, scenes, both)
    np.testing.assert_allclose(found, [usual, hidden], atol=0.05)
    assert hidden < 0.05
    _, best = tune(lambda x: mean_fde(DRIVER, scenes, x), both[0], 1.0, 200, 0)
    assert best < 0.5 * usual


def test_the_search_that_is_asked_for_is_taken(monkeypatch):
    seen = []

    def found(objective, start, sigma, budget, seed):
        seen.append((start.size, budget, seed))
        return HIDDEN, 0.0

    monkeypatch.setitem(SEARCHES, "optuna", found)
    made = Problem(objective=lambda vectors: np.zeros(len(vectors)), queries=1)
    best = _best(DRIVER, made, 7, 3, "optuna")
    assert seen == [(len(TUNABLE_IDM), 7, 3)]
    assert best.fields() == idm_of(jnp.asarray(HIDDEN, jnp.float32)).fields()


def test_candidates_are_those_of_the_evaluation():
    rows = driven_by_a_hidden_driver()
    scenes = valued_scenes(DRIVER, rows, INDEX, SMALL, 8.0)
    one = jax.tree.map(lambda x: jnp.asarray(x[3]), rows.scene)
    expected = sampled(candidates_key(jnp.asarray(3)), one, SMALL).trajectory
    np.testing.assert_allclose(scenes.known[1].s[3], expected.s, atol=1e-3)


def test_distances_alone_are_those_of_the_scores():
    """What an import's oracle floor measures, over a padded chunk."""
    rows = driven_by_a_hidden_driver()
    scored = scored_baselines(rows, SMALL, {})
    near = measure_scenes(rows, INDEX, sampler=SMALL, horizon_s=8.0, futures="recorded")
    for name in ("feasible", "fde", "ade"):
        found, wanted = getattr(near, name), getattr(scored, name)
        np.testing.assert_allclose(found, wanted, atol=1e-4)
