"""The loop over a simulator: who drives, what is seen, what comes of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.export.own_planner.builder import scene_from
from rcirl_jax.features import feature_map
from rcirl_jax.planner.plan import held
from rcirl_jax.planner.rank import RankConfig
from rcirl_jax.simulation.rows import Row, baseline_row
from rcirl_jax.simulation.world.vehicle import Vehicle
from rcirl_jax.simulators.drive import Entrant, drive, entrants, groups
from rcirl_jax.simulators.drivers import Seen, follow
from rcirl_jax.simulators.measures import Drive, measure
from rcirl_jax.simulators.simulators import open_simulator
from rcirl_jax.simulators.table import (
    numbers_of,
    read_results,
    table_of,
    write_results,
)
from tests.simulators.straight import Straight, red_light


def braking(params, scene, key, before=None):
    return held(scene.ego.v, jnp.asarray(-3.0))


def hand_set():
    count = feature_map("paper21").num_features
    return baseline_row("hand-set", "paper21", count, RankConfig())


BRAKES = Row(name="brakes", policy=braking)


@pytest.fixture(scope="module")
def driven():
    simulator = Straight()
    names = simulator.episodes(4, seed=0)
    rows = [hand_set(), BRAKES]
    return {
        entrant.name: [
            one
            for group in groups(simulator, names)
            for one in drive(simulator, entrant, group, seconds=12.0)
        ]
        for entrant in entrants(simulator, rows)
    }


def test_rows_come_first_then_the_own_drivers(driven):
    assert list(driven) == ["hand-set", "brakes", "keeps 10 m/s"]


def test_who_keeps_its_speed_hits_the_leader_by_its_own_fault(driven):
    stands, creeps = driven["keeps 10 m/s"][:2]
    # 35.5 m to a leader's rear: 10 m/s to one that stands, 5 m/s to the other
    assert stands.way[-1] == pytest.approx(36.0, abs=0.51)
    assert stands.contact.at_fault
    assert stands.contact.relative_speed == pytest.approx(10.0)
    assert creeps.v.size == 71  # 7.1 s: touching counts
    found = measure(driven["keeps 10 m/s"])
    np.testing.assert_array_equal(found.at_fault, 1)


def test_who_brakes_hits_nobody(driven):
    for one in driven["brakes"]:
        assert one.contact is None
        assert one.v[-1] == 0.0
        # 10 m/s, 3 m/s^2, and the lag of 0.2 s
        assert one.way[-1] == pytest.approx(10.0**2 / 6.0 + 2.0, abs=0.2)


def test_the_planner_follows_the_leader_without_a_crash(driven):
    stands, creeps = driven["hand-set"][:2]
    assert stands.contact is None
    assert 25.0 < stands.way[-1] < 35.5
    assert creeps.contact is None
    assert creeps.v[-1] == pytest.approx(5.0, abs=0.7)


def test_episodes_do_not_depend_on_who_drives_beside_them():
    simulator = Straight()
    simulator.together = 3
    alone = drive(simulator, Entrant(name="", row=hand_set()), ["5/0/0001"], 3.0)
    names = ["0/0/0000", "5/0/0001"]
    beside = drive(simulator, Entrant(name="", row=hand_set()), names, 3.0)[1]
    np.testing.assert_array_equal(alone[0].v, beside.v)


def test_a_red_light_is_a_wall_and_its_distance_is_measured():
    simulator = Straight(red_light(33.0))
    (made,) = drive(simulator, Entrant(name="", row=hand_set()), ["0/0/0000"], 10.0)
    assert made.line[0] == pytest.approx(33.0 - 2.5, abs=1e-3)
    assert made.gap[0] == pytest.approx(40.0 - 2.5 - 2.0, abs=1e-3)
    assert made.way[-1] + 2.5 < 33.0
    assert made.v[-1] < 0.1


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


def test_a_table_has_a_row_per_driver_and_paired_differences(driven):
    results = {name: numbers_of(drives) for name, drives in driven.items()}
    table = table_of("straight", results, ["hand-set", "nobody"])
    assert table.against == ["hand-set"]
    body = table.as_dict()
    every = body["groups"]["all"]
    assert list(every["rows"]) == list(driven)
    assert every["rows"]["keeps 10 m/s"]["at_fault"]["count"] == 4
    apart = every["differences"]["keeps 10 m/s - hand-set"]
    assert apart["at_fault"]["only_first"] == 4
    assert apart["at_fault"]["p"] == pytest.approx(2 * 0.5**4)
    assert set(body["groups"]) == {"all", "0", "5"}
    for name in driven:
        assert name in table.text(body)


def test_an_episode_that_somebody_cannot_begin_is_left_out(driven):
    results = {name: numbers_of(drives) for name, drives in driven.items()}
    first, *others = driven["brakes"]
    never = Drive.of(first.episode, [])
    results["brakes"] = numbers_of([never, *others])
    assert first.episode not in results["brakes"]
    assert numbers_of([never]) == {}
    table = table_of("straight", results, ["hand-set"])
    assert table.episodes == [drive.episode for drive in others]


def test_an_unknown_simulator_is_one_line():
    with pytest.raises(InputError, match=r"--simulator: sumoo: .*did you mean sumo\?"):
        open_simulator("sumoo")


def test_results_are_read_as_they_were_written(driven, tmp_path):
    made = {name: numbers_of(drives) for name, drives in driven.items()}
    file = tmp_path / "episodes.csv"
    write_results(file, made)
    read = read_results(file)
    assert list(read) == list(made)
    one, again = (x["brakes"]["5/0/0001"] for x in (made, read))
    assert again == pytest.approx(one, rel=1e-5)
    # who has driven less limits the table
    del read["brakes"]["5/0/0001"]
    assert len(table_of("straight", read, []).episodes) == 3
    file.write_text("driver,episode\nbrakes,5/0/0001\n")
    with pytest.raises(InputError, match=r"row 1: .*expected an episodes.csv"):
        read_results(file)
