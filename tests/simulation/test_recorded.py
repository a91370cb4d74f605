"""Recorded drives as cases: the log comes back, masks and lights are right."""

import collections
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

from rcirl_jax.data.importers import read_recordings
from rcirl_jax.data.importers.synthetic import reader as synthetic
from rcirl_jax.errors import InputError
from rcirl_jax.planner.plan import held
from rcirl_jax.runtime.specs import load_toml, spec_root
from rcirl_jax.simulation.cases import NUM_AGENTS, NUM_ROAD, STEP_S, LineKind
from rcirl_jax.simulation.recorded.cases import drives, recorded_cases
from rcirl_jax.simulation.recorded.config import REASONS, RecordedConfig
from rcirl_jax.simulation.recorded.drive import light_cycle
from rcirl_jax.simulation.rollout import RolloutConfig, drive_cases
from rcirl_jax.types import Kind, Lane, Recording, Signal, Track

DEFAULT = spec_root() / "sources" / "synthetic.toml"
SMALL = """
source = "test"
licence = "none"
rate_hz = 10.0
warmup_s = 20.0
position_noise_m = 0.0
[[recordings]]
road = "{road}"
count = 1
duration_s = 25.0
density_veh_per_km = 12.0
seed = 5
"""
RAW = RecordedConfig(smoothing_s=0.0)
TOLERANCE_M = 0.05  # m, how well a replayed position is where it was recorded


def traffic(folder, road):
    path = folder / "small.toml"
    path.write_text(SMALL.format(road=road))
    (recording,) = synthetic.recordings(path, load_toml(DEFAULT))
    return recording


@pytest.fixture(scope="module")
def turning(tmp_path_factory):
    return traffic(tmp_path_factory.mktemp("turn"), "urban_turn_left")


@pytest.fixture(scope="module")
def signals(tmp_path_factory):
    return traffic(tmp_path_factory.mktemp("signals"), "arterial_signals")


def lane(name, y=0.0, **more):
    """A lane of 3.5 m along x."""
    x = np.arange(0.0, 601.0, 5.0)
    side = np.full(x.size, 1.75)
    return Lane(
        id=name, centre=np.stack([x, np.full(x.size, y)], axis=1), left_width=side,
        right_width=side, speed_limit=20.0, **more,
    )  # fmt: skip


def straight(tracks, *, lanes=None, signals=(), rate=10.0):
    """Cars on a straight road of two lanes along x; lane "a" at y = 0."""
    lanes = lanes or (lane("a", left="b"), lane("b", 3.5, right="a"))
    return Recording(
        name="hand", source="test", licence="none", rate_hz=rate, tracks=tuple(tracks),
        lanes=lanes, signals=tuple(signals),
    )  # fmt: skip


def car(name, x, y=0.0, t=None, kind=Kind.VEHICLE, heading=0.0, length=4.5):
    x = np.asarray(x, float)
    t = np.asarray(np.arange(x.size) / 10.0 if t is None else t, float)
    still = np.zeros(x.size)
    return Track(
        id=name, kind=kind, length=length, width=1.8, t=t, x=x, y=still + y,
        heading=still + heading, speed=np.abs(np.gradient(x, t)),
    )  # fmt: skip


def at_speed(v, seconds, start=30.0):
    return start + v * np.arange(int(seconds * 10) + 1) / 10.0


def positions(drive, s, l):
    """Float64 oracle of (s, l) -> (x, y): Hermite curve plus normal."""
    line = drive.frame.line
    x, y, heading = (np.asarray(v, float) for v in (line.x, line.y, line.heading))
    grid = np.arange(x.size) * float(line.step)
    curve_x = CubicHermiteSpline(grid, x, np.cos(heading))
    curve_y = CubicHermiteSpline(grid, y, np.sin(heading))
    at = np.clip(s + drive.origin, 0.0, grid[-1])
    beyond = s + drive.origin - at
    yaw = np.interp(at, grid, heading)
    return (
        curve_x(at) + beyond * np.cos(yaw) - l * np.sin(yaw),
        curve_y(at) + beyond * np.sin(yaw) + l * np.cos(yaw),
        yaw,
    )


