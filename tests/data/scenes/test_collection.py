"""Recordings made by hand -> scenes: labels, tags, drop reasons, import."""

import dataclasses
import re
from pathlib import Path

import jax
import numpy as np
import pytest

from rcirl_jax.data import importing
from rcirl_jax.data.cut import digest
from rcirl_jax.data.importers import read_recordings
from rcirl_jax.data.importing import ImportConfig, import_logs
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.data.scenes.assemble import assemble
from rcirl_jax.data.scenes.collect import Collector
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.scenes.filters import REASONS
from rcirl_jax.data.scenes.labels import labels_of
from rcirl_jax.data.scenes.lanes import LaneGraph
from rcirl_jax.data.scenes.lines import CREEP_M, TOO_FEW
from rcirl_jax.data.scenes.motion import FrameTracks, driver_of, given_path
from rcirl_jax.data.scenes.quality import QualityReport, format_quality, format_splits
from rcirl_jax.data.scenes.smoothing import harsh_share, savgol
from rcirl_jax.data.store import files
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.data.store.rows import check_finite
from rcirl_jax.errors import InputError
from rcirl_jax.sampling import trajectory_from_positions
from rcirl_jax.types import Decision, Ghost, Kind, Lane, Recording, Signal, Tag, Track
from rcirl_jax.units import TIMES_S

WIDTH = 3.6
NO_FILTER = CollectConfig(require_obstacles=False, require_speed_change=False)


def road(stop_line=None, signals=(), length=500.0):
    x = np.arange(0.0, length + 1.0, 5.0)
    half = np.full(x.shape, WIDTH / 2)
    names = ("left", "mid", "right")
    return tuple(
        Lane(
            id=name,
            centre=np.stack([x, np.full(x.shape, (1 - i) * WIDTH)], 1),
            left_width=half,
            right_width=half,
            speed_limit=25.0,
            left=names[i - 1] if i else None,
            right=names[i + 1] if i < 2 else None,
            stop_line=None
            if stop_line is None
            else np.array(
                [[stop_line, (1 - i) * WIDTH + side] for side in (1.8, -1.8)]
            ),
            signal_ids=signals,
        )
        for i, name in enumerate(names)
    )


def car(name, s, y=0.0, seconds=12.0, kind=Kind.VEHICLE, **more):
    """A track from callables of time s(t), y(t)."""
    t = np.arange(0.0, seconds + 1e-9, 0.1)
    x = np.asarray(s(t), float) * np.ones_like(t)
    y = (y(t) if callable(y) else y) * np.ones_like(t)
    vx, vy = np.gradient(x, t), np.gradient(y, t)
    moving = np.hypot(vx, vy) > 0.3
    return Track(
        id=name,
        kind=kind,
        length=4.5,
        width=1.8,
        t=t,
        x=x,
        y=y,
        heading=np.where(moving, np.arctan2(vy, np.maximum(vx, 1e-3)), 0.0),
        speed=np.hypot(vx, vy),
        **more,
    )


def recording(*tracks, lanes=None, **more):
    return Recording(
        name="hand",
        source="test",
        licence="none",
        rate_hz=10.0,
        tracks=tracks,
        lanes=lanes or road(),
        **more,
    )


def speeding_up(start, v=12.0, a=0.3):
    return lambda t: start + v * t + 0.5 * a * t**2


def first_scene(made, ego="ego", config=NO_FILTER):
    """The first scene of the ego, or the counted drop reasons."""
    collector = Collector(made, config)
    number = [track.id for track in made.tracks].index(ego)
    rows = [row for row in collector.scenes() if row["track"] == number]
    return rows[0] if rows else dict(collector.dropped)


def decision_of(row, at_s):
    """Decision about the obstacle whose rear end starts at station `at_s`."""
    slot = np.argmin(np.abs(row["obstacles.s_lower"][:, 0] - at_s))
    return Decision(row["decisions"][slot])


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
    with pytest.raises(InputError, match=r"automated: 3\.0 to 2\.0 s: expected a span"):
        validate_recording(
            recording(car("ego", speeding_up(0.0), automated=((3.0, 2.0),)))
        )


