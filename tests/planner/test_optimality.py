"""Gap to the finer solver, and steadiness under perception errors."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.paper.plans import (
    Disturbance,
    disturbed,
    spread_over,
    steadiness,
    summary,
)
from rcirl_jax.planner.baselines import rule, rule_policy
from rcirl_jax.planner.dp import emergency_stop, optimality_gap
from rcirl_jax.planner.rank import (
    ONLINE,
    RankConfig,
    rank_policy,
)
from rcirl_jax.sampling.kinematics import trajectory_on_path
from rcirl_jax.sampling.sampler import as_candidates
from rcirl_jax.units import TIMES_S
from tests.helpers.scenes import batch, random_scene, sampled, scene
from tests.planner.test_dp import COARSE, FEATURES, SCORE, SHAPE, planner, weights
from tests.planner.test_safety import judge

MEASURE = jax.jit(
    lambda s, x, w: optimality_gap(s, x, w, FEATURES, SHAPE.activation, COARSE)
)
FREE = scene(v=14.0)


def test_the_gap_is_the_value_to_the_best_admissible_plan():
    """G(x) - G(y) = V(y) - V(x); the lattice's own plan and the stop are among them."""
    w = weights()
    lattice, stop = planner(COARSE)(FREE, w), emergency_stop(FREE)
    candidates = sampled(jax.random.key(0), FREE, ONLINE)
    fine = np.flatnonzero(judge(FREE, candidates).admissible)[[0, 7]]
    plans = [jax.tree.map(lambda x, i=i: x[i], candidates.trajectory) for i in fine]
    plans += [lattice.trajectory, stop]
    values = np.array([float(SCORE(w, FREE, as_candidates(x))[0]) for x in plans])
    passes = np.array(
        [bool(judge(FREE, as_candidates(x)).admissible[0]) for x in plans]
    )
    assert passes[2]
    assert values[2] > values[:2].max()  # so it is the best of every question
    found = [MEASURE(FREE, x, w) for x in plans]
    for v, gap in zip(values[passes], np.array(found)[passes], strict=True):
        assert gap["admissible"]
        assert gap["gap"] == pytest.approx(values[2] - v, abs=1e-4)
        spread = values[2] - values[3]
        assert gap["normalised"] == pytest.approx((values[2] - v) / spread, abs=1e-4)


def test_a_plan_that_may_not_be_driven_has_no_gap():
    wall = scene(v=14.0, boxes=[{"s": 12.0, "speed": 0.0}])
    through = trajectory_on_path(wall, 14.0 * jnp.asarray(TIMES_S, jnp.float32))
    found = MEASURE(wall, through, weights())
    assert not found["admissible"]
    assert np.isnan(found["gap"])
    assert np.isnan(found["normalised"])


def test_disturbances_move_bodies_and_nothing_else():
    made = random_scene(3)
    config = Disturbance()
    still = disturbed(jax.random.key(0), made, dataclasses.replace(
        config, sigma_s=0.0, sigma_l=0.0, sigma_v=0.0, sigma_ego=0.0))  # fmt: skip
    for a, b in zip(jax.tree.leaves(still), jax.tree.leaves(made), strict=True):
        np.testing.assert_array_equal(a, b)
    keys = jax.random.split(jax.random.key(1), 400)
    front = scene(boxes=[{"s": 40.0, "speed": 8.0}])
    many = jax.vmap(lambda k: disturbed(k, front, config))(keys)
    moved = np.asarray(many.obstacles.s_lower - front.obstacles.s_lower)[:, 0]
    assert moved[:, 0].std() == pytest.approx(config.sigma_s, rel=0.15)
    late = np.hypot(config.sigma_s, config.sigma_v * TIMES_S[-1])
    assert moved[:, -1].std() == pytest.approx(late, rel=0.15)
    size = many.obstacles.s_upper - many.obstacles.s_lower
    np.testing.assert_allclose(size[:, 0], 4.5, atol=1e-3)
    np.testing.assert_array_equal(many.path.l[0], front.path.l)


def test_who_does_not_look_is_steady():
    scenes = batch([random_scene(i) for i in range(3)])
    found = steadiness(
        rule_policy, rule("constant speed"), scenes, Disturbance(samples=8)
    )
    np.testing.assert_allclose(found["acceleration_std"], 0.0, atol=1e-6)
    ego = 8.0 * Disturbance().sigma_ego
    assert (found["end_station_std"] < 3.0 * ego).all()
    learned = steadiness(
        rank_policy(SCORE, RankConfig()), weights(), scenes, Disturbance(samples=8)
    )
    assert learned["acceleration_std"].max() > 0.0


def test_a_summary_takes_frames_of_one_drive_for_alike():
    case = np.repeat(np.arange(10), 3)
    values = case + np.tile([-0.1, 0.0, 0.1], 10)
    found, alone = summary(values, case), summary(values, np.arange(30))
    assert found["frames"] == 30
    assert found["mean"] == pytest.approx(values.mean())
    assert found["low"] < found["mean"] < found["high"]
    assert found["high"] - found["low"] > 1.3 * (alone["high"] - alone["low"])


def test_frames_are_thinned_with_their_cases():
    many = batch([random_scene(seed) for seed in range(7)])
    few, case = spread_over(3, many, np.arange(7))
    assert case.tolist() == [0, 3, 6]
    np.testing.assert_array_equal(few.ego.v, np.asarray(many.ego.v)[case])
    assert spread_over(50, many, np.arange(7))[1].size == 7
