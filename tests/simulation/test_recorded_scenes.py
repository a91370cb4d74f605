"""Stored scenes as cases: the human comes back, and draws are even."""

import types

import jax
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop import likeness
from rcirl_jax.evaluation.closed_loop.likeness import (
    TRAFFIC,
    held_out_likeness,
    jensen_shannon,
    read_arrays,
    traffic_of,
    write_arrays,
)
from rcirl_jax.evaluation.gate.types import Likeness
from rcirl_jax.planner.plan import held
from rcirl_jax.simulation.recorded import (
    CLOCK_S,
    STEPS,
    case_of,
    drawn_evenly,
    held_out,
)
from rcirl_jax.simulation.rows import RECORDED_HUMAN, Row, rule_row
from rcirl_jax.simulation.suite import recorded_set
from rcirl_jax.types import Kind
from tests.simulation.stored import Rows, stored


def coast(params, scene, key, before):
    return held(scene.ego.v, 0.0 * scene.ego.v)


def test_a_case_ends_where_the_mask_ends():
    one = jax.tree.map(lambda x: np.asarray(x)[0], stored(1))
    cut = np.arange(18) < 8  # to 3.29 s
    short = case_of(one.replace(scene=one.scene.replace(time_valid=cut)))
    assert int(short.steps) == 32
    assert not short.replay.present[:, 33:].any()


def with_obstacle(one, slot, kind, valid, **leaves):
    """The case of a scene with other values in one slot."""
    o = one.scene.obstacles
    changed = {"kind": kind, "valid": valid, **leaves}
    tables = {name: np.array(getattr(o, name)) for name in changed}
    for name, table in tables.items():
        table[slot] = changed[name]
    obstacles = o.replace(**tables)
    return case_of(one.replace(scene=one.scene.replace(obstacles=obstacles)))


def test_the_others_drive_as_medians_once_they_leave_the_log():
    one = jax.tree.map(lambda x: np.asarray(x)[0], stored(1))
    road, times = np.asarray(one.scene.path.speed_limit), np.arange(18)
    fast = case_of(one).agents.driver
    assert road == pytest.approx(20.0)
    assert fast.desired[:3] == pytest.approx(16.0)  # 0.8 of the limit
    there = {"valid": times < 18, "s_lower": 90.0, "s_upper": 94.0}
    for kind, speed, desired in (
        (Kind.VEHICLE, 25.0, 25.0), (Kind.PEDESTRIAN, 0.0, 0.0), (Kind.STATIC, 0.0, 0.0)
    ):  # fmt: skip
        way = speed * times * 8.0 / 17.0
        moved = {**there, "s_lower": 90.0 + way, "s_upper": 94.0 + way, "speed": speed}
        agents = with_obstacle(one, 0, kind, **moved).agents
        assert agents.driver.desired[0] == pytest.approx(desired, abs=1e-3)
        assert bool(agents.driver.reacts[0]) == (kind == Kind.VEHICLE)
        assert (agents.script.start[0, 0] == 0.0) == (kind == Kind.STATIC)
    usual = {"headway": 1.4, "standstill": 2.0, "acceleration": 1.4, "braking": 2.0}
    for name, value in {**usual, "delay": 0.4}.items():
        np.testing.assert_allclose(getattr(fast, name)[:3], value)


def test_held_out_drives_are_a_suite():
    drives = held_out([Rows(stored(3)), Rows(stored(2))], 5)
    cases = recorded_set(drives)
    assert cases.ids == ("0:0", "0:1", "0:2", "1:0", "1:1")
    assert cases.groups == ("0:0",) * 3 + ("1:0",) * 2
    assert cases.duration_s == 8.0
    last = cases.build(4, 5)
    assert last.replay.ego_s.shape == (1, STEPS + 1)
    np.testing.assert_array_equal(last.seed, drives.cases.seed[4:])
    # a dataset with few drives leaves its share to the others
    drives = held_out([Rows(stored(3)), Rows(stored(1))], 4)
    assert len(drives.ids) == drives.available == 4
    two = held_out([Rows(stored(3)), Rows(stored(1))], 2).ids
    assert [name[0] for name in two] == ["0", "1"]