def test_smoothing_keeps_cubics_and_cuts_noise():
    t = np.arange(0.0, 10.0, 0.1)
    cubic = 3.0 + 2.0 * t - 0.4 * t**2 + 0.03 * t**3
    np.testing.assert_allclose(savgol(cubic, 10.0, 2.1), cubic, atol=1e-9)
    noisy = 12.0 * t + np.random.default_rng(0).normal(0.0, 0.05, t.size)
    before = harsh_share(noisy, 0 * t, 10.0)[0]
    after = harsh_share(savgol(noisy, 10.0, 2.1), 0 * t, 10.0)[0]
    assert after < 0.1 * before


def test_follow():
    made = recording(
        car("ego", speeding_up(20.0)), car("lead", speeding_up(50.0), seconds=12.0)
    )
    row = first_scene(made)
    assert row["ego.v"] == pytest.approx(12.15, abs=0.02)
    assert row["ego.a"] == pytest.approx(0.3, abs=0.02)
    assert decision_of(row, 30.0 - 2.25) == Decision.FOLLOW
    assert row["tags"][Tag.FOLLOWING]
    np.testing.assert_allclose(
        row["obstacles.s_lower"][0], row["human.s"] + 27.75, atol=0.05
    )
    np.testing.assert_allclose(row["obstacles.l_upper"][0], 0.9, atol=0.02)
    np.testing.assert_allclose(
        row["obstacles.speed"][0][:10], 12.15 + 0.3 * TIMES_S[:10], atol=0.05
    )


def slot_of(row, at_s):
    """The obstacle whose rear end is nearest to station `at_s` at the frame."""
    return int(np.argmin(np.abs(row["obstacles.s_lower"][:, 0] - at_s)))


@pytest.mark.parametrize(("a", "l_dot"), [(-0.8, 0.0), (0.5, 0.25), (0.0, -0.25)])
def test_rates_at_the_frame(a, l_dot):
    """A quadratic in s and a line in l pass the smoothing unchanged."""
    made = recording(
        car("ego", speeding_up(0.0)),
        car("lead", speeding_up(40.0, v=14.0, a=a), y=lambda t: l_dot * (t - 2.0)),
        car("far", speeding_up(90.0)),
    )
    row = first_scene(made)
    assert row["frame"] == 5
    lead = slot_of(row, 40.0 + 0.5 * 2.0 - 2.25)
    assert row["obstacles.a"][lead] == pytest.approx(a, abs=0.01)
    assert row["obstacles.l_dot"][lead] == pytest.approx(l_dot, abs=0.01)
    empty = row["obstacles.kind"] == Kind.NONE
    assert empty.any()
    assert not row["obstacles.a"][empty].any()
    assert not row["obstacles.l_dot"][empty].any()


def test_the_speed_limit_is_what_a_planner_may_drive():
    """From 300 m on 5 m/s, beyond the scene's 254 m: braked for with 1 m/s^2."""
    half = np.full(61, WIDTH / 2)
    parts = {"a": (0.0, 25.0, ("b",)), "b": (300.0, 5.0, ())}
    lanes = tuple(
        Lane(
            id=name,
            centre=np.stack([start + np.arange(0.0, 301.0, 5.0), 0.0 * half], 1),
            left_width=half,
            right_width=half,
            speed_limit=limit,
            successors=after,
        )
        for name, (start, limit, after) in parts.items()
    )
    made = recording(
        car("ego", speeding_up(20.0)), car("lead", speeding_up(60.0)), lanes=lanes
    )
    row = first_scene(made)
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
    view = FrameTracks(s=[s], l=[0.05 * s], tilt=[0.0 * s], table=np.zeros((1, 4)))
    driver = driver_of(view, 0, 10.0)
    grid = 2.0 * np.arange(128)
    path = given_path(driver, 0, 0.0, 1e3)
    beyond = np.maximum(grid - 80.0, 0.0)
    expected = 0.05 * np.minimum(grid, 80.0) + 0.5 - 0.5 * np.exp(-beyond / 10.0)
    np.testing.assert_allclose(path, expected, atol=1e-9)
    bend = np.gradient(np.gradient(path, 2.0), 2.0)
    assert np.abs(bend).max() < 0.05 / 10.0  # held at its offset: 0.05 / 4
    stands = FrameTracks(s=[0 * s], l=[0 * s + 1.0], tilt=[0 * s], table=view.table)
    np.testing.assert_array_equal(
        given_path(driver_of(stands, 0, 10.0), 0, 0.0, 1e3), 1.0
    )


def smooth_step(t, start, duration):
    u = np.clip((t - start) / duration, 0.0, 1.0)
    return u**3 * (10 - 15 * u + 6 * u**2)


