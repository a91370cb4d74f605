"""Scenes end where someone whom the human reacts to leaves the record."""

import dataclasses

import numpy as np
import pytest

from rcirl_jax.data.formats import read_recordings
from rcirl_jax.data.quality import QualityReport
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.data.scenes.collect import Collector, assemble
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.types import Decision
from rcirl_jax.units import TIMES_S
from tests.data.formats import writers as w
from tests.helpers.logs import refused
from tests.helpers.roads import (
    NO_FILTER,
    WIDTH,
    car,
    first_scene,
    part,
    recording,
    smooth_step,
    steady,
)

START_S = 0.5  # s, the first planning frame of a track that begins at 0


def mask_until(end_s):
    """The mask of a scene whose surroundings end at `end_s` of the recording."""
    return end_s - START_S + 1e-6 >= TIMES_S


def test_the_mask_ends_with_the_leader():
    made = recording(car("ego", steady(0.0)), car("lead", steady(30.0), seconds=5.0))
    row = first_scene(made)
    # 0 to 4.235 s; 4.706 s is after the leader's last sample at 4.5 s
    assert row["time_valid"].tolist() == [True] * 10 + [False] * 8
    assert row["future_s"] == 8.0
    np.testing.assert_allclose(row["human.s"], 12.0 * TIMES_S, atol=0.01)
    block = assemble([row], vehicles=[0], groups=[0], recording=0)
    for leaf in vars(block.human).values():
        assert np.isfinite(leaf).all()
    assert block.s_at_5s[0] == pytest.approx(60.0, abs=0.01)
    lead = int(np.flatnonzero(row["obstacles.kind"])[0])
    assert row["decisions"][lead] == Decision.FOLLOW
    assert not row["obstacles.valid"][lead, ~row["time_valid"]].any()


def aside(t):
    return WIDTH * smooth_step(t, 1.0, 3.0)


def gone(start, v=12.0, y=0.0, seconds=5.0):
    return car("gone", steady(start, v), y=y, seconds=seconds)


LEAD = car("lead", steady(20.0))
# when the surroundings end, who is there
SURROUNDINGS = {
    "a leader of the leader": (None, LEAD, gone(40.0)),
    "behind": (None, LEAD, gone(-15.0)),
    "beside, as fast": (None, LEAD, gone(10.0, y=WIDTH)),
    "overtaken before": (None, gone(16.0, v=4.0, y=WIDTH)),
    "two lanes away": (None, gone(40.0, v=4.0, y=2 * WIDTH, seconds=4.0)),
    "with the human": (None, LEAD),
    "a leader that changes lane": (None, gone(25.0, y=aside, seconds=6.0)),
    # 12 m/s past 4 m/s: 40 m are made good at 5 s
    "a slower one beside": (4.0, gone(40.0, v=4.0, y=WIDTH, seconds=4.0)),
    "one far ahead": (None, gone(150.0, v=4.0, y=WIDTH, seconds=4.0)),
    # perception gives the leader a new number: nothing is missing
    "a new number": (None, gone(30.0), part(car("lead", steady(30.0)), 5.05)),
}


@pytest.mark.parametrize("name", SURROUNDINGS)
def test_who_ends_a_scene_when_it_leaves(name):
    end, *others = SURROUNDINGS[name]
    row = first_scene(recording(car("ego", steady(0.0)), *others))
    assert row["time_valid"].tolist() == mask_until(end or 100.0).tolist()


@pytest.mark.parametrize(("seconds", "kept"), [(3.4, False), (3.6, True)])
def test_scenes_that_end_too_early_are_dropped_and_counted(seconds, kept):
    made = recording(
        car("ego", steady(0.0), seconds=6.0), car("lead", steady(30.0), seconds=seconds)
    )
    config = dataclasses.replace(NO_FILTER, stride_s=10.0)
    collector = Collector(made, config)
    assert len(list(collector.scenes())) == kept
    assert collector.dropped["surroundings_end"] == (not kept)
    short = dataclasses.replace(config, min_surroundings_s=2.5)
    assert len(list(Collector(made, short).scenes())) == 1


def test_filters_judge_what_is_left():
    """The human brakes after the leader is gone: within the mask it keeps its speed."""

    def brakes_late(t):
        return 12.0 * t - np.where(t > 6.0, 0.75 * (t - 6.0) ** 2, 0.0)

    alone = car("far", steady(60.0), y=2 * WIDTH)
    ego, lead = car("ego", brakes_late), car("lead", steady(30.0), seconds=4.5)
    config = CollectConfig(stride_s=100.0)
    assert first_scene(recording(ego, alone), config=config)["time_valid"].all()
    dropped = first_scene(recording(ego, lead), config=config)
    assert dropped == {"no_speed_change": 1, "future_too_short": 1}


def test_what_is_cut_is_counted():
    made = recording(car("ego", steady(0.0)), car("lead", steady(30.0), seconds=5.0))
    collector = Collector(made, dataclasses.replace(NO_FILTER, stride_s=100.0))
    assert len(list(collector.scenes())) == 1
    report = QualityReport()
    report.add_recording(collector)
    report.merge(report.state())
    assert report.as_dict()["shortened"] == 2
    assert report.as_dict()["shortened_share"] == pytest.approx(8 / 18)


def test_a_leader_that_the_file_names_and_does_not_hold():
    ego = car("ego", steady(0.0), leader_missing=((4.5, np.inf),))
    row = first_scene(recording(ego, car("far", steady(90.0), y=2 * WIDTH)))
    # its last time is one sample earlier: 4.4 s of the recording
    assert row["time_valid"].tolist() == mask_until(4.4).tolist()
    gone = dataclasses.replace(ego, leader_missing=((0.0, 0.6),))
    dropped = Collector(recording(gone), NO_FILTER)
    frames = [row["frame"] for row in dropped.scenes()]
    assert frames[0] == 10
    assert dropped.dropped["follows_missing_car"] == 1
    bad = recording(dataclasses.replace(ego, leader_missing=((3.0, 2.0),)))
    assert "leader_missing: 3.0 to 2.0 s: expected" in refused(validate_recording, bad)


def ngsim_pair(folder, *, leads=45, named=70):
    """A follower of 70 rows that names its leader in some of them."""
    rows = w.ngsim_rows(vehicle=1, first=100, count=leads, start_ft=120.0)
    for k, row in enumerate(w.ngsim_rows(vehicle=2, first=100, count=70)):
        row[w.NGSIM_COLUMNS.index("Preceding")] = 1 if k < named else 0
        rows.append(row)
    return w.ngsim_text(folder / "trajectories.txt", rows)


@pytest.mark.parametrize(
    ("given", "missing"),
    [({}, ((4.5, np.inf),)), ({"named": 60}, ((4.5, 6.0),)), ({"leads": 70}, ())],
)
def test_ngsim_names_its_leaders(tmp_path, given, missing):
    (made,) = read_recordings("ngsim", ngsim_pair(tmp_path, **given))
    assert {x.id: x.leader_missing for x in made.tracks} == {"1": (), "2": missing}
