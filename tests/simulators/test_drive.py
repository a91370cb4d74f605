"""The loop over a simulator: who drives, what is seen, what comes of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.common import untrained
from rcirl_jax.errors import InputError
from rcirl_jax.export.own_planner.builder import scene_from
from rcirl_jax.planner.plan import held
from rcirl_jax.planner.rank import RankConfig
from rcirl_jax.simulation.rows import Row, baseline_row
from rcirl_jax.simulation.world import Vehicle
from rcirl_jax.simulators.drive import Driver, Seen, drive, follow
from rcirl_jax.simulators.measures import measure
from rcirl_jax.simulators.table import (
    numbers_of,
    read_results,
    table_of,
    text_of,
    write_results,
)
from rcirl_jax.units import TIMES_S
from tests.simulators.straight import Straight, red_light


def braking(params, scene, key, before=None):
    return held(scene.ego.v, jnp.asarray(-3.0))


def hand_set():
    return baseline_row("hand-set", "paper21", untrained(), RankConfig())


BRAKES = Row(name="brakes", policy=braking)


@pytest.fixture(scope="module")
def driven():
    """Logs by driver and episode, driven by threes."""
    simulator = Straight()
    names = simulator.episodes(4, seed=0)
    found = {}
    for who in (hand_set(), BRAKES, *simulator.own_drivers):
        name = who if isinstance(who, str) else who.name
        logs = [drive(simulator, who, group, 12.0) for group in (names[:3], names[3:])]
        found[name] = logs[0] | logs[1]
    return found


STANDS, CREEPS = "0/0/0000", "5/0/0001"  # leaders 35.5 m ahead, at 0 and 5 m/s


def test_who_keeps_its_speed_hits_the_leader_by_its_own_fault(driven):
    logs = driven["keeps 10 m/s"]
    assert logs[STANDS]["s"][-1] == pytest.approx(36.0, abs=0.51)
    assert logs[STANDS]["at_fault"].tolist() == [0] * (len(logs[STANDS]["v"]) - 1) + [1]
    assert logs[STANDS]["impact_speed"][-1] == pytest.approx(10.0)
    assert logs[CREEPS]["v"].size == 71  # 7.1 s: touching counts
    np.testing.assert_array_equal(measure(list(logs.values())).at_fault, 1)


def test_who_brakes_hits_nobody(driven):
    for log in driven["brakes"].values():
        assert not log["collision"].any()
        assert log["v"][-1] == 0.0
        # 10 m/s, 3 m/s^2, and the lag of 0.2 s
        assert log["s"][-1] == pytest.approx(10.0**2 / 6.0 + 2.0, abs=0.2)


def test_the_planner_follows_the_leader_without_a_crash(driven):
    logs = driven["hand-set"]
    assert not logs[STANDS]["collision"].any()
    assert 25.0 < logs[STANDS]["s"][-1] < 35.5
    assert not logs[CREEPS]["collision"].any()
    assert logs[CREEPS]["v"][-1] == pytest.approx(5.0, abs=0.7)


def test_episodes_do_not_depend_on_who_drives_beside_them(driven):
    alone = drive(Straight(), hand_set(), [CREEPS], 3.0)[CREEPS]["v"]
    beside = driven["hand-set"][CREEPS]["v"]  # one of three
    np.testing.assert_array_equal(alone, beside[: alone.size])


def test_a_red_light_is_a_wall_and_its_distance_is_measured():
    log = drive(Straight(red_light(33.0)), hand_set(), [STANDS], 10.0)[STANDS]
    assert log["free_way"][0] == pytest.approx(33.0 - 2.5, abs=1e-3)
    assert log["headway"][0] * log["v"][0] == pytest.approx(35.5, abs=1e-3)
    assert log["s"][-1] + 2.5 < 33.0
    assert log["v"][-1] < 0.1


def test_many_views_are_the_scenes_of_scene_from():
    running = Straight(red_light(60.0)).start(["0/0/0000", "5/0/0001"], None)
    views = running.look()
    scenes, _ = Seen(2).scenes(views)
    for n, view in enumerate(views):
        one = scene_from(
            ego=view.ego,
            centre_line=view.centre_line,
            obstacles=view.obstacles,
            signals=view.signals,
        )
        here = jax.tree.map(lambda x, n=n: x[n], scenes)
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, atol=2e-3), here, one
        )


def test_a_step_is_that_of_our_own_drive_train():
    made = follow(held(jnp.asarray(10.0), jnp.asarray(-2.0)), 10.0, 0.0, Vehicle())
    took = -2.0 * (1.0 - np.exp(-0.5))
    assert float(made.acceleration) == pytest.approx(took, abs=1e-5)
    assert float(made.speed) == pytest.approx(10.0 + 0.05 * took, abs=1e-5)
    assert float(made.way) == pytest.approx(0.05 * (20.0 + 0.05 * took), abs=1e-5)
    assert made.future.shape == (18, 3)
    np.testing.assert_allclose(made.future[0], [0.0, 0.0, 10.0], atol=1e-5)
    assert float(made.future[-1, 1]) == pytest.approx(25.0, abs=0.2)  # 10^2 / 4
    assert float(made.future[-1, 2]) == pytest.approx(0.0, abs=1e-5)


def test_a_plan_with_a_path_says_how_far_beside_its_line_the_ego_is():
    l = 0.5 * jnp.asarray(TIMES_S)  # m, to the left, at 10 m/s
    path = jnp.stack([l, jnp.full_like(l, 0.05), jnp.zeros_like(l)])
    plan = held(jnp.asarray(10.0), jnp.asarray(0.0)).replace(path=path)
    made = follow(plan, 10.0, 0.0, Vehicle())
    np.testing.assert_allclose(made.beside, [0.05, 0.05, 0.0], atol=1e-6)
    made = follow(plan.replace(since=jnp.asarray(2.0)), 10.0, 0.0, Vehicle())
    np.testing.assert_allclose(made.beside, [1.05, 0.05, 0.0], atol=1e-6)


def keeps_its_plan(params, scene, key, before=None):
    return before


vars(keeps_its_plan)["steers"] = True
STEERS = Row(name="steers", policy=keeps_its_plan)


def test_a_plan_is_kept_where_the_centre_line_is_another_lanes():
    scenes, _ = Seen(2).scenes(Straight().start(["0/0/0000", "5/0/0001"], None).look())
    driver = Driver(STEERS, [0, 0])
    asked = []
    for aside in ([0.0, 0.0], [3.5, 0.0], [0.0, -3.5]):
        moves, _ = driver.moves(scenes, np.asarray(aside, np.float32))
        asked.append([move.beside[0] for move in moves])
    assert asked == [[0.0, 0.0], [-3.5, 0.0], [-3.5, 3.5]]


def test_paths_are_refused_where_egos_keep_their_lane():
    with pytest.raises(InputError, match=r"steers: mode: path_speed: .* in straight"):
        drive(Straight(), STEERS, ["0/0/0000"], 1.0)


def test_a_table_has_a_row_per_driver_and_paired_differences(driven):
    results = {name: numbers_of(logs) for name, logs in driven.items()}
    body = table_of("straight", results, ["hand-set", "nobody"])
    assert body["against"] == ["hand-set"]
    every = body["groups"]["all"]
    assert list(every["rows"]) == list(driven)
    assert every["rows"]["keeps 10 m/s"]["at_fault"]["count"] == 4
    apart = every["differences"]["keeps 10 m/s - hand-set"]
    assert apart["at_fault"]["only_first"] == 4
    assert apart["at_fault"]["p"] == pytest.approx(2 * 0.5**4)
    assert set(body["groups"]) == {"all", "0", "5"}
    for name in driven:
        assert name in text_of(body)


def test_results_are_read_as_they_were_written(driven, tmp_path):
    made = {name: numbers_of(logs) for name, logs in driven.items()}
    file = tmp_path / "episodes.csv"
    write_results(file, made)
    read = read_results(file)
    assert list(read) == list(made)
    assert read["brakes"][CREEPS] == pytest.approx(made["brakes"][CREEPS], rel=1e-5)
    # who has driven less limits the table
    del read["brakes"][CREEPS]
    assert table_of("straight", read, [])["episodes"] == 3
    file.write_text("driver,episode\nbrakes,5/0/0001\n")
    with pytest.raises(InputError, match=r"row 1: .*expected an episodes.csv"):
        read_results(file)
