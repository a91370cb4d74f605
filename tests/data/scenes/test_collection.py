"""Recordings made by hand -> scenes: motion, paths, lines, masks, drop reasons."""

import dataclasses

import jax
import numpy as np
import pytest

from rcirl_jax.data.importing import digest
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.data.scenes.collect import Collector, assemble
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.scenes.filters import REASONS
from rcirl_jax.data.scenes.lanes import LaneGraph
from rcirl_jax.data.scenes.lines import CREEP_M
from rcirl_jax.data.scenes.motion import driver_of, given_path
from rcirl_jax.data.scenes.tracks import harsh_share, savgol
from rcirl_jax.sampling import trajectory_from_positions
from rcirl_jax.types import (
    Decision,
    Kind,
    Lane,
    MissingAgent,
    Recording,
    Signal,
    Tag,
    Track,
)
from rcirl_jax.units import TIMES_S
from tests.helpers.logs import refused
from tests.helpers.roads import (
    NO_FILTER,
    WIDTH,
    car,
    first_scene,
    lane,
    recording,
    road,
    smooth_step,
    speeding_up,
)


def slot_of(row, at_s):
    """The obstacle whose rear end is nearest to station `at_s` at the frame."""
    return int(np.argmin(np.abs(row["obstacles.s_lower"][:, 0] - at_s)))


def with_ego(start, *others, **more):
    """An ego that speeds up from a station, and others."""
    return recording(car("ego", speeding_up(start)), *others, **more)


PAIR = with_ego(20.0, car("lead", speeding_up(60.0)))


def test_only_what_a_human_drove_is_a_demonstration():
    """One second of automation takes the scenes whose history or future it is in."""
    tracks = [
        car("ego", speeding_up(0.0), seconds=30.0, automated=((15.0, 16.0),)),
        car("other", speeding_up(40.0), seconds=30.0),
    ]
    collector = Collector(recording(*tracks, lanes=road(length=900.0)), NO_FILTER)
    rows = list(collector.scenes())
    starts = {n: {r["frame"] for r in rows if r["track"] == n} for n in (0, 1)}
    gone = starts[1] - starts[0]
    history = NO_FILTER.min_history_s
    assert starts[0] < starts[1]
    assert gone == {k for k in starts[1] if 7.0 < 0.1 * k < 16.0 + history}
    assert collector.dropped["not_human"] == len(gone)
    bad = recording(car("ego", speeding_up(0.0), automated=((3.0, 2.0),)))
    line = refused(validate_recording, bad)
    assert "automated: 3.0 to 2.0 s: expected a span" in line


def test_smoothing_keeps_cubics_and_cuts_noise():
    t = np.arange(0.0, 10.0, 0.1)
    cubic = 3.0 + 2.0 * t - 0.4 * t**2 + 0.03 * t**3
    np.testing.assert_allclose(savgol(cubic, 10.0, 2.1), cubic, atol=1e-9)
    noisy = 12.0 * t + np.random.default_rng(0).normal(0.0, 0.05, t.size)
    before = harsh_share(noisy, 0 * t, 10.0)[0]
    after = harsh_share(savgol(noisy, 10.0, 2.1), 0 * t, 10.0)[0]
    assert after < 0.1 * before


def test_the_ego_and_a_leader():
    row = first_scene(with_ego(20.0, car("lead", speeding_up(50.0))))
    assert row["ego.v"] == pytest.approx(12.15, abs=0.02)
    assert row["ego.a"] == pytest.approx(0.3, abs=0.02)
    np.testing.assert_allclose(
        row["obstacles.s_lower"][0], row["human.s"] + 27.75, atol=0.05
    )
    np.testing.assert_allclose(row["obstacles.l_upper"][0], 0.9, atol=0.02)
    np.testing.assert_allclose(
        row["obstacles.speed"][0][:10], 12.15 + 0.3 * TIMES_S[:10], atol=0.05
    )


