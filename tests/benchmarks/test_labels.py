"""Verdicts of a person on scenes, and the labels of those scenes."""

import os
from pathlib import Path

import pytest

from benchmarks.judged import (
    Judged,
    compare,
    compare_in,
    read_verdicts,
    scores,
)
from tests.helpers.roads import WIDTH, car, recording, smooth_step

DATA = Path(os.environ.get("RCIRL_DATA", Path(__file__).parents[3] / "shared/data"))


def judged(obstacle, verdict, cut_in=False, batch="one"):
    return Judged(batch, "hand", "hand", "ego", 0.5, obstacle, verdict, cut_in)


def test_labels_beside_verdicts():
    """A lead, one that cuts in without any reaction, and one passed a lane aside."""
    made = recording(
        car("ego", lambda t: 20.0 + 12.0 * t + 0.05 * t**2),
        car("lead", lambda t: 90.0 + 13.0 * t),
        car(
            "cutter",
            lambda t: 45.0 + 13.0 * t,
            y=lambda t: WIDTH - WIDTH * smooth_step(t, 2, 3),
        ),
        car("slow", lambda t: 45.0 + 7.0 * t, y=-WIDTH),
    )
    said = [
        judged("lead", "follow"),
        judged("cutter", "follow", cut_in=True),
        judged("slow", "pass"),
        judged("slow", "overtake", batch="two"),  # not what the label says
        judged("gone", "none", batch="two"),  # no slot: ignored
    ]
    found = list(compare_in(made, said))
    assert [one for one, *_ in found] == said
    table = {
        batch: {s["name"]: (s["right"], s["wrong"], s["missed"]) for s in rows}
        for batch, rows in scores(found).items()
    }
    nothing = (0, 0, 0)
    assert table["one"] == {
        "ignore": (1, 0, 0), "follow": (2, 0, 0), "yield": nothing,
        "overtake": nothing, "nudge": nothing, "cut_in": (1, 0, 0),
    }  # fmt: skip
    assert table["two"]["ignore"] == (1, 1, 0)
    assert table["two"]["overtake"] == (0, 0, 1)
    assert table["all"]["ignore"] == (2, 1, 0)


@pytest.mark.slow
@pytest.mark.dataset
def test_labels_agree_with_a_person():
    if not (DATA / "ngsim_i80_native").is_dir():
        pytest.skip(f"no recordings at {DATA}: set RCIRL_DATA")
    found = scores(compare(read_verdicts(), DATA))
    for score in found["held_out"]:
        assert score["recall"][0] >= 0.85, score
    for score in found["all"]:
        assert score["precision"][0] >= 0.75, score