def entering(t):
    """From the left lane into the middle one between 2 and 5 s."""
    return WIDTH * (1.0 - smooth_step(t, 2, 3))


def test_a_lead_that_drives_out_of_view_is_followed():
    """It is in the way until nobody sees it any more, here for less than 2 s."""
    made = recording(
        car("ego", lambda t: 20.0 + 14.0 * t),
        car("lead", lambda t: 245.0 + 32.0 * t),
        lanes=road(length=900.0),
    )
    row = first_scene(made)
    assert 0 < row["obstacles.valid"][0].sum() < np.count_nonzero(TIMES_S <= 2.0)
    assert Decision(row["decisions"][0]) == Decision.FOLLOW


def test_cut_in_and_yield():
    """A car from the left lane enters ahead after three seconds."""
    made = recording(
        car("ego", speeding_up(20.0)),
        car("cutter", speeding_up(38.0), y=entering),
    )
    row = first_scene(made)
    assert decision_of(row, 18.0 - 2.25) == Decision.YIELD
    assert row["tags"][Tag.CUT_IN]
    assert row["tags"][Tag.YIELDING]


def test_overtake_of_a_car_that_enters_behind():
    made = recording(
        car("ego", speeding_up(40.0)),
        car("late", speeding_up(25.0), y=entering),
    )
    row = first_scene(made)
    assert decision_of(row, -15.0 - 2.25) == Decision.OVERTAKE
    assert row["tags"][Tag.OVERTAKING]


def test_a_car_behind_from_the_start_is_ignored():
    made = recording(car("ego", speeding_up(40.0)), car("rear", speeding_up(15.0)))
    assert decision_of(first_scene(made), -25.0 - 2.25) == Decision.IGNORE


@pytest.mark.parametrize(
    ("side", "expected"), [(-2.6, Decision.NUDGE_LEFT), (2.6, Decision.NUDGE_RIGHT)]
)
def test_nudge_past_a_parked_car(side, expected):
    made = recording(
        car("ego", speeding_up(20.0)),
        car("parked", lambda t: 70.0, y=side, kind=Kind.STATIC),
    )
    row = first_scene(made)
    assert decision_of(row, 70 - row["human.s"][0] - 26.08 - 2.25) == expected
    assert row["tags"][Tag.NUDGING]


def test_lane_change():
    made = recording(
        car("ego", speeding_up(20.0), y=lambda t: WIDTH * smooth_step(t, 1, 5)),
        car("lead", speeding_up(60.0)),
    )
    row = first_scene(made)
    assert row["tags"][Tag.LANE_CHANGE]
    assert row["human.l"][-1] - row["human.l"][0] == pytest.approx(WIDTH, abs=0.3)
    assert row["path.l"][60] == pytest.approx(WIDTH, abs=0.1)


def braking_to(start, line, v=12.0, after=1.0):
    """Even braking to a standstill with the front at the line."""
    distance = line - 2.25 - start - v * after
    b = v**2 / (2.0 * distance)

    def s(t):
        u = np.clip(t - after, 0.0, v / b)
        return start + v * np.minimum(t, after) + v * u - 0.5 * b * u**2

    return s


def red_light(always="red"):
    return Signal(id="s1", start=np.array([0.0]), state=(always,))


def test_stop_at_a_red_light():
    made = recording(
        car("ego", braking_to(20.0, 61.5, after=0.2)),
        lanes=road(stop_line=62.0, signals=("s1",)),
        signals=(red_light(),),
    )
    row = first_scene(made)
    slot = int(np.flatnonzero(row["obstacles.kind"] == Kind.STOP)[0])
    assert row["obstacles.s_lower"][slot, 0] == pytest.approx(36.0, abs=0.4)
    assert row["decisions"][slot] == Decision.STOP
    assert row["tags"][Tag.RED_LIGHT]


