"""Agents against closed forms, their own scripts, and symmetries."""

import numpy as np
import pytest

from rcirl_jax.simulation.agents import MAX_BRAKING_MPS2
from rcirl_jax.types import Kind
from tests.simulation.drives import drive
from tests.simulation.worlds import make_case

FAR = 400.0  # m, agents appear ahead of a standing ego
WALKER = {"kind": Kind.PEDESTRIAN, "length": 0.5, "width": 0.5}


def follower(headway=1.4, standstill=2.0, desired=15.0, delay=0.0, **more):
    driver = {"headway": headway, "standstill": standstill, "desired": desired}
    return {"s": FAR - 40.0, "v": 8.0, **driver, "delay": delay, **more}


def leader(speed, **more):
    return {"s": FAR, "v": speed, "phases": [(0.0, speed, 2.0)], **more}


def test_idm_settles_at_the_equilibrium_gap():
    """s_e = (s0 + v T) / sqrt(1 - (v / v0)^4), Treiber et al. 2000."""
    settings = [(8.0, 1.0, 2.0, 15.0), (12.0, 1.5, 3.0, 20.0), (4.0, 2.0, 1.0, 14.0)]
    cases = [
        make_case([leader(v), follower(t, s0, v0)], speed=0.0)
        for v, t, s0, v0 in settings
    ]
    _, shot = drive(cases, steps=1200)
    for i, (v, t, s0, v0) in enumerate(settings):
        gap = shot.agents.s[i, -1, 0] - shot.agents.s[i, -1, 1] - 4.6
        expected = (s0 + v * t) / np.sqrt(1.0 - (v / v0) ** 4)
        assert gap == pytest.approx(expected, rel=0.01)
        assert shot.agents.v[i, -1, 1] == pytest.approx(v, abs=0.02)


def test_braking_is_capped_and_delayed():
    wall = {"s": FAR, "v": 0.0, "kind": Kind.STATIC}
    runs = [make_case([wall, follower(delay=d, v=14.0)], speed=0.0) for d in (0.0, 0.6)]
    _, shot = drive(runs, steps=300)
    a = shot.agents.a[:, :, 1]
    assert a.min() >= -MAX_BRAKING_MPS2 - 1e-4
    assert a[1].min() < -5.0
    first = [int(np.argmax(row < -0.5)) for row in a]
    assert first[1] - first[0] == pytest.approx(6, abs=1)


def test_phases_reach_their_speeds_at_their_rates():
    car = {"s": FAR, "v": 10.0, "phases": [(2.0, 4.0, 3.0), (8.0, 12.0, 1.5)]}
    car["reacts"] = False  # a reacting one never exceeds its IDM acceleration
    _, shot = drive([make_case([car], speed=0.0)], steps=300)
    v, a = shot.agents.v[0, :, 0], shot.agents.a[0, :, 0]
    assert a[22:35].mean() == pytest.approx(-3.0, abs=0.1)
    assert v[75] == pytest.approx(4.0, abs=0.1)
    assert a[85:120].mean() == pytest.approx(1.5, abs=0.1)
    assert v[-1] == pytest.approx(12.0, abs=0.1)


def test_moves_end_at_their_offset_and_keep_their_speed():
    car = {"s": FAR, "v": 10.0, "l": 3.5, "moves": [(3.0, 0.0, 0.8)]}
    _, shot = drive([make_case([car], speed=0.0, lanes=(1, 0))], steps=300)
    l = shot.agents.l[0, :, 0]
    assert l[25] == pytest.approx(3.5, abs=1e-3)
    assert l[-1] == pytest.approx(0.0, abs=0.02)
    assert np.abs(np.diff(l)).max() <= 0.8 * 0.1 + 1e-4


def test_obeying_agents_stop_at_red_and_go_at_green():
    line = {"kind": 1, "s": FAR + 60.0, "green": 20.0, "yellow": 3.0, "red": 17.0}
    line["offset"] = 23.0  # red from t = 0 to 17 s
    obeys = {"s": FAR, "v": 10.0, "desired": 10.0}
    runs = {**obeys, "obeys_lines": False}
    _, shot = drive([make_case([c], [line], speed=0.0) for c in (obeys, runs)])
    front = shot.agents.s[:, :, 0] + 2.3
    assert front[0, 160] < FAR + 60.0
    assert shot.agents.v[0, 160, 0] < 0.3
    assert front[0, -1] > FAR + 60.0
    assert front[1, 100] > FAR + 60.0