@pytest.mark.parametrize(("a", "l_dot"), [(-0.8, 0.0), (0.5, 0.25), (0.0, -0.25)])
def test_rates_at_the_frame(a, l_dot):
    """A quadratic in s and a line in l pass the smoothing unchanged."""
    lead = speeding_up(40.0, v=14.0, a=a)
    row = first_scene(
        with_ego(
            0.0,
            car("lead", lead, y=lambda t: l_dot * (t - 2.0)),
            car("far", speeding_up(90.0)),
        )
    )
    assert row["frame"] == 5
    slot = slot_of(row, 40.0 + 0.5 * 2.0 - 2.25)
    assert row["obstacles.a"][slot] == pytest.approx(a, abs=0.01)
    assert row["obstacles.l_dot"][slot] == pytest.approx(l_dot, abs=0.01)
    empty = row["obstacles.kind"] == Kind.NONE
    assert empty.any()
    assert not row["obstacles.a"][empty].any()
    assert not row["obstacles.l_dot"][empty].any()


def test_the_speed_limit_is_what_a_planner_may_drive():
    """From 300 m on 5 m/s, beyond the scene's 254 m: braked for with 1 m/s^2."""
    x = np.arange(0.0, 301.0, 5.0)
    lanes = (lane("a", x, 0.0, 25.0, successors=("b",)), lane("b", 300.0 + x, 0.0, 5.0))
    row = first_scene(dataclasses.replace(PAIR, lanes=lanes))
    here = 20.0 + 12.0 * 0.5 + 0.5 * 0.3 * 0.5**2
    to_go = 300.0 - here - 2.0 * np.arange(128)
    expected = np.minimum(25.0, np.sqrt(5.0**2 + 2.0 * to_go))
    # the lower limit counts from up to one grid point of 2 m earlier
    np.testing.assert_array_less(row["path.speed_limit"], expected + 1e-3)
    earlier = np.sqrt(5.0**2 + 2.0 * (to_go - 4.0))
    np.testing.assert_array_less(
        np.minimum(25.0, earlier) - 1e-3, row["path.speed_limit"]
    )
    assert row["path.speed_limit"][-1] < 10.0


def test_the_path_turns_along_the_lane_after_the_record():
    """It ends 80 m ahead with a slope of 0.05: 0.05 * 10 m more, and no sharp bend."""
    t = np.arange(0.0, 8.05, 0.1)
    s = 10.0 * t
    grid = 2.0 * np.arange(128)
    path = given_path(driver_of(s, 0.05 * s, 10.0), 0, 0.0, 1e3)
    beyond = np.maximum(grid - 80.0, 0.0)
    expected = 0.05 * np.minimum(grid, 80.0) + 0.5 - 0.5 * np.exp(-beyond / 10.0)
    np.testing.assert_allclose(path, expected, atol=1e-9)
    bend = np.gradient(np.gradient(path, 2.0), 2.0)
    assert np.abs(bend).max() < 0.05 / 10.0  # held at its offset: 0.05 / 4
    stands = driver_of(0 * s, 0 * s + 1.0, 10.0)
    np.testing.assert_array_equal(given_path(stands, 0, 0.0, 1e3), 1.0)


def test_the_branch_that_was_driven():
    x = np.arange(0, 101, 5.0)
    lanes = (
        lane("in", x, 0.0, successors=("on", "off")),
        lane("on", x + 100.0, 0.0),
        lane("off", x + 100.0, x**2 / 100),
    )
    graph = LaneGraph(with_ego(0.0, lanes=lanes))
    assert graph.chain("in", ["in"]) == ("in", "on")
    assert graph.chain("in", ["in", "off"]) == ("in", "off")
    assert graph.chain("off", ["off"]) == ("in", "off")


def test_on_overlapping_branches_the_track_keeps_to_one():
    """A fork whose branches lie within centimetres for thirty metres."""
    x = np.arange(0.0, 81.0, 2.0)
    lanes = (
        lane("in", x - 80.0, 0.0, successors=("left", "right")),
        lane("left", x, 0.002 * x**2),
        lane("right", x, -0.002 * x**2),
    )
    graph = LaneGraph(with_ego(20.0, lanes=lanes))
    rng = np.random.default_rng(0)
    y = 0.002 * x**2 + rng.normal(0.0, 0.1, x.size)
    got = graph.match(x, y, np.arctan(0.004 * x))
    assert set(got[2:]) == {"left"}
    assert graph.chain("in", ["in", "right", "left", "left"]) == ("in", "left")


def test_a_lead_that_drives_out_of_view_is_followed():
    """It is in the way until nobody sees it any more, here for less than 2 s."""
    ego = car("ego", lambda t: 20.0 + 14.0 * t)
    lead = car("lead", lambda t: 245.0 + 32.0 * t)
    row = first_scene(recording(ego, lead, lanes=road(length=900.0)))
    assert 0 < row["obstacles.valid"][0].sum() < np.count_nonzero(TIMES_S <= 2.0)
    assert Decision(row["decisions"][0]) == Decision.FOLLOW