@pytest.mark.parametrize("name", ["turning", "signals"])
def test_replayed_poses_are_the_recorded_ones(request, name):
    recording = request.getfixturevalue(name)
    found = list(drives(recording, RAW))
    assert len(found) > 5
    by_id = {f"{recording.name}:{t.id}": t for t in recording.tracks}
    checked = 0
    for drive in found:
        replay, own = drive.case.replay, by_id[drive.id]
        clock = drive.start_s + np.arange(int(drive.case.steps) + 1) * STEP_S
        rows = [(own, replay.ego_s, replay.ego_l, None, np.ones(clock.size, bool))]
        tables = (replay.s, replay.l, replay.heading, replay.present)
        for slot, number in enumerate(drive.tracks):
            rows.append((recording.tracks[number], *(table[slot] for table in tables)))
        for track, s, l, tilt, present in rows:
            x, y, yaw = positions(drive, s.astype(float), l.astype(float))
            inside = (clock >= track.t[0] - 1e-6) & (clock <= track.t[-1] + 1e-6)
            assert not np.any(present & ~inside)
            gap_x = x - np.interp(clock, track.t, track.x)
            gap_y = y - np.interp(clock, track.t, track.y)
            assert np.all(np.hypot(gap_x, gap_y)[present] < TOLERANCE_M)
            if tilt is not None:
                turn = yaw + tilt - np.interp(clock, track.t, np.unwrap(track.heading))
                assert np.all(np.abs(np.sin(turn))[present] < 1e-3)
                checked += int(present.sum())
    assert checked > 1000


def test_the_case_is_the_humans_drive(turning):
    for drive in drives(turning, RAW):
        case, replay = drive.case, drive.case.replay
        track = next(t for t in turning.tracks if drive.id.endswith(t.id))
        assert replay.ego_s[0] == 0.0
        assert (case.ego_length, case.ego_width) == pytest.approx(
            (track.length, track.width)
        )
        assert case.ego_v == replay.ego_v[0]
        assert int(case.steps) * STEP_S >= 6.0 - 1e-6
        clock = drive.start_s + np.arange(int(case.steps) + 1) * STEP_S
        speed = np.interp(clock, track.t, track.speed)
        assert np.abs(replay.ego_v - speed).max() < 0.35
        path = np.interp(replay.ego_s, np.arange(NUM_ROAD) * 2.0, case.road.path_l)
        assert np.abs(path - replay.ego_l).max() < 0.1
        half = 0.5 * track.width
        assert np.all(replay.ego_l + half < case.road.edge_left)
        assert np.all(replay.ego_l - half > case.road.edge_right)


def test_path_goes_on_along_the_lane():
    x = at_speed(12.0, 10.0)
    y = 3.5 / (1.0 + np.exp(-(x - 80.0) / 6.0))  # a change to the left lane
    (drive,) = drives(straight([car("me", x, y), car("far", x, 38.0)]), RAW)
    path, road = drive.case.road.path_l, drive.case.road
    assert path[0] == pytest.approx(0.0, abs=0.01)
    np.testing.assert_allclose(path[80:], 3.5, atol=0.01)
    assert (road.lanes_left, road.lanes_right) == (1, 0)
    assert road.lane_width == pytest.approx(3.5)
    np.testing.assert_allclose(road.speed_limit, 20.0)
    assert (road.edge_left, road.edge_right) == pytest.approx((5.25, -1.75))


def test_masks_follow_the_tracks():
    me = car("me", at_speed(10.0, 12.0))
    late = car("late", at_speed(8.0, 5.0, start=90.0), 3.5, 3.0 + np.arange(51) / 10.0)
    gone = car("gone", at_speed(8.0, 1.0), 3.5, t=20.0 + np.arange(11) / 10.0)
    aside = car("aside", at_speed(10.0, 12.0), 45.0)
    recording = straight([me, late, gone, aside])
    (drive,) = [d for d in drives(recording, RAW) if d.id == "hand:me"]
    present = drive.case.replay.present
    assert drive.tracks == (1,)
    expected = np.zeros(121, bool)
    expected[30:81] = True
    np.testing.assert_array_equal(present[0], expected)
    assert not present[1:].any()
    np.testing.assert_array_equal(
        drive.case.agents.kind, [Kind.VEHICLE] + [Kind.NONE] * (NUM_AGENTS - 1)
    )
    np.testing.assert_allclose(drive.case.replay.s[0, 30], 60.0, atol=1e-3)


def test_the_nearest_agents_are_kept():
    me = car("me", at_speed(10.0, 8.0))
    row = [car(f"c{i}", at_speed(10.0, 8.0, start=50.0 + 20.0 * i)) for i in range(20)]
    found = {d.id: d for d in drives(straight([*row, me]), RAW)}
    assert found["hand:me"].tracks == tuple(range(NUM_AGENTS))