@pytest.mark.parametrize(("over", "waits"), [(-1.0, True), (1.2, True), (2.0, False)])
def test_a_car_standing_over_its_line_waits_for_the_light(over, waits):
    """The front is `over` m beyond the line while the light is red."""
    light = Signal(id="s1", start=np.array([0.0, 6.0]), state=("red", "green"))
    place = 60.0 + over - 4.5 / 2
    made = recording(
        car("ego", lambda t: place + 0.5 * np.maximum(t - 7.0, 0.0) ** 2),
        lanes=road(stop_line=60.0, signals=("s1",)),
        signals=(light,),
    )
    row = first_scene(made)
    slots = np.flatnonzero(row["obstacles.kind"] == Kind.STOP)
    assert bool(slots.size) == waits == bool(row["tags"][Tag.RED_LIGHT])
    if waits:
        assert row["decisions"][slots[0]] == Decision.STOP
        gap = row["obstacles.s_lower"][slots[0], 0] - 4.5 / 2
        assert gap == pytest.approx(max(-over, CREEP_M), abs=0.1)
        assert not row["obstacles.valid"][slots[0], -1]


def test_a_green_light_demands_nothing():
    made = recording(
        car("ego", speeding_up(20.0)),
        lanes=road(stop_line=80.0, signals=("s1",)),
        signals=(red_light("green"),),
    )
    assert not (first_scene(made)["obstacles.kind"] == Kind.STOP).any()


def test_a_written_cycle_that_drivers_contradict_is_not_used():
    """Four cars cross on what a converter says is red."""
    cars = [car(f"c{i}", speeding_up(10.0 * i), y=0.0) for i in range(4)]
    written = dataclasses.replace(red_light(), is_recorded=False)
    made = recording(
        *cars, lanes=road(stop_line=90.0, signals=("s1",)), signals=(written,)
    )
    collector = Collector(made, NO_FILTER)
    assert not collector.signals
    assert "disagrees" in collector.signal_notes[0]


def test_destination_is_a_virtual_obstacle():
    made = recording(
        car("ego", braking_to(20.0, 62.25, after=0.2), destination=(60.0, 0.0)),
    )
    row = first_scene(made)
    slot = int(np.flatnonzero(row["obstacles.kind"] == Kind.VIRTUAL)[0])
    assert row["decisions"][slot] == Decision.STOP
    assert row["obstacles.s_lower"][slot, 0] == pytest.approx(36.25, abs=0.4)


def test_time_mask_of_a_short_track():
    made = recording(car("ego", speeding_up(20.0), seconds=6.5))
    row = first_scene(made)
    assert row["future_s"] == pytest.approx(6.0)
    assert row["time_valid"].sum() == np.sum(TIMES_S <= 6.0)
    assert row["s_at_5s"] == pytest.approx(12.15 * 5 + 0.5 * 0.3 * 25, abs=0.05)


def test_the_branch_that_was_driven():
    straight = np.stack([np.arange(0, 101, 5.0), np.zeros(21)], 1)
    half = np.full(21, 1.8)

    def lane(name, points, successors=()):
        return Lane(
            id=name,
            centre=points,
            left_width=half,
            right_width=half,
            speed_limit=10.0,
            successors=successors,
        )

    ahead = straight + np.array([100.0, 0.0])
    along = np.arange(0, 101, 5.0)
    bent = np.stack([100 + along, along**2 / 100], 1)
    made = recording(
        car("ego", speeding_up(0.0)),
        lanes=(
            lane("in", straight, ("on", "off")),
            lane("on", ahead),
            lane("off", bent),
        ),
    )
    graph = LaneGraph(made)
    assert graph.chain("in", ["in"]) == ("in", "on")
    assert graph.chain("in", ["in", "off"]) == ("in", "off")
    assert graph.chain("off", ["off"]) == ("in", "off")


def hard(name):
    """A recording, settings and ego for each drop reason."""
    lead = car("lead", speeding_up(60.0))
    ego = car("ego", speeding_up(20.0))
    steady = car("ego", lambda t: 20.0 + 12.0 * t)
    jerky = car("ego", lambda t: 20 + 12 * t + 4.0 * np.sin(2 * t))
    ghost = Ghost(t0=0.0, t1=10.0, start=(45.0, 0.0), end=(190.0, 0.0))
    table = {
        "future_too_short": recording(car("ego", speeding_up(20.0), seconds=3.0)),
        "off_map": recording(car("ego", speeding_up(20.0), y=40.0), lead),
        "not_human": recording(
            car("ego", speeding_up(20.0), automated=((5.0, 12.0),)), lead
        ),
        "far_from_road": recording(
            car("ego", speeding_up(20.0), y=lambda t: 9.0 * smooth_step(t, 1, 5)), lead
        ),
        "no_obstacles": recording(ego),
        "no_speed_change": recording(steady, lead),
        "too_noisy": recording(jerky, lead),
        "overlapping_boxes": recording(ego, car("twin", speeding_up(22.0))),
        "follows_missing_car": recording(ego, lead, ghosts=(ghost,)),
        "surroundings_end": recording(ego, car("lead", speeding_up(60.0), seconds=2.0)),
    }
    return table[name]