def test_lane_change():
    ego = car("ego", speeding_up(20.0), y=lambda t: WIDTH * smooth_step(t, 1, 5))
    row = first_scene(recording(ego, car("lead", speeding_up(60.0))))
    assert row["tags"][Tag.LANE_CHANGE]
    assert row["human.l"][-1] - row["human.l"][0] == pytest.approx(WIDTH, abs=0.3)
    assert row["path.l"][60] == pytest.approx(WIDTH, abs=0.1)


def test_who_enters_an_exit_late_is_described_along_it():
    """The driver was beside its first piece, on a lane that goes straight on."""
    first, later = np.arange(0.0, 101.0, 5.0), np.arange(100.0, 501.0, 5.0)
    away = lambda x: -WIDTH - 0.0008 * np.maximum(x - 100.0, 0.0) ** 2  # noqa: E731
    lanes = (
        lane("near", first, 0.0, right="exit", successors=("far",)),
        lane("far", later, 0.0),
        lane("exit", first, away(first), left="near", successors=("away",)),
        lane("away", later, away(later)),
    )
    s = speeding_up(20.0)
    ego = car("ego", s, y=lambda t: smooth_step(t, 5.5, 3.5) * away(s(t)))
    made = recording(ego, lanes=lanes)
    graph = LaneGraph(made)
    assert "exit" not in graph.match(ego.x, ego.y, ego.heading)
    row = first_scene(made)
    assert row["human.l"][0] == pytest.approx(WIDTH, abs=0.05)
    assert abs(row["human.l"][-1]) < 0.3
    assert row["tags"][Tag.LANE_CHANGE]


def braking_to(line, start=20.0, v=12.0, after=0.2):
    """Even braking to a standstill with the front at the line."""
    b = v**2 / (2.0 * (line - 2.25 - start - v * after))

    def s(t):
        u = np.clip(t - after, 0.0, v / b)
        return start + v * np.minimum(t, after) + v * u - 0.5 * b * u**2

    return s


def light(name="s1", state="red"):
    return Signal(id=name, start=np.array([0.0]), state=(state,))


def lit(*tracks, at, signals=None):
    """A road with a line at x [m] and its lights, by default a red one."""
    signals = signals or (light(),)
    names = tuple(signal.id for signal in signals)
    return recording(*tracks, lanes=road(at, names), signals=signals)


def test_stop_at_a_red_light():
    row = first_scene(lit(car("ego", braking_to(61.5)), at=62.0))
    slot = int(np.flatnonzero(row["obstacles.kind"] == Kind.STOP)[0])
    assert row["obstacles.s_lower"][slot, 0] == pytest.approx(36.0, abs=0.4)
    assert row["decisions"][slot] == Decision.STOP
    assert row["tags"][Tag.RED_LIGHT]
    green = lit(car("ego", speeding_up(20.0)), at=80.0, signals=(light("s", "green"),))
    assert not (first_scene(green)["obstacles.kind"] == Kind.STOP).any()


@pytest.mark.parametrize(("over", "waits"), [(-1.0, True), (1.2, True), (2.0, False)])
def test_a_car_standing_over_its_line_waits_for_the_light(over, waits):
    """The front is `over` m beyond the line while the light is red."""
    turns = Signal(id="s1", start=np.array([0.0, 6.0]), state=("red", "green"))
    place = 60.0 + over - 4.5 / 2
    ego = car("ego", lambda t: place + 0.5 * np.maximum(t - 7.0, 0.0) ** 2)
    row = first_scene(lit(ego, at=60.0, signals=(turns,)))
    slots = np.flatnonzero(row["obstacles.kind"] == Kind.STOP)
    assert bool(slots.size) == waits == bool(row["tags"][Tag.RED_LIGHT])
    if waits:
        assert row["decisions"][slots[0]] == Decision.STOP
        gap = row["obstacles.s_lower"][slots[0], 0] - 4.5 / 2
        assert gap == pytest.approx(max(-over, CREEP_M), abs=0.1)
        assert not row["obstacles.valid"][slots[0], -1]


