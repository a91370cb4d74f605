"""Labels against simulated drivers: what they did is in their lanes and speeds."""

import functools
import json

import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.labels.made_traffic import Drive, cuts_in, decision
from rcirl_jax.evaluation.labels.scores import format_labels
from rcirl_jax.evaluation.labels.traffic import measure_traffic
from rcirl_jax.runtime.executors import Processes
from rcirl_jax.types import Decision
from tests.helpers.commands import succeeded

ROADS = ("arterial_signals", "highway_s_curve")
FLOOR = 0.9  # precision and recall of a class with ten cases or more
RATE_HZ = 10.0
COUNT = 81
CLOCK = np.arange(COUNT) / RATE_HZ


@functools.cache
def report():
    return measure_traffic(1, "ngsim", seed=7, roads=ROADS)


def test_labels_say_what_the_drivers_did():
    found = report()
    scores = {score.name: score for score in found.decisions + found.tags}
    assert scores["follow"].true > 300
    assert scores["following"].true > 100
    assert scores["stop"].true > 5
    assert scores["lane_change"].true > 5
    for score in scores.values():
        for what in ("precision", "recall"):
            rate = getattr(score, what)()
            if score.true >= 10:
                assert rate[0] >= FLOOR, (score, what, format_labels(found))


def test_the_truth_does_not_come_from_the_labels(monkeypatch):
    def nothing(rows):
        for row in rows:
            row["decisions"] = np.zeros(row["obstacles.kind"].shape, int)
            row["tags"] = np.zeros(18, bool)

    monkeypatch.setattr("rcirl_jax.data.scenes.labels.add_labels", nothing)
    broken = measure_traffic(1, "ngsim", seed=7, roads=ROADS[:1])
    whole = {score.name: score for score in report().decisions}
    for score in broken.decisions:
        if score.name in ("follow", "stop"):
            assert score.right == 0
            assert 0 < score.missed <= whole[score.name].true


@pytest.mark.multiprocess
def test_labels_do_not_depend_on_where_they_are_made():
    again = measure_traffic(1, "ngsim", seed=7, roads=ROADS, executor=Processes(2))
    assert again == report()
    json.dumps(again.as_dict(), allow_nan=False)


@pytest.mark.slow
def test_command(tmp_path):
    flags = ("--quick", "--noise=none", f"--output={tmp_path}")
    succeeded("experiments.label_check", *flags)
    body = json.loads((tmp_path / "labels.json").read_text())
    assert body["none"]["cases"] > 500
    assert all(score["wrong"] <= 2 for score in body["none"]["decisions"])
    assert (tmp_path / "labels.png").stat().st_size > 10_000


def car(s, lanes, v=20.0, width=1.8):
    """A car that drives v from s, in these lanes (a mask, or one per sample)."""
    masks = np.broadcast_to(np.asarray(lanes), COUNT)
    middle = np.log2(np.maximum(masks & -masks, 1))
    return Drive(
        s=s + v * CLOCK, l=-3.6 * middle, v=np.full(COUNT, v), lanes=masks,
        length=4.6, width=width,
    )  # fmt: skip


def changing(first, last, start, seconds=3.0):
    """Lane masks of a change from one lane to another."""
    masks = np.where(start > CLOCK, first, last)
    return np.where((start <= CLOCK) & (start + seconds > CLOCK), first | last, masks)


EGO = car(0.0, 2)
OUT = car(0.0, changing(2, 1, 1.0), v=25.0)


@pytest.mark.parametrize(
    ("ego", "other", "truth"),
    [
        (EGO, car(30.0, 2), Decision.FOLLOW),
        (EGO, car(-30.0, 2), Decision.IGNORE),
        (EGO, car(30.0, changing(2, 4, 4.0)), Decision.FOLLOW),
        (EGO, car(30.0, changing(2, 4, 1.0)), None),  # hardly followed
        (EGO, car(30.0, changing(4, 2, 2.0)), Decision.YIELD),
        (EGO, car(30.0, changing(4, 2, 0.5)), None),  # from the start or later?
        (EGO, car(90.0, changing(4, 2, 2.0)), None),  # far away
        (EGO, car(-30.0, changing(4, 2, 2.0)), Decision.OVERTAKE),
        (EGO, car(2.0, changing(4, 2, 2.0)), None),  # not before box
        (EGO, car(30.0, 4), Decision.IGNORE),
        (EGO, car(30.0, 4, v=14.0), Decision.NUDGE_LEFT),
        (EGO, car(30.0, 1, v=14.0), Decision.NUDGE_RIGHT),
        (EGO, car(30.0, 4, v=18.0), Decision.IGNORE),  # as fast within a threshold
        (EGO, car(10.0, 4, v=18.0), None),
        (OUT, car(30.0, 2, v=18.0), Decision.OVERTAKE),
        (OUT, car(30.0, 1, v=18.0), Decision.OVERTAKE),
        (OUT, car(-30.0, 2), Decision.IGNORE),
        (OUT, car(30.0, 1, v=25.0), None),  # the new leader
        (OUT, car(30.0, changing(2, 4, 4.0), v=25.0), None),
    ],
)  # fmt: skip
def test_the_truth_of_two_cars(ego, other, truth):
    assert decision(ego, other, RATE_HZ) == truth


def test_who_cuts_in():
    enters = car(30.0, changing(4, 2, 2.0))
    for ego, other, truth in (
        (EGO, enters, True), (EGO, car(-30.0, changing(4, 2, 2.0)), False),
        (EGO, car(30.0, 2), False), (EGO, car(30.0, 4), False),
        (EGO, car(30.0, changing(4, 2, 0.5)), None), (OUT, enters, None),
        (EGO, None, None),
    ):  # fmt: skip
        assert cuts_in(ego, other, RATE_HZ) is truth


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, "none"), "--traffic: 0"),
        ((1, "loud"), "--noise: loud"),
        ((1, "none", 0, ["moon"]), "roads: moon"),
    ],
)
def test_bad_input(arguments, message):
    with pytest.raises(InputError, match=message):
        measure_traffic(*arguments)
