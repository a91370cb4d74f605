"""The closed loop: reproducible, independent of batches, padded, seeded."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.common import untrained
from rcirl_jax.planner.baselines import CAREFUL
from rcirl_jax.planner.rank import RankConfig, ranking
from rcirl_jax.runtime.compiling import compiles
from rcirl_jax.simulation.cases import NUM_AGENTS, STEP_S, Replay
from rcirl_jax.simulation.metrics import MetricsConfig, case_metrics
from rcirl_jax.simulation.rollout import LANES, SPAN, RolloutConfig, drive_cases
from rcirl_jax.simulation.rows import (
    BASELINES,
    baseline_row,
    judges,
    learned_row,
    rule_row,
)
from rcirl_jax.simulation.suite import build, drive_row, suite_refs
from rcirl_jax.simulation.world import perceive, start
from rcirl_jax.units import TIMES_S
from tests.simulation.drives import constant, drive, stack
from tests.simulation.worlds import make_case

CONFIG = RolloutConfig(steps=100)
IDM = rule_row("IDM", "IDM")


def metrics_of(row, chunk, seconds=10.0, order=slice(None)):
    refs = suite_refs("cut_in,pedestrian", 20)[order]
    config = RolloutConfig(steps=round(seconds / STEP_S))
    cases = lambda a, b: build(refs[a:b], seconds)  # noqa: E731
    return drive_row(row, cases, len(refs), config, chunk=chunk)


def is_same(first, again):
    return all(jax.tree.leaves(jax.tree.map(np.array_equal, first, again)))


def test_a_table_is_two_programs():
    """One for whatever ranks candidates, one for all driver models and the judges."""
    weights, config = untrained(), RankConfig()
    learned = learned_row("learned", weights, "paper21", "tanh", config)
    gained = dataclasses.replace(learned, params=ranking(weights, "hand-set", 2.0))
    rows = [learned, gained, *judges(), rule_row("slow", "IDM", CAREFUL)]
    rows += [baseline_row(name, "paper21", weights, config) for name in BASELINES]
    with compiles("jit(run)") as made:
        found = [metrics_of(row, LANES, 4.0, slice(3)) for row in rows]
    assert len(made) <= 2
    assert len({row.policy for row in rows}) == 2
    # each drives by its own numbers
    ways = {tuple(one.progress.tolist()) for one in found}
    assert len(ways) >= 8


@pytest.mark.parametrize("name", ["IDM", "random weights"])
def test_batch_size_and_company_change_no_bit(name):
    """Of both programs: driver models, and whatever ranks candidates."""
    row = IDM
    if name != "IDM":
        row = baseline_row(name, "paper21", untrained(), RankConfig())
    first = metrics_of(row, 2 * LANES, 2.0)
    assert np.unique(first.progress).size > 2
    for chunk in (LANES, 7):
        assert is_same(first, metrics_of(row, chunk, 2.0)), chunk
    # other lanes, other company, none
    for order in (slice(None, None, -1), slice(1, None, 3), slice(25, 26)):
        again = metrics_of(row, LANES, 2.0, order)
        assert is_same(jax.tree.map(lambda x, o=order: x[o], first), again), order


def test_padding_steps_do_not_count():
    long, short = make_case(speed=10.0, steps=300), make_case(speed=10.0, steps=50)
    record, _ = drive([long, short])
    assert record.valid[0].all()
    assert record.valid[1].sum() == 50
    found = jax.jit(jax.vmap(lambda r: case_metrics(r, MetricsConfig())))(record)
    assert float(found.progress[1]) == pytest.approx(50.0, rel=1e-3)
    assert int(found.samples[1]) == 50


def test_a_plan_stays_in_force_and_new_weights_do_not_compile_again():
    traces = []

    def policy(params, scene, key, before):
        traces.append(1)
        return constant(params + scene.ego.v - 10.0, scene, key)

    for value in (0.5, 1.0):
        record, _ = drive(
            [make_case(speed=10.0)], steps=20, policy=policy, params=value, plan_every=5
        )
        commands = record.command[0]
        assert np.unique(commands[:5]).size == np.unique(commands[5:10]).size == 1
        assert commands[5] != commands[4]
    assert len(traces) == 1


def test_between_two_plans_the_plan_is_followed():
    """A plan whose acceleration rises by 1 m/s^3: so does the car's, after its lag."""

    def policy(params, scene, key, before):
        plan = constant(jnp.float32(0.0), scene, key)
        return plan.replace(a=jnp.asarray(TIMES_S), s=100.0 * jnp.asarray(TIMES_S))

    record, _ = drive([make_case(speed=10.0)], steps=20, policy=policy, plan_every=20)
    np.testing.assert_allclose(record.a[0], 0.1 * np.arange(1, 21), atol=2e-3)