def test_drivers_are_medians_and_static_objects_stay():
    me = car("me", at_speed(10.0, 8.0))
    fast = car("fast", at_speed(25.0, 8.0), 3.5)
    slow = car("slow", at_speed(5.0, 8.0, start=120.0), 3.5)
    box = car("box", np.full(81, 150.0), 5.0, kind=Kind.STATIC)
    walker = car("walker", np.full(81, 200.0), 5.0, kind=Kind.PEDESTRIAN)
    toward = car("toward", 300.0 - at_speed(9.0, 8.0), 7.0, heading=np.pi)
    recording = straight([me, fast, slow, box, walker, toward])
    (drive,) = [d for d in drives(recording, RAW) if d.id == "hand:me"]
    agents, order = drive.case.agents, drive.tracks
    pick = lambda leaf, number: float(leaf[order.index(number)])  # noqa: E731
    assert pick(agents.driver.desired, 1) == pytest.approx(25.0, abs=1e-3)
    assert pick(agents.driver.desired, 2) == pytest.approx(16.0, abs=1e-3)
    assert pick(agents.script.start[:, 0], 3) == 0.0
    assert not agents.driver.reacts[order.index(3)]
    assert not agents.driver.reacts[order.index(4)]
    assert pick(agents.heading, 5) == pytest.approx(np.pi)
    assert pick(agents.heading, 1) == 0.0
    usual = {"headway": 1.4, "standstill": 2.0, "acceleration": 1.4, "braking": 2.0}
    for name, value in {**usual, "delay": 0.4}.items():
        np.testing.assert_allclose(getattr(agents.driver, name), value)


def test_what_is_not_suitable_is_counted():
    short = car("short", at_speed(10.0, 5.0))
    stands = car("stands", np.full(100, 300.0), 3.5)
    away = car("away", at_speed(10.0, 8.0), 30.0)
    walker = car("walker", at_speed(1.0, 8.0), kind=Kind.PEDESTRIAN)
    first = car("first", at_speed(10.0, 8.0, start=200.0))
    inside = car("inside", at_speed(10.0, 8.0, start=203.0))
    jumps = at_speed(10.0, 8.0, start=400.0)
    jumps[40:] += 3.0
    noisy = car("noisy", jumps, 3.5)
    machine = car("machine", at_speed(10.0, 8.0, start=100.0))
    machine = dataclasses.replace(machine, automated=((7.0, 9.0),))
    tracks = [short, stands, away, walker, first, inside, noisy, machine]
    dropped = collections.Counter()
    with pytest.raises(InputError, match="expected at least one"):
        recorded_cases([straight(tracks)], RAW, dropped)
    once = ("too_short", "standing", "off_map", "too_noisy", "not_human")
    assert dropped == {**dict.fromkeys(once, 1), "overlapping_boxes": 2}
    assert dropped.keys() <= REASONS.keys()
    kept = dataclasses.replace(RAW, drop_overlaps=False)
    _, ids = recorded_cases([straight(tracks)], kept)
    assert ids == ("hand:first", "hand:inside")


def test_a_start_from_standstill_never_goes_back():
    # the filter of 4.1 s dips back before a start; the case must not
    time = np.arange(0.0, 16.0, 0.1)
    x = 30.0 + 1.5 * np.maximum(time - 6.0, 0.0) ** 2 / 2.0
    (drive,) = drives(straight([car("me", x, t=time)]), RecordedConfig())
    replay = drive.case.replay
    assert np.all(np.diff(replay.ego_s) >= 0.0)
    assert np.all(replay.ego_v[np.append(np.diff(replay.ego_s), 1.0) == 0.0] < 0.1)
    assert np.abs(np.diff(replay.ego_v)).max() < 0.6


def stop_line(**more):
    return (lane("a", stop_line=np.array([[150.0, -2.0], [150.0, 2.0]]), **more),)


def test_lights_only_if_trusted():
    lanes = stop_line(signal_ids=("x",))
    me = car("me", at_speed(10.0, 20.0))  # crosses at about 11.8 s
    starts = np.array([0.0, 6.0, 26.0])
    light = Signal(id="x", start=starts, state=("red", "green", "yellow"))
    (drive,) = drives(straight([me], lanes=lanes, signals=[light]), RAW)
    lines = drive.case.lines
    assert lines.kind[0] == LineKind.LIGHT
    assert lines.s[0] == pytest.approx(120.0, abs=0.01)
    cycle = lines.green[0] + lines.yellow[0] + lines.red[0]
    phase = (np.arange(201) * STEP_S + lines.offset[0]) % cycle
    red = phase >= lines.green[0] + lines.yellow[0]
    np.testing.assert_array_equal(red, np.arange(201) < 60)
    # a converter's schedule that nobody has proved is left out
    guessed = dataclasses.replace(light, is_recorded=False)
    (drive,) = drives(straight([me], lanes=lanes, signals=[guessed]), RAW)
    assert not np.any(drive.case.lines.kind)
    starts = np.array([0.0, 1.0, 3.0, 4.0, 11.0, 13.0])
    wild = Signal(id="x", start=starts, state=("red", "green") * 3)
    dropped = collections.Counter()
    assert not list(drives(straight([me], lanes=lanes, signals=[wild]), RAW, dropped))
    assert dropped == {"irregular_light": 1}


