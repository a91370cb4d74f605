"""Every family file: budgets, sane roads, room to react at the start."""

import functools
import pathlib
import tomllib

import jax
import numpy as np
import pytest

from rcirl_jax.simulation.cases import NUM_AGENTS, NUM_PHASES, NUM_ROAD, ROAD_STEP_M
from rcirl_jax.simulation.catalogue import build_cases, family_names, load_family
from rcirl_jax.types import Kind
from tests.simulation.test_judge import polygon

FOLDER = pathlib.Path(__file__).parents[2] / "data_specs" / "scenarios"
FILES = sorted(FOLDER.glob("*.toml"))
NAMES = [file.stem for file in FILES]
CASES = 180  # of a family in the suite `full`
MAX_CURVATURE = 0.1  # 1/m, simulation.md 3.8 row 1
LANE_TILT = 0.17  # sin of the heading below which an agent keeps a lane


@functools.cache
def cases(name):
    """All cases of a family; too many agents or lines raise here."""
    return build_cases(load_family(name), range(CASES))


def test_the_catalogue_lists_all_files():
    assert len(NAMES) >= 23
    assert sorted(family_names()) == NAMES
    assert sum(tomllib.loads(file.read_text())["cases"] for file in FILES) >= 3420


@pytest.mark.parametrize("name", NAMES)
def test_the_road_is_sane(name):
    road = cases(name).road
    assert road.speed_limit.min() >= 3.0
    assert road.speed_limit.max() <= 40.0
    assert np.abs(road.kappa).max() <= MAX_CURVATURE + 1e-6
    # Apollo's 2 m/s^2 leaves at least a walking-to-running pace in every bend
    comfortable = np.sqrt(2.0 / np.maximum(np.abs(road.kappa), 1e-6))
    assert comfortable.min() > 4.4
    for leaf in jax.tree.leaves((road, cases(name).agents.s, cases(name).agents.l)):
        assert np.isfinite(leaf).all()
    assert np.unique(cases(name).ego_v[:16]).size == 16
    # the given path stays inside the drivable area, with the ego's half width
    inside_left = road.edge_left[:, None] - road.path_l
    inside_right = road.path_l - road.edge_right[:, None]
    assert min(inside_left.min(), inside_right.min()) > 1.055
    assert (cases(name).ego_v <= 1.001 * road.speed_limit[:, 0]).all()


def test_posted_bend_speeds_respect_their_advice():
    """Where curve_speed posts a lower limit, v^2 |kappa| <= 3 m/s^2."""
    road = cases("curve_speed").road
    posted = road.speed_limit < 0.999 * road.speed_limit[:, :1]
    lateral = road.speed_limit**2 * np.abs(road.kappa)
    assert posted.any()
    assert lateral[posted].max() <= 3.0 + 1e-3
    # and some bends are not posted: there the driver must see to it alone
    assert lateral[~posted].max() > 4.0


@pytest.mark.parametrize("name", NAMES)
def test_who_appears_at_the_start_or_beside_the_ego_leaves_room(name):
    batch, agents = cases(name), cases(name).agents
    used = agents.kind != Kind.NONE
    here = used & (agents.appear_s <= 0) & (agents.appear_t <= 0)
    for b, a in np.argwhere(here & (np.abs(agents.s) < 20.0)):
        length, width = float(batch.ego_length[b]), float(batch.ego_width[b])
        ego = polygon(0.0, float(batch.road.path_l[b, 0]), 0.0, length, width)
        place = (agents.s, agents.l, agents.heading, agents.length, agents.width)
        other = polygon(*(float(field[b, a]) for field in place))
        assert ego.distance(other) > 0.3, (b, a)
    stations = np.arange(NUM_ROAD) * ROAD_STEP_M
    for b, a in np.argwhere(used & agents.relative & (np.abs(agents.s) <= 6.0)):
        at = max(float(agents.appear_s[b, a]), 0.0)
        own = np.interp(at, stations, batch.road.path_l[b])
        assert abs(agents.l[b, a] - own) > 2.5, (b, a)


@pytest.mark.parametrize("name", NAMES)
def test_agents_move_as_their_kind_does(name):
    agents = cases(name).agents
    used = agents.kind != Kind.NONE
    assert used.sum(axis=1).max() <= NUM_AGENTS
    assert agents.v[used].min() >= 0.0
    assert agents.v[used].max() <= 45.0
    walkers = agents.kind == Kind.PEDESTRIAN
    assert ((agents.v[walkers] >= 0.8) & (agents.v[walkers] <= 2.0)).all()
    standing = agents.kind == Kind.STATIC
    assert (agents.v[standing] == 0.0).all()
    assert (agents.script.speed[standing] == 0.0).all()
    crossing = used & (np.abs(np.sin(agents.heading)) > LANE_TILT)
    outside = np.abs(agents.l) - 0.5 * agents.length
    assert (outside[crossing] > 1.2).all()
    towards = -np.sign(agents.l) * np.sign(np.sin(agents.heading))
    assert (towards[crossing] > 0.0).all()

    # delayed free-road IDM is stable for 4 a delay / v0 < pi / 2 (slope at v0)
    driver = agents.driver
    loop = 4.0 * driver.acceleration * driver.delay / np.maximum(driver.desired, 0.1)
    assert (loop[crossing] < 0.5 * np.pi).all()
    script = agents.script
    phases, moves = np.isfinite(script.start), np.isfinite(script.move_start)
    # an unused phase starts at infinity: it comes last
    start = np.minimum(script.start, 1e6 + np.arange(NUM_PHASES))
    assert np.diff(start, axis=-1).min() > 0.0
    assert (script.rate[phases] > 0.0).all()
    assert (script.speed[phases] >= 0.0).all()
    assert (script.move_speed[moves] > 0.0).all()


@pytest.mark.parametrize("name", NAMES)
def test_the_first_event_is_within_the_drive(name):
    """120 s at the posted speed reach something to deal with."""
    batch = cases(name)
    reach = 120.0 * batch.road.speed_limit.mean(axis=1)
    agents, lines = batch.agents, batch.lines
    meets = ((agents.kind != Kind.NONE) & (agents.appear_s < reach[:, None])).any(1)
    meets |= ((lines.kind != 0) & (lines.s < reach[:, None])).any(1)
    road = batch.road
    meets |= (np.ptp(road.kappa, axis=1) > 0) | (np.ptp(road.speed_limit, axis=1) > 0)
    assert meets.mean() > 0.95
