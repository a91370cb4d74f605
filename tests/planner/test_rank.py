"""The ranking planner: argmax of admissible scores, exact lag, IDM by hand."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.features import feature_map
from rcirl_jax.planner.baselines import Idm, idm_acceleration, rule, rule_policy
from rcirl_jax.planner.plan import (
    ACTUATOR_LAG_S,
    COMMAND_STEP_S,
    command,
    later,
    no_plan,
    plan_of,
    stations_from_now,
)
from rcirl_jax.planner.rank import (
    ONLINE,
    RankConfig,
    constant_score,
    learned_score,
    rank_policy,
    velocity_score,
)
from rcirl_jax.reward import RewardConfig, RewardModel, value
from rcirl_jax.types import Kind
from tests.helpers.scenes import random_scene, sampled
from tests.planner.test_dp import weights
from tests.planner.test_safety import judge, with_obstacle

FEATURES = feature_map("paper21")
SCORE = jax.jit(learned_score(FEATURES, "tanh"))


def scene_of(seed):
    return jax.tree.map(jnp.asarray, random_scene(seed))


@pytest.mark.parametrize("name", ["learned", "constant", "velocity"])
def test_drives_the_best_admissible_candidate(name):
    """By V; the trivial baselines the first, and that of the highest mean speed."""
    score = {"learned": SCORE, "constant": constant_score, "velocity": velocity_score}
    policy = jax.jit(rank_policy(score[name], RankConfig()))
    for seed in range(3):
        made, key = scene_of(seed), jax.random.key(seed)
        plan = policy(weights() if name == "learned" else None, made, key)
        candidates = sampled(key, made, ONLINE)
        mean = np.asarray(candidates.trajectory.v)[:, made.time_valid].mean(axis=1)
        wanted = {"constant": -np.arange(mean.size), "velocity": mean}
        if name == "learned":
            wanted[name] = np.asarray(SCORE(weights(), made, candidates))
        ok = np.asarray(judge(made, candidates).admissible)
        assert int(plan.admissible) == ok.sum()
        assert bool(plan.fallback) is (not ok.any())
        if ok.any():
            best = int(np.argmax(np.where(ok, wanted[name], -np.inf)))
            driven = candidates.trajectory.s[best]
            np.testing.assert_allclose(plan.s, driven, atol=1e-3)


def test_scores_are_the_reward_of_training():
    made = scene_of(2)
    candidates = sampled(jax.random.key(0), made, ONLINE)
    params, norm = weights()
    mask = jnp.broadcast_to(made.time_valid, (64, 18))
    model = RewardModel(RewardConfig(scale_constraint="none"))
    features = jax.jit(FEATURES.of_candidates)(made, candidates)
    expected = value(model, params, norm, features, mask)
    np.testing.assert_allclose(
        SCORE((params, norm), made, candidates), expected, rtol=1e-5, atol=1e-5
    )


def test_command_leads_the_lag_so_that_the_plan_is_met():
    made = with_obstacle(Kind.NONE, 0.0, 0.0)
    candidates = sampled(jax.random.key(0), made, ONLINE)
    x = jax.tree.map(lambda a: a[4], candidates.trajectory)
    x = x.replace(a=x.a.at[0].set(0.5).at[1].set(1.5), s=x.s.at[1].set(8.0))
    asked = float(command(plan_of(x), x.v[0]))
    moved = 1 - math.exp(-COMMAND_STEP_S / ACTUATOR_LAG_S)
    reached = 0.5 + (asked - 0.5) * moved
    assert reached == pytest.approx(0.5 + COMMAND_STEP_S / (8 / 17), rel=1e-3)
    # half an interval later the planned acceleration is half way on
    rest = plan_of(x).replace(since=jnp.asarray(0.5 * 8 / 17))
    rise = float(x.a[2]) - 1.5
    lead = COMMAND_STEP_S / moved - 0.5 * 8 / 17
    wanted = 1.5 + rise * lead * 17 / 8
    assert float(command(rest, x.v[0])) == pytest.approx(wanted, rel=1e-3)


def test_a_plan_goes_on_where_it_was():
    made = with_obstacle(Kind.NONE, 0.0, 0.0, v=8.0)
    plans = sampled(jax.random.key(0), made, ONLINE).trajectory
    x = jax.tree.map(lambda a: a[7], plans)
    plan = plan_of(x)
    np.testing.assert_allclose(stations_from_now(plan), x.s, atol=1e-4)
    step = 3 * 8 / 17
    rest = stations_from_now(later(plan, step))
    np.testing.assert_allclose(rest[:-3], x.s[3:] - x.s[3], atol=1e-3)
    beyond = x.s[-1] - x.s[3] + step * x.v[-1]
    assert float(rest[-1]) == pytest.approx(float(beyond), rel=1e-4)


def test_the_plan_in_force_is_kept_while_it_is_admissible_and_young():
    made, key = with_obstacle(Kind.NONE, 0.0, 0.0, v=8.0), jax.random.key(0)
    slow = lambda _, scene, x: -x.trajectory.v[:, -1]  # noqa: E731
    fast = lambda _, scene, x: x.trajectory.v[:, -1]  # noqa: E731
    config = RankConfig(commitment=1.0)
    first = jax.jit(rank_policy(fast, config))(None, made, key, no_plan())
    assert float(first.since) == 0.0
    assert bool(first.lasts)
    policy = jax.jit(rank_policy(slow, config))
    for since, kept in ((0.5, True), (1.5, False)):
        found = policy(None, made, key, later(first, since))
        assert (float(found.since) == since) is kept
    wall = with_obstacle(Kind.VEHICLE, 12.0, 0.0, v=8.0, speed=0.0)
    assert float(policy(None, wall, key, later(first, 0.5)).since) == 0.0


def test_a_plan_that_rests_within_the_first_interval_is_braked_to_rest():
    made = with_obstacle(Kind.NONE, 0.0, 0.0, v=0.5)
    plans = sampled(jax.random.key(0), made, ONLINE).trajectory
    x = jax.tree.map(lambda a: a[0], plans)
    still = x.replace(s=jnp.full_like(x.s, 0.03).at[0].set(0.0), a=x.a * 0.0)
    urgent = float(command(plan_of(still, urgent=True), still.v[0]))
    assert urgent == pytest.approx(-0.25 / 0.06, rel=0.05)
    assert urgent < float(command(plan_of(still), still.v[0])) < -0.3


def test_idm_policy_is_the_formula():
    made = with_obstacle(Kind.VEHICLE, 30.0, 0.0, v=12.0, speed=8.0)
    plan = rule_policy(rule("IDM"), made, jax.random.key(0))
    gap = 28.0 - 0.5 * float(made.ego.length)
    f = jnp.float32
    expected = idm_acceleration(f(12.0), f(gap), f(4.0), f(30.0), Idm())
    assert float(command(plan, f(12.0))) == pytest.approx(float(expected), rel=1e-4)
