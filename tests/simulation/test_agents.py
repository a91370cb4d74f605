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


# IDM parameters of a follower, its start, and the leader's phases
# (start s, speed m/s, rate m/s^2)
PAIRS = (
    {"headway": 1.0, "standstill": 1.0, "acceleration": 2.5, "braking": 3.0,
     "desired": 20.0, "v": 8.0, "gap": 12.0, "lead": 8.0,
     "phases": [(0.0, 16.0, 2.0), (12.0, 9.0, 3.0)]},
    {"headway": 2.0, "standstill": 4.0, "acceleration": 0.8, "braking": 1.2,
     "desired": 30.0, "v": 22.0, "gap": 70.0, "lead": 20.0,
     "phases": [(0.0, 20.0, 1.0), (5.0, 14.0, 1.0), (20.0, 22.0, 0.8)]},
    {"headway": 1.2, "standstill": 2.5, "acceleration": 1.8, "braking": 2.5,
     "desired": 13.0, "v": 13.0, "gap": 30.0, "lead": 11.0,
     "phases": [(0.0, 11.0, 2.0), (4.0, 0.0, 2.5), (16.0, 9.0, 1.5)]},
)  # fmt: skip


def test_a_follower_drives_as_the_idm_in_float64():
    """The ballistic update of Treiber et al. 2000, behind the same leader."""
    names = ("headway", "standstill", "acceleration", "braking", "desired", "v")
    cases = []
    for pair in PAIRS:
        ahead = {"s": FAR, "v": pair["lead"], "phases": pair["phases"], "desired": 60.0}
        behind = {"s": FAR - pair["gap"] - 4.6} | {name: pair[name] for name in names}
        cases.append(make_case([{**ahead, "reacts": False}, behind], speed=0.0))
    _, shot = drive(cases, steps=300)
    for i, pair in enumerate(PAIRS):
        t, s0, a, b, desired, v = (pair[name] for name in names)
        lead_s, lead_v = np.r_[FAR, shot.agents.s[i, :, 0]], shot.agents.v[i, :, 0]
        s, made = FAR - pair["gap"] - 4.6, []
        for there, speed in zip(lead_s, np.r_[pair["lead"], lead_v], strict=True):
            made.append((s, v))
            wanted = s0 + max(v * t + v * (v - speed) / (2.0 * np.sqrt(a * b)), 0.0)
            idm = a * (1.0 - (v / desired) ** 4 - (wanted / (there - s - 4.6)) ** 2)
            after = max(v + 0.1 * max(idm, -MAX_BRAKING_MPS2), 0.0)
            s, v = s + 0.05 * (v + after), after
        s, v = np.array(made[1:]).T
        assert np.ptp(v) > 3.0  # there is something to compare
        np.testing.assert_allclose(shot.agents.v[i, :, 1], v, atol=0.02, rtol=0.0)
        np.testing.assert_allclose(shot.agents.s[i, :, 1], s, atol=0.05, rtol=0.0)


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