def test_commands_may_be_delayed_and_built_up():
    record, _ = drive([make_case(speed=10.0)], steps=20, params=-6.0)
    late, _ = drive([make_case(speed=10.0)], steps=20, params=-6.0, command_delay=5)
    soft, _ = drive([make_case(speed=10.0)], steps=20, params=-6.0, braking_jerk=5.0)
    np.testing.assert_allclose(late.a[0, 5:], record.a[0, :-5], atol=1e-4)
    assert np.all(late.a[0, :5] == 0.0)
    assert np.diff(soft.a[0]).min() / 0.1 == pytest.approx(-5.0, abs=0.1)


def seen_by_planner(**perception):
    """What the planner sees of one car ahead: its rear in every step."""
    car = {"s": 40.0, "v": 10.0, "phases": [(0.0, 14.0, 4.0)]}
    case = make_case([car], speed=10.0, seed=perception.pop("seed", 1), **perception)
    config = RolloutConfig(steps=60 * SPAN, frames_every=SPAN)
    _, _, scenes = drive_cases(constant, jnp.zeros(()), stack([case]), config)
    obstacles = jax.tree.map(np.asarray, scenes.obstacles)
    return obstacles.s_lower[0, :, 0, 0], obstacles.valid[0, :, 0, 0]


def test_latency_noise_and_dropouts_act_and_are_seeded():
    clear, known = seen_by_planner()
    assert known.all()
    late, _ = seen_by_planner(latency=0.3)
    # the car pulls away, so the past shows it nearer: 0.3 s at its own speed
    shift = (clear - late)[20:]
    assert shift.mean() == pytest.approx(0.3 * 13.5, abs=0.6)
    noisy, _ = seen_by_planner(sigma_position=0.3)
    assert np.std(noisy - clear) == pytest.approx(0.3, rel=0.35)
    again, _ = seen_by_planner(sigma_position=0.3)
    np.testing.assert_array_equal(noisy, again)
    other, _ = seen_by_planner(sigma_position=0.3, seed=2)
    assert np.abs(noisy - other).max() > 0.1
    _, kept = seen_by_planner(dropout=0.3)
    assert 0.4 < kept.mean() < 0.95


def test_a_speed_has_the_noise_of_its_station_and_an_offset_half_the_spread():
    case = make_case([{"s": 40.0}], sigma_position=0.3, sigma_speed=0.05, seed=7)
    case = jax.tree.map(jnp.asarray, case)
    world = start(case)
    key = jax.random.fold_in(jax.random.key(7), world.step)
    along, aside, _ = np.asarray(jax.random.normal(key, (3, NUM_AGENTS)))
    seen = perceive(case, world)
    assert seen.s[0] == pytest.approx(40.0 + 0.3 * along[0], abs=1e-4)
    assert seen.v[0] == pytest.approx(10.0 * (1.0 + 0.05 * along[0]), abs=1e-4)
    assert seen.l[0] == pytest.approx(0.15 * aside[0], abs=1e-4)


def replay_case(turns_reactive):
    steps = 300
    t = 0.1 * np.arange(steps + 1, dtype=np.float32)
    tables = {k: np.zeros((NUM_AGENTS, steps + 1), np.float32) for k in "slhv"}
    tables["s"][0] = -20.0 + 10.0 * t  # follows at 10 m/s
    tables["v"][0] = 10.0
    present = np.zeros((NUM_AGENTS, steps + 1), bool)
    present[0] = True
    agent = {"appear_s": np.inf, "delay": 0.0, "headway": 1.0}
    case = make_case([agent], speed=10.0)
    return case.replace(
        replay=Replay(
            s=tables["s"], l=tables["l"], heading=tables["h"], v=tables["v"],
            present=present, ego_s=10.0 * t, ego_l=0.0 * t,
            ego_v=np.full_like(t, 10.0), turns_reactive=np.bool_(turns_reactive),
        )
    )  # fmt: skip


def test_replayed_agents_follow_the_log_or_turn_reactive():
    """The ego brakes to a stop in front of a logged follower."""
    record, shot = drive(
        [replay_case(False), replay_case(True)], steps=150, params=-3.0
    )
    log = -20.0 + 10.0 * 0.1 * np.arange(1, 151)
    upto = int(np.argmax(record.collision[0] > 0))
    assert record.collision[0].sum() == 1
    np.testing.assert_allclose(
        shot.agents.s[0, : upto - 1, 0], log[: upto - 1], atol=1e-3
    )
    assert record.at_fault[0].sum() == 0
    assert record.collision[1].sum() == 0
    assert shot.agents.v[1, -1, 0] < 1.0


def test_what_lasts_as_long_as_it_will_is_one_program():
    """Suite and held-out drives, a plan at every step, whatever the case holds."""
    cases = [make_case(speed=10.0), replay_case(False)]
    with compiles("jit(run)") as made:
        for steps in (10, 85, 200):
            for case in cases:
                drive([case], steps=steps, params=-1.0)
    assert len(made) <= 2  # tables of other lengths here; one where those are alike
    record, _ = drive([make_case(speed=10.0)], steps=7)
    assert record.s.shape == (1, 7)