FOUR = [car(f"c{i}", speeding_up(10.0 * i)) for i in range(4)]


@pytest.mark.parametrize(
    ("signals", "kept"),
    [
        # four cars cross on what a converter says is red
        ((dataclasses.replace(light(), is_recorded=False),), ()),
        # left-turners on their green arrow do not disprove the red light ahead
        ((light("arrow", "green"), light("light")), ("arrow", "light")),
    ],
)
def test_a_written_cycle_that_drivers_contradict_is_not_used(signals, kept):
    collector = Collector(lit(*FOUR, at=90.0, signals=signals), NO_FILTER)
    assert set(collector.signals) == set(kept)
    assert any(row["tags"][Tag.RED_LIGHT] for row in collector.scenes()) == bool(kept)


def test_destination_is_a_virtual_obstacle():
    ego = car("ego", braking_to(62.25), destination=(60.0, 0.0))
    row = first_scene(recording(ego))
    slot = int(np.flatnonzero(row["obstacles.kind"] == Kind.VIRTUAL)[0])
    assert row["decisions"][slot] == Decision.STOP
    assert row["obstacles.s_lower"][slot, 0] == pytest.approx(36.25, abs=0.4)


def hard():
    """A recording for each drop reason."""
    ego, lead = PAIR.tracks
    steady = car("ego", lambda t: 20.0 + 12.0 * t)
    jerky = car("ego", lambda t: 20 + 12 * t + 4.0 * np.sin(2 * t))
    leaves = car("ego", speeding_up(20.0), y=lambda t: 9.0 * smooth_step(t, 1, 5))
    by_machine = dataclasses.replace(ego, automated=((5.0, 12.0),))
    agent = MissingAgent(t0=0.0, t1=10.0, start=(45.0, 0.0), end=(190.0, 0.0))
    short = car("lead", speeding_up(60.0), seconds=2.0)
    return {
        "future_too_short": recording(car("ego", speeding_up(20.0), seconds=3.0)),
        "off_map": recording(car("ego", speeding_up(20.0), y=40.0), lead),
        "not_human": recording(by_machine, lead),
        "far_from_road": recording(leaves, lead),
        "no_obstacles": recording(ego),
        "no_speed_change": recording(steady, lead),
        "too_noisy": recording(jerky, lead),
        "overlapping_boxes": recording(ego, car("twin", speeding_up(22.0))),
        "follows_missing_car": recording(ego, lead, missing_agents=(agent,)),
        "surroundings_end": recording(ego, short),
    }


@pytest.mark.parametrize("reason", REASONS)
def test_every_drop_reason_is_counted(reason):
    dropped = first_scene(hard()[reason], config=CollectConfig())
    assert isinstance(dropped, dict)
    assert dropped.get(reason, 0) >= 1


def test_assembled_human_is_the_shared_operators():
    rows = list(Collector(PAIR, NO_FILTER).scenes())
    zeros = [0] * len(rows)
    block = assemble(rows, vehicles=zeros, groups=zeros, recording=0)
    again = jax.jit(jax.vmap(trajectory_from_positions))(
        block.scene, block.human.s, block.human.l
    )
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(block.human), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-5)


def other(value):
    """Something of the same type that is not equal."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, tuple):
        return (*value, value[-1]) if value else ("x",)
    if isinstance(value, str):
        return value + "x"
    return value + 1 if isinstance(value, int | float | np.ndarray) else "x"


@pytest.mark.parametrize("kind", [Recording, Track, Lane, Signal])
def test_every_field_changes_the_digest(kind):
    signal = Signal(id="s", start=np.array([0.0, 5.0]), state=("red", "green"))
    made = with_ego(20.0, lanes=road(50.0, ("s",)), signals=(signal,))
    places = {Track: "tracks", Lane: "lanes", Signal: "signals"}
    before = digest(made)
    assert before == digest(dataclasses.replace(made))
    for field in dataclasses.fields(kind):
        if kind is Recording:
            changed = {field.name: other(getattr(made, field.name))}
        else:
            first, *rest = getattr(made, places[kind])
            value = other(getattr(first, field.name))
            first = dataclasses.replace(first, **{field.name: value})
            changed = {places[kind]: (first, *rest)}
        # what is not compared (how much of the input is read) is no part of a recording
        is_new = digest(dataclasses.replace(made, **changed)) != before
        assert is_new == field.compare, field.name