@pytest.mark.parametrize("reason", REASONS)
def test_every_drop_reason_is_counted(reason):
    dropped = first_scene(hard(reason), config=CollectConfig())
    assert isinstance(dropped, dict)
    assert dropped.get(reason, 0) >= 1


def test_assembled_human_is_the_shared_operators():
    made = recording(car("ego", speeding_up(20.0)), car("lead", speeding_up(60.0)))
    rows = list(Collector(made, NO_FILTER).scenes())
    zeros = [0] * len(rows)
    block = assemble(rows, vehicles=zeros, groups=zeros, recording=0)
    again = jax.jit(jax.vmap(trajectory_from_positions))(
        block.scene, block.human.s, block.human.l
    )
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(block.human), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-5)


def test_quality_report_fits_a_terminal():
    made = recording(car("ego", speeding_up(20.0)), car("lead", speeding_up(60.0)))
    collector = Collector(made, NO_FILTER)
    rows = list(collector.scenes())
    report = QualityReport()
    report.add_recording(collector)
    report.add_scenes(
        assemble(rows, vehicles=[0] * len(rows), groups=[0] * len(rows), recording=0)
    )
    again = QualityReport()
    again.merge(report.state())
    assert again.as_dict() == report.as_dict()
    text = format_quality(report.as_dict())
    assert set(report.as_dict()["dropped"]) == set(REASONS)
    assert max(len(line) for line in text.splitlines()[:-1]) <= 100
    assert "--signals" not in text


def test_quality_report_says_how_lights_are_borne_out():
    report = QualityReport()
    report.notes.append(f"a: signal 7: {TOO_FEW} (0 on red of 2); unused")
    text = format_quality(report.as_dict())
    assert "--signals=pooled" in text


def three_recordings():
    for i in range(3):
        made = recording(
            car("ego", speeding_up(20.0 + i)), car("lead", speeding_up(60.0))
        )
        yield validate_recording(dataclasses.replace(made, name=f"r{i}", group=f"g{i}"))


CONFIG = ImportConfig(format="test", collect=NO_FILTER, test_fraction=0.4)


def files_of(folder):
    found = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder): path.read_bytes() for path in found}


def test_interrupted_import_resumes_to_the_same_bytes(tmp_path, monkeypatch):
    monkeypatch.setattr(importing, "SHARD_SCENES", 1)
    import_logs(three_recordings(), tmp_path / "whole", CONFIG)

    def interrupted():
        yield from list(three_recordings())[:2]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_logs(interrupted(), tmp_path / "part", CONFIG)
    with pytest.raises(InputError, match="interrupted"):
        open_dataset(tmp_path / "part")
    import_logs(three_recordings(), tmp_path / "part", CONFIG)
    assert files_of(tmp_path / "part") == files_of(tmp_path / "whole")


def test_resume_with_other_settings_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(importing, "SHARD_SCENES", 1)

    def interrupted():
        yield from list(three_recordings())[:1]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_logs(interrupted(), tmp_path / "part", CONFIG)
    other = dataclasses.replace(
        CONFIG, collect=dataclasses.replace(NO_FILTER, stride_s=1.0)
    )
    with pytest.raises(InputError, match="settings changed"):
        import_logs(three_recordings(), tmp_path / "part", other)


def test_bad_input_in_the_middle_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(importing, "SHARD_SCENES", 1)

    def broken():
        yield from list(three_recordings())[:2]
        raise InputError("r2: x: nan: expected a finite number")

    with pytest.raises(InputError, match="r2: x: nan"):
        import_logs(broken(), tmp_path / "out", CONFIG)
    assert not (tmp_path / "out").exists() or not files_of(tmp_path / "out")


