"""Metrics of hand-made records, and the filter against scipy's."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import savgol_filter

from rcirl_jax.simulation.cases import STEP_S, Record
from rcirl_jax.simulation.metrics import (
    COLUMNS,
    MetricsConfig,
    case_metrics,
    nuplan_score,
    savitzky_golay,
)

S = 100
NEVER = ("ttc", "headway", "clearance", "free_way")
FLAGS = ("red_light", "stop_sign", "fallback")
COUNTS = ("collision", "at_fault", "at_fault_vru", "at_fault_object")
MEASURE = jax.jit(lambda record: case_metrics(record, MetricsConfig()))


def record(**changes):
    """10 m/s on a straight empty road under a limit of 15 m/s."""
    single, names = np.float32, [field.name for field in dataclasses.fields(Record)]
    leaves = dict.fromkeys(names, np.zeros(S, single))
    leaves |= dict.fromkeys(NEVER, np.full(S, np.inf, single))
    leaves |= dict.fromkeys(FLAGS, np.zeros(S, bool))
    leaves |= dict.fromkeys(COUNTS, np.zeros(S, np.int32))
    leaves |= {"valid": np.ones(S, bool), "v": np.full(S, 10.0, single)}
    leaves |= {"s": np.arange(1, S + 1, dtype=single)}
    leaves |= {"speed_limit": np.full(S, 15.0, single)}
    return Record(**{k: jnp.asarray(v) for k, v in (leaves | changes).items()})


def at(step, value, base=0.0, kind=np.float32):
    out = np.full(S, base, kind)
    out[step] = value
    return out


def measured(**changes):
    return jax.tree.map(np.asarray, MEASURE(record(**changes)))


@pytest.mark.parametrize(("window", "derivative"), [(5, 0), (8, 1)])
def test_filter_equals_scipy_inside(window, derivative):
    x = np.random.default_rng(window).normal(size=200).astype(np.float32)
    odd = window | 1
    ours = savitzky_golay(jnp.asarray(x)[None], ((window, derivative), (15, 0)))[0, 0]
    theirs = savgol_filter(x, odd, 2, deriv=derivative, delta=STEP_S)
    half = odd // 2
    np.testing.assert_allclose(
        np.asarray(ours)[half:-half], theirs[half:-half], atol=2e-4
    )


def test_a_calm_drive_holds_every_column():
    found = measured()
    assert found.holds.all()
    assert found.holds_filtered.all()
    np.testing.assert_array_equal(found.inside, S)
    assert found.progress == S
    assert found.samples == S
    for part in ("no_fault", "drivable", "direction", "ttc_bound", "comfort"):
        assert getattr(found, part) == 1.0
    score, ratio = nuplan_score(found, np.float32(S))
    assert score == pytest.approx(1.0)
    assert ratio == 1.0


MIDDLE = np.arange(S) - 49.5  # samples from the middle of a record
RAMP = np.clip(MIDDLE / 10.0, -0.9, 0.55)  # rises by 1 per s for 15 samples
FLIP = np.sign(MIDDLE + 2.0)  # in their middle; the filter makes it 2 per s


@pytest.mark.parametrize(
    ("inside", "outside"),
    [
        ({"a": 2.39}, {"a": 2.41}),
        ({"a": -4.04}, {"a": -4.06}),
        ({"curvature": 0.0488}, {"curvature": 0.0490}),  # 4.89 m/s2 at 10 m/s
        ({"a": 4.12 * RAMP}, {"a": 4.14 * RAMP}),
        # 8.36 and 8.39 m/s3 in all
        (
            {"a": 4.0 * RAMP, "curvature": 0.0367 * FLIP},
            {"a": 4.0 * RAMP, "curvature": 0.0369 * FLIP},
        ),
        ({"v": 1.0, "curvature": 0.94}, {"v": 1.0, "curvature": 0.96}),
    ],
)
def test_comfort_ends_at_the_bounds_of_nuplan(inside, outside):
    for changes, kept in ((inside, 1.0), (outside, 0.0)):
        leaves = {k: np.broadcast_to(np.float32(v), S) for k, v in changes.items()}
        assert measured(**leaves).comfort == kept


@pytest.mark.parametrize(
    ("column", "changes"),
    [
        ("speed_limit", {"v": at(40, 15.2, 10.0)}),
        ("a_station", {"a": at(slice(40, 43), -4.1)}),
        ("a_lateral", {"curvature": at(slice(40, 43), 0.041)}),
        ("j_station", {"a": at(slice(40, None), 0.61)}),
        ("j_lateral", {"curvature": at(slice(40, None), 0.0061)}),
    ],
)
def test_each_column_sees_its_own_excess(column, changes):
    index = COLUMNS.index(column)
    found = measured(**changes)
    assert not found.holds[index]
    assert S - 4 <= found.inside[index] < S
    jerks = {COLUMNS.index("j_station"), COLUMNS.index("j_lateral")}
    for other in set(range(len(COLUMNS))) - jerks - {index}:
        assert found.holds[other]


def test_a_crash_of_own_fault_fails_every_column_and_the_score():
    found = measured(
        collision=at(60, 1, 0, np.int32),
        at_fault=at(60, 1, 0, np.int32),
        valid=np.arange(S) <= 60,
    )
    assert not found.holds.any()
    assert not found.holds_filtered.any()
    assert found.samples == 61
    assert found.at_fault == 1
    assert nuplan_score(found, np.float32(S))[0] == 0.0


def test_samples_after_the_end_do_not_count():
    found = measured(valid=np.arange(S) < 30, v=np.where(np.arange(S) < 30, 10.0, 99.0))
    assert found.holds.all()
    assert found.samples == 30
    assert found.mean_speed == pytest.approx(10.0)


def test_a_time_to_collision_below_the_bound_counts():
    assert measured().ttc_bound == 1.0
    found = measured(ttc=at(50, 0.5, np.inf))
    assert found.ttc_bound == 0.0
    assert found.tet == pytest.approx(0.1)
    assert found.tit == pytest.approx(0.1)


def test_creeping_is_slow_where_the_road_is_free():
    """The limit is 15 m/s: below 3 m/s one creeps, unless something is near ahead."""
    slow = np.full(S, 10.0, np.float32)
    slow[:30] = 2.9
    assert measured(v=slow).creeping_share == pytest.approx(0.3)
    assert measured(v=slow + 0.2).creeping_share == 0.0
    near = np.full(S, np.inf, np.float32)
    near[:20] = 39.0
    assert measured(v=slow, free_way=near).creeping_share == pytest.approx(0.1)


def speeding_up(begin=0.0, first=0):
    """m/s under 2 m/s^2 from a sample on, to 10 m/s."""
    steps = np.maximum(np.arange(S) - first, 0)
    return np.minimum(begin + 0.2 * steps, 10.0).astype(np.float32)


@pytest.mark.parametrize(
    ("v", "blocked", "seconds"),
    [
        (speeding_up(), slice(0), 4.0),  # to 8 m/s
        (speeding_up(1.0), slice(0), -1.0),  # it did not stand
        (np.minimum(speeding_up(), 7.9), slice(0), 9.9),  # never: to the record's end
        (np.r_[speeding_up()[:50], speeding_up(first=10)[:50]], slice(0), 4.9),  # twice
        # it stands for 3 s and is at 8 m/s after 7 s; the road is not free
        (speeding_up(first=30), slice(40, 45), -1.0),  # on the way
        (speeding_up(first=30), slice(20, 25), 4.5),  # while it stands
        (speeding_up(first=30), slice(0, 10), 6.0),  # a red light, 2 s more of standing
        (speeding_up(first=30), slice(70, None), 7.0),  # when it has started already
    ],
)
def test_time_of_the_longest_start_on_a_free_road(v, blocked, seconds):
    drive = {"v": v.astype(np.float32), "speed_limit": np.full(S, 10.0, np.float32)}
    drive["free_way"] = at(blocked, 39.0, np.inf)
    assert measured(**drive).start_time == pytest.approx(seconds)


def test_a_start_ends_with_the_drive():
    limit, ended = np.full(S, 10.0, np.float32), np.arange(S) < 31
    found = measured(v=speeding_up(), speed_limit=limit, valid=ended)
    assert found.start_time == pytest.approx(3.0)


def test_sign_changes_of_the_acceleration_a_second():
    """10 s: push, coast, brake, push within the band, push: two turns."""
    a = np.zeros(S, np.float32)
    a[:20], a[40:60], a[60:70], a[70:] = 0.5, -0.5, 0.05, 0.5
    assert measured(a=a).sign_changes == pytest.approx(0.2)
    assert measured(a=-a).sign_changes == pytest.approx(0.2)
    assert measured(a=np.abs(a)).sign_changes == 0.0
    flicker = np.where(np.arange(S) % 2 == 0, 0.3, -0.3).astype(np.float32)
    assert measured(a=flicker).sign_changes == pytest.approx(9.9)
    assert measured(a=0.3 * flicker).sign_changes == 0.0


def test_little_progress_zeroes_the_score():
    assert nuplan_score(measured(), np.float32(10.0 * S))[0] == 0.0
    half, ratio = nuplan_score(measured(), np.float32(2.0 * S))
    assert ratio == 0.5
    assert half == pytest.approx((16.0 - 2.5) / 16.0)
