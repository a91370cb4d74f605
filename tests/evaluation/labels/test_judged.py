"""Verdicts of a person on scenes, and the labels of those scenes."""

import json
import os
from pathlib import Path

import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.labels.judged import (
    TRUTH,
    Judged,
    Verdicts,
    judged_scenes,
    measure_judged,
    read_verdicts,
    scenes_of,
)
from rcirl_jax.report.data.judging_sheet import draw_sheets
from tests.helpers.roads import WIDTH, car, recording, smooth_step

DATA = Path(os.environ.get("RCIRL_DATA", Path(__file__).parents[4] / "shared/data"))


def hand():
    """A lead, one that cuts in without any reaction, and one passed a lane aside."""
    beside = car("cutter", lambda t: 45.0 + 13.0 * t, y=lambda t: WIDTH - enters(t))
    return recording(
        car("ego", lambda t: 20.0 + 12.0 * t + 0.05 * t**2),
        car("lead", lambda t: 90.0 + 13.0 * t),
        beside,
        car("slow", lambda t: 45.0 + 7.0 * t, y=-WIDTH),
    )


def enters(t):
    return WIDTH * smooth_step(t, 2, 3)


def judged(obstacle, verdict, cut_in=False, batch="one"):
    return Judged(batch, "hand", "hand", "ego", 0.5, obstacle, verdict, cut_in)


def test_labels_beside_verdicts(tmp_path):
    said = [
        judged("lead", "follow"),
        judged("cutter", "follow", cut_in=True),
        judged("slow", "pass"),
        judged("slow", "overtake", batch="two"),  # not what the label says
        judged("gone", "none", batch="two"),  # no slot: ignored
    ]
    found = list(scenes_of(hand(), said))
    assert [one for one, _, _ in found] == said
    scores = measure_judged(found)
    table = {
        batch: {s.name: (s.right, s.wrong, s.missed) for s in found}
        for batch, found in scores.items()
    }
    nothing = (0, 0, 0)
    assert table["one"] == {
        "ignore": (1, 0, 0), "follow": (2, 0, 0), "yield": nothing,
        "overtake": nothing, "nudge": nothing, "cut_in": (1, 0, 0),
    }  # fmt: skip
    assert table["two"]["ignore"] == (1, 1, 0)
    assert table["two"]["overtake"] == (0, 0, 1)
    assert table["all"]["ignore"] == (2, 1, 0)
    assert draw_sheets(tmp_path, found) == 1
    assert (tmp_path / "sheet_000.png").stat().st_size > 10_000


def pair(one):
    """Whom a verdict is about."""
    return one.recording, one.track, one.obstacle


def test_the_packaged_verdicts():
    verdicts = read_verdicts()
    scenes = {
        (one.recording, one.track, one.time_s, one.obstacle) for one in verdicts.scenes
    }
    assert len(scenes) == len(verdicts.scenes) >= 200
    assert {one.verdict for one in verdicts.scenes} == set(TRUTH)
    first, held_out = (
        {pair(one) for one in verdicts.scenes if one.batch == batch}
        for batch in ("first", "held_out")
    )
    assert not first & held_out  # other events


@pytest.mark.slow
@pytest.mark.dataset
def test_labels_agree_with_a_person():
    if not (DATA / "ngsim_i80_native").is_dir():
        pytest.skip(f"no recordings at {DATA}: set RCIRL_DATA")
    scores = measure_judged(judged_scenes(read_verdicts(), DATA))
    for score in scores["held_out"]:
        assert score.recall()[0] >= 0.85, score
    for score in scores["all"]:
        assert score.precision()[0] >= 0.75, score


def test_other_recordings_are_refused(tmp_path):
    verdicts = read_verdicts()
    with pytest.raises(InputError):
        judged_scenes(verdicts, tmp_path)
    assert judged_scenes(Verdicts(sites={}, scenes=[]), tmp_path) == []


@pytest.mark.parametrize(
    "row", [["a", "b", "c"], ["a", "x", "c", "1", 0.0, "2", "sleep", False]]
)
def test_bad_verdicts(tmp_path, row):
    path = tmp_path / "v.json"
    path.write_text(json.dumps({"sites": {}, "scenes": [row]}))
    with pytest.raises(InputError, match=r"v\.json"):
        read_verdicts(path)