@pytest.mark.parametrize("name", ["manifest.json", "shards/00002/shard.json"])
def test_too_many_names_leave_what_is_finished(tmp_path, monkeypatch, name):
    """A dataset that could not be read again is not written."""
    monkeypatch.setattr(importing, "SHARD_SCENES", 1)

    def named():
        *first, last = three_recordings()
        yield from first
        yield dataclasses.replace(last, name=1000 * "x")

    import_logs(named(), tmp_path / "whole", CONFIG)
    whole, out = files_of(tmp_path / "whole"), tmp_path / "out"
    most = len(whole[Path(name)]) - 1
    with monkeypatch.context() as patched:
        patched.setitem(files.JSON_BYTES, name.rpartition("/")[2], most)
        with pytest.raises(InputError, match=f"{name}: .*: expected {most} at most"):
            import_logs(named(), out, CONFIG)
    kept = {path: path.stat().st_mtime_ns for path in out.rglob("shard.json")}
    assert len(kept) == (3 if name == "manifest.json" else 2)
    assert not (out / "manifest.json").exists()
    import_logs(named(), out, CONFIG)
    assert all(path.stat().st_mtime_ns == when for path, when in kept.items())
    assert files_of(out) == whole


def test_nothing_kept_says_why(tmp_path):
    lonely = recording(car("ego", speeding_up(20.0), seconds=3.0))
    with pytest.raises(InputError, match="0 scenes kept of 1 tracks"):
        import_logs([lonely], tmp_path / "out", CONFIG)
    assert not (tmp_path / "out").exists()


def test_no_vehicle_in_both_splits(tmp_path):
    import_logs(three_recordings(), tmp_path / "data", CONFIG)
    dataset = open_dataset(tmp_path / "data")
    train, test = dataset.load("train"), dataset.load("test")
    assert not set(train.vehicle.tolist()) & set(test.vehicle.tolist())
    assert not set(train.group.tolist()) & set(test.group.tolist())


def late(track, since):
    """The track's samples from `since` s on."""
    series = ("t", "x", "y", "heading", "speed")
    keep = track.t >= since - 1e-6
    return dataclasses.replace(track, **{k: getattr(track, k)[keep] for k in series})


@pytest.mark.parametrize("group", [None, "declared"])
def test_one_recording_is_split_by_when_vehicles_are_first_seen(tmp_path, group):
    one = late(car("one", speeding_up(0.0, 10.0), seconds=20.0), 0.0)
    two = late(car("two", speeding_up(60.0, 10.0), seconds=20.0), 0.0)
    three = late(car("three", speeding_up(30.0, 10.0), seconds=20.0), 4.0)
    made = dataclasses.replace(recording(one, two, three), group=group)
    import_logs([validate_recording(made)], tmp_path / "data", CONFIG)
    dataset = open_dataset(tmp_path / "data")
    dataset.check_tables()
    names = dataset.manifest.vehicles
    driven = {
        split: {names[n].rpartition(":")[2] for n in dataset.load(split).vehicle}
        for split in ("train", "test")
    }
    assert driven == {"train": {"one", "two"}, "test": {"three"}}
    told = format_splits(dataset)
    assert "split by                    blocks of 3.75 s in which" in told
    assert told.index("split train") < told.index("split test")
    scenes = dataset.indices("test").size
    assert re.search(rf"split test +{scenes} scenes \(.*%\), .*: 1$", told, re.M)
    assert "asked for 40.0% to test" in told


def test_an_empty_split_is_refused_and_what_is_finished_stays(tmp_path):
    alone = recording(car("only", speeding_up(0.0)), car("bike", speeding_up(30.0),
                      kind=Kind.CYCLIST))  # fmt: skip
    with pytest.raises(InputError) as caught:
        import_logs([alone], tmp_path / "data", CONFIG)
    assert str(caught.value) == (
        "splits: groups: 1 (hand/minute-0000): expected at least two vehicle-disjoint "
        "groups for --test_fraction=0.4; give more recordings, or import with "
        "--test_fraction=0 for training scenes only"
    )
    import_logs(
        [alone], tmp_path / "data", dataclasses.replace(CONFIG, test_fraction=0.0)
    )
    dataset = open_dataset(tmp_path / "data")
    assert dataset.indices("test").size == 0
    with pytest.raises(InputError, match=r"^test: 0 scenes: expected at least one; "):
        check_finite("test", dataset.load("test"), dataset.indices("test"))