def test_mobil_changes_when_it_pays_and_only_then():
    slow = leader(4.0)
    quick = follower(v=8.0, desired=15.0, changes_lane=True)
    close = {"s": FAR - 45.0, "l": 3.5, "v": 14.0, "desired": 16.0}
    cases = [
        make_case([slow, quick], speed=0.0, lanes=(1, 0)),  # free lane on the left
        make_case([slow, quick], speed=0.0, lanes=(0, 0)),  # no lane
        make_case([quick], speed=0.0, lanes=(1, 0)),  # nobody ahead
    ]
    unsafe = make_case([slow, quick, close], speed=0.0, lanes=(1, 0))
    _, shot = drive([*cases, unsafe], steps=300)
    ends = [shot.agents.l[i, -1, j] for i, j in ((0, 1), (1, 1), (2, 0))]
    assert ends[0] == pytest.approx(3.5, abs=0.05)
    assert ends[1] == pytest.approx(0.0, abs=1e-3)
    assert ends[2] == pytest.approx(0.0, abs=1e-3)
    # with a fast car close behind in the target lane it waits at first
    assert abs(shot.agents.l[3, 20, 1]) < 0.3


def test_crossing_agents_wait_for_the_ego_only_if_they_react():
    walker = {**WALKER, "s": 0.0, "l": -8.0, "heading": np.pi / 2, "v": 1.5}
    walker |= {"desired": 1.5, "standstill": 0.5, "headway": 0.5}
    blind = {**walker, "reacts": False}
    _, shot = drive([make_case([w], speed=0.0) for w in (walker, blind)])
    assert shot.agents.l[0, -1, 0] < -1.0  # stands beside the standing ego
    assert not shot.agents.present[1, -1, 0]  # walked into it and was taken out


def some_traffic(mirror=1.0):
    rng = np.random.default_rng(4)
    cars = [
        {"s": 20.0 + 14.0 * i, "l": mirror * 3.5 * (i % 3 - 1),
         "v": 8.0 + float(rng.uniform(0, 4)), "changes_lane": True,
         "desired": 12.0 + float(rng.uniform(0, 6)), "headway": 1.0 + 0.1 * i}
        for i in range(7)
    ]  # fmt: skip
    walker = {**WALKER, "s": 90.0, "l": mirror * 9.0, "v": 1.4, "arrival_s": 4.0}
    return [*cars, {**walker, "heading": -mirror * np.pi / 2}]


def test_a_mirrored_case_gives_the_mirrored_drive():
    left = make_case(some_traffic(), speed=10.0, kappa=0.004, lanes=(1, 1))
    right = make_case(some_traffic(-1.0), speed=10.0, kappa=-0.004, lanes=(1, 1))
    record, shot = drive([left, right], steps=300)
    for name in ("s", "v", "a", "clearance"):
        one, two = getattr(record, name)
        np.testing.assert_allclose(one, two, atol=2e-3, rtol=1e-3)
    np.testing.assert_allclose(shot.agents.s[0], shot.agents.s[1], atol=0.01)
    np.testing.assert_allclose(shot.agents.l[0], -shot.agents.l[1], atol=0.01)


def test_agents_wait_for_a_free_place_and_leave_when_left_behind():
    first = {"s": 20.0, "v": 0.0, "kind": Kind.STATIC, "l": 0.0}
    late = {"s": 20.0, "v": 5.0, "relative": True, "appear_t": 1.0}
    _, shot = drive([make_case([first, late], speed=0.0)], steps=300)
    assert not shot.agents.present[0, :, 1].any()
    assert np.all(shot.agents.s[0, :, 0] == 20.0)  # static things never move
    parked = {"s": 10.0, "l": 6.0, "v": 0.0, "kind": Kind.STATIC}
    _, shot = drive([make_case([parked], speed=20.0)], steps=300)
    assert shot.agents.present[0, 10, 0]
    assert not shot.agents.present[0, -1, 0]
