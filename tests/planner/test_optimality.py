"""Gap to the finer solver, and steadiness under perception errors."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.evaluation.closed_loop.robustness import (
    Disturbance,
    decision,
    disturbed,
    spread_over,
    steadiness,
    summary,
)
from rcirl_jax.planner.optimality import GapConfig, emergency_stop, optimality_gap
from rcirl_jax.planner.rank import (
    ONLINE,
    RankConfig,
    constant_speed_policy,
    rank_policy,
)
from rcirl_jax.planner.refine import RefineConfig
from rcirl_jax.units import TIMES_S
from tests.helpers.scenes import batch, random_scene, sampled, scene
from tests.planner.test_dp import COARSE, FEATURES, SCORE, SHAPE, one, planner, weights
from tests.planner.test_safety import judge

GAP = GapConfig(
    lattice=dataclasses.replace(COARSE, step=4.0), refinement=RefineConfig(steps=6)
)
MEASURE = jax.jit(
    lambda s, x, w: optimality_gap(s, x, w, FEATURES, SHAPE.activation, GAP)
)
FREE = scene(v=14.0)


@pytest.mark.slow
def test_the_best_known_plan_has_no_gap_and_others_have():
    """A plan of the gap's own lattice loses only what local ascent adds."""
    w = weights()
    plan = planner(GAP.lattice)(FREE, w)
    found = MEASURE(FREE, plan.trajectory, w)
    assert found["known"]
    assert found["gap"] >= -1e-6
    stop = MEASURE(FREE, emergency_stop(FREE), w)
    assert stop["gap"] >= found["gap"]


def test_no_admissible_candidate_beats_the_best_known_by_much():
    """Every sampled plan's gap is what its value says: G(x) - G(y) = V(y) - V(x)."""
    w = weights()
    candidates = sampled(jax.random.key(0), FREE, ONLINE)
    fine = np.flatnonzero(judge(FREE, candidates).admissible)[[0, 7]]
    values = np.asarray(SCORE(w, FREE, candidates))[fine]
    picked = [jax.tree.map(lambda x, i=i: x[i], candidates.trajectory) for i in fine]
    found = [MEASURE(FREE, x, w) for x in picked]
    for x, v, gap in zip(picked, values, found, strict=True):
        assert gap["value"] == pytest.approx(float(v), abs=1e-4)
        assert gap["gap"] >= -1e-6
        assert gap["value"] + gap["gap"] == pytest.approx(float(gap["best_value"]))
        assert bool(judge(FREE, one(x)).admissible[0])
    stop = MEASURE(FREE, emergency_stop(FREE), w)
    assert stop["normalised"] == pytest.approx(1.0, abs=1e-4)
    assert stop["progress_regret"] > 0.0


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


def test_decision_says_on_which_side_the_plan_ends():
    boxes = [{"s": 40.0}, {"s": -20.0, "l": 0.2}, {"s": 40.0, "l": 5.0}]
    made = scene(v=5.0, boxes=boxes)
    s = jnp.linspace(0.0, 20.0, TIMES_S.size)
    np.testing.assert_array_equal(decision(made, s)[:4], [-1, 1, 0, 0])
    np.testing.assert_array_equal(decision(made, 4.0 * s)[:4], [1, 1, 0, 0])


def test_who_does_not_look_is_steady():
    scenes = batch([random_scene(i) for i in range(3)])
    found = steadiness(constant_speed_policy, None, scenes, Disturbance(samples=8))
    np.testing.assert_allclose(found["acceleration_std"], 0.0, atol=1e-6)
    ego = 8.0 * Disturbance().sigma_ego
    assert (found["end_station_std"] < 3.0 * ego).all()
    # wherever the others are seen: what is decided is where the own plan goes
    blind = Disturbance(samples=8, sigma_ego=0.0)
    found = steadiness(constant_speed_policy, None, scenes, blind)
    np.testing.assert_array_equal(found["flip_rate"], 0.0)
    learned = steadiness(
        rank_policy(SCORE, RankConfig()), weights(), scenes, Disturbance(samples=8)
    )
    assert ((learned["flip_rate"] >= 0.0) & (learned["flip_rate"] <= 1.0)).all()
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