@pytest.mark.dataset
def test_us101(data_dir, tmp_path):
    manifest = import_logs(
        read_recordings("commonroad", data_dir / "ngsim_us101_commonroad" / "xml"),
        tmp_path / "us101",
        ImportConfig(format="commonroad"),
    )
    quality = manifest.quality
    assert quality["recordings"] == 36
    assert quality["tracks"] == 996
    assert quality["scenes"] > 2500
    assert quality["harsh_share_smoothed"] < 0.05 < quality["harsh_share_raw"]
    dataset = open_dataset(tmp_path / "us101")
    train, test = dataset.load("train"), dataset.load("test")
    assert not set(train.vehicle.tolist()) & set(test.vehicle.tolist())


def test_on_overlapping_branches_the_track_keeps_to_one():
    """A fork whose branches lie within centimetres for thirty metres."""
    x = np.arange(0.0, 81.0, 2.0)
    half = np.full(x.shape, 1.8)

    def lane(name, y, shift=0.0, successors=()):
        return Lane(
            id=name,
            centre=np.stack([x + shift, y], 1),
            left_width=half,
            right_width=half,
            speed_limit=10.0,
            successors=successors,
        )

    lanes = (
        lane("in", 0.0 * x, -80.0, ("left", "right")),
        lane("left", 0.002 * x**2),
        lane("right", -0.002 * x**2),
    )
    graph = LaneGraph(recording(car("ego", speeding_up(20.0)), lanes=lanes))
    rng = np.random.default_rng(0)
    y = 0.002 * x**2 + rng.normal(0.0, 0.1, x.size)
    got = graph.match(x, y, np.arctan(0.004 * x))
    assert set(got[2:]) == {"left"}
    assert graph.chain("in", ["in", "right", "left", "left"]) == ("in", "left")


def other(value):
    """Something of the same type that is not equal."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, np.ndarray):
        return value + 1.0
    if isinstance(value, int | float):
        return type(value)(value + 1)
    if isinstance(value, str):
        return value + "x"
    if isinstance(value, tuple):
        return (*value, value[-1]) if value else ("x",)
    return "x"


@pytest.mark.parametrize("kind", [Recording, Track, Lane, Signal])
def test_every_field_changes_the_digest(kind):
    signal = Signal(id="s", start=np.array([0.0, 5.0]), state=("red", "green"))
    made = recording(
        car("ego", speeding_up(20.0)), lanes=road(50.0, ("s",)), signals=(signal,)
    )
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


def test_quantiles_of_values_that_are_met_often():
    report = QualityReport()
    report.futures.update({"104": 10, "160": 90})  # 5.2 s and 8 s
    report.speeds.update({"0": 60, **{str(k): 1 for k in range(60, 100)}})
    made = report.as_dict()
    assert made["future_s"] == pytest.approx({"p05": 5.2, "p50": 8.0, "p95": 8.0})
    assert made["speed_mps"]["p50"] == 0.0


def test_a_resume_without_a_recording_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(importing, "SHARD_SCENES", 1)

    def interrupted():
        yield from list(three_recordings())[:2]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_logs(interrupted(), tmp_path / "part", CONFIG)
    fewer = list(three_recordings())[:1]
    with pytest.raises(InputError, match="r1: missing: expected all recordings"):
        import_logs(fewer, tmp_path / "part", CONFIG)


def test_a_red_light_is_not_disproved_by_those_whom_another_light_lets_pass():
    """Left-turners on their green arrow do not disprove the red light ahead."""
    arrow = Signal(id="arrow", start=np.array([0.0]), state=("green",))
    light = Signal(id="light", start=np.array([0.0]), state=("red",))
    cars = [car(f"c{i}", speeding_up(10.0 * i)) for i in range(4)]
    made = recording(
        *cars, lanes=road(90.0, ("arrow", "light")), signals=(arrow, light)
    )
    collector = Collector(made, NO_FILTER)
    assert set(collector.signals) == {"arrow", "light"}
    rows = list(collector.scenes())
    assert any(row["tags"][Tag.RED_LIGHT] for row in rows)


def test_labels_of_scenes_side_by_side_are_those_of_each_alone():
    made = recording(
        car("ego", speeding_up(20.0)),
        car("lead", speeding_up(60.0)),
        car("slow", lambda t: 90.0 + 2.0 * t, y=WIDTH),
    )
    rows = list(Collector(made, NO_FILTER).scenes())
    assert len({row["decisions"].tobytes() for row in rows}) > 1
    for row in rows:
        decisions, tags = labels_of(row)  # no leading axis
        np.testing.assert_array_equal(decisions, row["decisions"])
        np.testing.assert_array_equal(tags, row["tags"])