def test_stop_signs_ahead_only():
    lanes = stop_line(stop_sign=True)
    before = car("before", at_speed(10.0, 10.0))
    past = car("past", at_speed(10.0, 10.0, start=160.0))
    first, second = drives(straight([before, past], lanes=lanes), RAW)
    assert first.case.lines.kind[0] == LineKind.STOP_SIGN
    assert not np.any(second.case.lines.kind)


@settings(max_examples=40, deadline=None)
@given(
    durations=st.tuples(*[st.integers(3, 80)] * 3),
    begin=st.integers(0, 400),
    count=st.integers(60, 400),
)
def test_any_cycle_is_found(durations, begin, count):
    green, yellow, red = durations
    phase = (np.arange(count) + begin) % (green + yellow + red)
    colours = (phase >= green).astype(int) + (phase >= green + yellow)
    cycle = light_cycle(colours)
    assert cycle is not None
    offset, g, y, r = np.float32(cycle)
    clock = np.arange(count, dtype=np.float32) * np.float32(0.1)
    again = np.mod(clock + offset, g + y + r)
    shown = (again >= g).astype(int) + (again >= g + y)
    np.testing.assert_array_equal(shown, colours)


def test_stacking_pads_with_absence(turning):
    config = dataclasses.replace(RAW, max_cases=4)
    cases, ids = recorded_cases([turning], config)
    assert len(ids) == len(set(ids)) == 4
    steps = cases.replay.ego_s.shape[1] - 1
    assert steps % 50 == 0
    assert steps >= int(cases.steps.max())
    present = np.asarray(cases.replay.present)
    for row, count in enumerate(np.asarray(cases.steps)):
        assert not present[row, :, count + 1 :].any()
        rest = np.asarray(cases.replay.ego_s[row, count:])
        last = float(cases.replay.ego_v[row, count])
        np.testing.assert_allclose(np.diff(rest), last * STEP_S, atol=1e-3)
    cut, _ = recorded_cases([turning], dataclasses.replace(config, steps=40))
    assert cut.replay.s.shape == (4, NUM_AGENTS, 41)
    np.testing.assert_array_equal(cut.steps, 40)


def _coast(params, scene, key, before):
    return held(scene.ego.v, jnp.zeros(()))


def test_the_simulator_replays_the_human(turning):
    config = dataclasses.replace(RAW, max_cases=3, steps=60)
    cases, _ = recorded_cases([turning], config)
    record, *_ = drive_cases(
        _coast, None, cases, RolloutConfig(steps=60, follow_log=True)
    )
    assert bool(np.all(record.valid))
    np.testing.assert_allclose(record.s, cases.replay.ego_s[:, 1:], atol=1e-3)
    np.testing.assert_allclose(record.v, cases.replay.ego_v[:, 1:], atol=1e-3)
    assert not np.any(record.collision)
    assert not np.any(np.asarray(record.off_road) > 0.3)
    assert np.all(np.isfinite(np.asarray(jax.tree.leaves(record)[1])))


@pytest.mark.dataset
def test_us101(data_dir):
    files = sorted((data_dir / "ngsim_us101_commonroad" / "xml").glob("*.xml"))[:4]
    found = [next(iter(read_recordings("commonroad", file))) for file in files]
    dropped, total = collections.Counter(), 0
    for recording in found:
        for drive in drives(recording, RecordedConfig(), dropped):
            total += 1
            replay, road = drive.case.replay, drive.case.road
            track = next(t for t in recording.tracks if drive.id.endswith(f":{t.id}"))
            clock = drive.start_s + np.arange(int(drive.case.steps) + 1) * STEP_S
            x, y, _ = positions(drive, replay.ego_s.astype(float), replay.ego_l)
            gap_x = x - np.interp(clock, track.t, track.x)
            gap_y = y - np.interp(clock, track.t, track.y)
            assert np.median(np.hypot(gap_x, gap_y)) < 0.25  # m, by the smoothing
            assert np.all(np.diff(replay.ego_s) >= 0.0)
            assert 2.5 < road.lane_width < 5.0
            assert np.abs(np.diff(replay.ego_v)).max() <= 0.6001
            bend = np.diff(road.path_l, 2) / 4.0
            assert np.abs(bend).max() < 0.15  # 1/m, a car can steer it
    assert total > 20
    assert dropped.keys() <= REASONS.keys()
    # the human touches nobody while the others keep to the log
    config = RecordedConfig(steps=100, turns_reactive=False)
    cases, _ = recorded_cases(found, config)
    rollout = RolloutConfig(steps=100, follow_log=True)
    record, *_ = drive_cases(_coast, None, cases, rollout)
    assert not np.any(np.asarray(record.collision) * np.asarray(record.valid))