def test_a_line_that_demands_a_stop_for_a_time_is_a_red_light():
    one = jax.tree.map(lambda x: np.asarray(x)[0], stored(1))
    case = with_obstacle(one, 15, Kind.STOP, np.arange(18) < 10, s_lower=40.0)
    assert float(case.lines.s[0]) == 40.0
    assert float(case.lines.red[0]) == pytest.approx(10 * 8 / 17, rel=1e-5)
    assert float(case.lines.offset[0]) == float(case.lines.green[0])


def test_draws_are_even_over_recordings_and_vehicles():
    recording = np.repeat([0, 1, 2], [100, 20, 10])
    vehicle = np.concatenate([np.arange(100) // 50, np.arange(20), np.arange(10)])
    at = drawn_evenly(recording, vehicle, 30, seed=0)
    assert np.bincount(recording[at]).tolist() == [10, 10, 10]
    first = vehicle[at][recording[at] == 0]
    assert np.bincount(first).tolist() == [5, 5]
    assert not np.array_equal(at, drawn_evenly(recording, vehicle, 30, seed=1))
    assert np.array_equal(at, drawn_evenly(recording, vehicle, 30, seed=0))


def test_a_turning_body_has_the_size_that_it_has_along_an_axis():
    """A bus of 10 m x 2.5 m turns from across the road (90 degrees) to along it (0)."""
    one = jax.tree.map(lambda x: np.asarray(x)[0], stored(1))
    heading = np.linspace(0.5 * np.pi, 0.0, 18)
    s, l = np.cumsum(4.0 * np.cos(heading)), np.cumsum(4.0 * np.sin(heading))
    cos, sin = np.abs(np.cos(heading)), np.abs(np.sin(heading))
    half_s, half_l = 0.5 * (10.0 * cos + 2.5 * sin), 0.5 * (10.0 * sin + 2.5 * cos)
    low_high = {"s_lower": 20 + s - half_s, "s_upper": 20 + s + half_s}
    low_high |= {"l_lower": l - half_l, "l_upper": l + half_l}
    low_high |= {"speed": 4.0 * np.cos(heading) * 17 / 8}
    kind = np.full_like(one.scene.obstacles.kind, Kind.NONE)
    valid = np.zeros_like(one.scene.obstacles.valid)
    nobody = one.scene.obstacles.replace(kind=kind, valid=valid)
    empty = one.replace(scene=one.scene.replace(obstacles=nobody))
    for seen in (slice(0, 18), slice(0, 12), slice(6, 18)):
        there = np.isin(np.arange(18), np.arange(18)[seen])
        case = with_obstacle(empty, 0, Kind.VEHICLE, there, **low_high)
        assert float(case.agents.length[0]) == pytest.approx(10.0, abs=0.1)
        assert float(case.agents.width[0]) == pytest.approx(2.5, abs=0.1)


def test_distances_are_those_of_the_drives(tmp_path, monkeypatch):
    """Coasting against a human who brakes at 0.2 m/s^2.

    The ego starts with the human's braking, which fades with the drive train's lag of
    0.2 s: 0.1 t^2 - 0.04 t apart.
    """
    with pytest.raises(InputError, match="1 vehicles: expected at least 2"):
        held_out_likeness(held_out([Rows(stored(3))], 3), [])
    two = stored(3).replace(vehicle=np.array([0, 1, 1], np.int32))
    drives = held_out([Rows(two)], 3)
    rows = [Row(name="coast", policy=coast), rule_row("IDM", "IDM")]
    report = held_out_likeness(drives, rows)
    coasted = report.rows["coast"]
    apart = lambda t: 0.1 * t**2 - 0.04 * t  # noqa: E731
    shown = np.array([1.0, 3.0, 5.0, 8.0])
    np.testing.assert_allclose(coasted.at[0], apart(shown), atol=0.02)
    mean = float(np.mean(apart(CLOCK_S[1:])))
    assert coasted.distance[0] == pytest.approx(mean, abs=0.02)
    assert report.rows[RECORDED_HUMAN].distance.max() < 0.02
    assert report.facts["rows"][RECORDED_HUMAN]["unlikeness"]["acceleration"] == 0.0
    minus = report.facts["rows"]["coast"]["minus"]["IDM"]["mean"]
    apart_of = report.distance["coast"] - report.distance["IDM"]
    assert minus == pytest.approx(float(apart_of.mean()))
    assert f"{minus:+.2f} [" in report.text()
    write_arrays(tmp_path / "x.npz", report.likeness)
    back = read_arrays(tmp_path / "x.npz")
    assert isinstance(back, Likeness)
    np.testing.assert_array_equal(back.distance["coast"], coasted.distance)
    assert back.available == 3
    for name, row in report.rows.items():
        assert back.traffic[name].keys() == row.traffic.keys()
        assert not np.any([*back.traffic[name].values()])  # nobody else was recorded
    monkeypatch.setattr(likeness, "CHUNK", 2)
    again = held_out_likeness(drives, rows)
    np.testing.assert_array_equal(again.distance["coast"], coasted.distance)
    with pytest.raises(InputError, match=r"none\.npz"):
        read_arrays(tmp_path / "none.npz")


@pytest.mark.parametrize(
    ("name", "array", "says"),
    [
        ("names", np.array(["a", "a"]), "names: one twice"),
        ("distance", np.ones((2, 2)), "distance: float64 (2, 2), not (2, 3)"),
        ("distance", -np.ones((2, 3)), "distance: below 0, NaN or infinity"),
        ("distance", None, "expected distances as written"),
        ("headway", np.full((1, 3), 2.0), "headway: not from 0 to 1"),
    ],
)
def test_damaged_distances_are_one_line(tmp_path, name, array, says):
    good = {"names": np.array(["a", "b"]), "distance": np.ones((2, 3))}
    good |= {"clusters": np.arange(3), "available": np.array(3)}
    good |= {"drivers": np.array(["a"])} | {key: np.ones((1, 3)) for key in TRAFFIC}
    arrays = {**good, name: array}
    arrays = {n: x for n, x in arrays.items() if x is not None}
    path = tmp_path / "x.npz"
    np.savez(path, **arrays)
    with pytest.raises(InputError) as caught:
        read_arrays(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert says in str(caught.value)
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(InputError, match="expected distances as written"):
        read_arrays(path)


def test_safety_counts_what_happens_before_a_crash():
    """Two drives of 1 s: one comes close, then crashes; one ends before that."""
    shape, late = (2, 10), np.arange(10) >= 6
    record = types.SimpleNamespace(
        valid=np.stack([np.arange(10) < 8, ~late]), at_fault=np.zeros(shape),
        ttc=np.where([late, late], 0.5, np.inf),
        headway=np.where([late, ~late], 0.5, np.inf), v=np.full(shape, 5.0),
        induced_braking=np.stack([5.0 * late, 3.0 + late]),
    )  # fmt: skip
    record.at_fault[0, 7] = 1
    found = traffic_of(record, np.ones(shape, bool))
    assert found["collision"].tolist() == [1.0, 0.0]
    assert found["ttc"].tolist() == [1.0, 0.0]
    assert found["braking"].tolist() == [1.0, 0.0]
    assert found["headway"] == pytest.approx([0.2, 0.6])
    record.v[:] = 0.5  # who hardly moves keeps no headway
    assert traffic_of(record, np.ones(shape, bool))["headway"].tolist() == [0.0, 0.0]


def test_jensen_shannon_of_known_samples():
    a, b = np.zeros(10), np.full(10, 3.0)
    assert jensen_shannon(a, a, "jerk") == 0.0
    assert jensen_shannon(a, b, "jerk") == pytest.approx(1.0)
    # half of one in the other's bin: sqrt(H(3/4, 1/4) - H(1/2, 1/2) / 2)
    mixed = np.concatenate([a[:5], b[:5]])
    expected = -(0.75 * np.log2(0.75) + 0.25 * np.log2(0.25)) - 0.5
    assert jensen_shannon(a, mixed, "jerk") == pytest.approx(np.sqrt(expected))
    assert jensen_shannon(a[:0], b[:0], "jerk") == 0.0
    nearly = np.random.default_rng(0).uniform(-8.0, 8.0, 10_000)
    assert 0.0 <= jensen_shannon(nearly, np.append(nearly[1:], 0.0), "jerk") < 0.01
