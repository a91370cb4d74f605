"""Labels against simulated drivers: what they did is in their lanes and speeds."""

import functools
import json

import numpy as np
import pytest

from rcirl_jax.data.formats.synthetic.reader import driver_config
from rcirl_jax.data.synthetic.drivers import sample_drivers
from rcirl_jax.data.synthetic.roads import ROADS
from rcirl_jax.data.synthetic.traffic import Log
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.labels.made_traffic import Drive, cuts_in, decision
from rcirl_jax.evaluation.labels.reactions import Arrival, arrival
from rcirl_jax.evaluation.labels.scores import format_labels
from rcirl_jax.evaluation.labels.traffic import measure_traffic
from rcirl_jax.runtime.executors import Processes
from rcirl_jax.runtime.specs import load_toml, spec_root
from rcirl_jax.types import Decision
from tests.helpers.commands import succeeded

SYNTHETIC = spec_root() / "sources" / "synthetic.toml"
DRIVERS = load_toml(SYNTHETIC)["drivers"]
DRIVEN = ("arterial_signals", "highway_s_curve")
FLOOR = 0.9  # precision and recall of a class with ten cases or more
RATE_HZ = 10.0
COUNT = 81
CLOCK = np.arange(COUNT) / RATE_HZ


@functools.cache
def report():
    return measure_traffic(1, "ngsim", seed=7, roads=DRIVEN)


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
    broken = measure_traffic(1, "ngsim", seed=7, roads=DRIVEN[:1])
    whole = {score.name: score for score in report().decisions}
    for score in broken.decisions:
        if score.name in ("follow", "stop"):
            assert score.right == 0
            assert 0 < score.missed <= whole[score.name].true


@pytest.mark.multiprocess
def test_labels_do_not_depend_on_where_they_are_made():
    again = measure_traffic(1, "ngsim", seed=7, roads=DRIVEN, executor=Processes(2))
    assert again == report()
    json.dumps(again.as_dict(), allow_nan=False)


@pytest.mark.slow
def test_command(tmp_path):
    flags = ("--quick", "--noise=none", f"--output={tmp_path}")
    succeeded("rcirl_jax", "label-check", *flags)
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
        (EGO, car(30.0, changing(4, 2, 0.5)), None),  # from the start or later?
        (EGO, car(-30.0, changing(4, 2, 2.0)), Decision.IGNORE),
        (EGO, car(2.0, changing(4, 2, 2.0)), None),  # not before box
        (EGO, car(30.0, 4), Decision.IGNORE),
        (EGO, car(30.0, 4, v=14.0), Decision.IGNORE),  # passed in its lane
        (EGO, car(20.0, changing(4, 2, 4.0), v=14.0), Decision.OVERTAKE),
        (OUT, car(30.0, 2, v=18.0), Decision.OVERTAKE),
        (OUT, car(30.0, 1, v=18.0), Decision.OVERTAKE),
        (OUT, car(-30.0, 2), Decision.IGNORE),
        (OUT, car(30.0, 1, v=25.0), None),  # the new leader
        (OUT, car(30.0, changing(2, 4, 4.0), v=25.0), None),
    ],
)  # fmt: skip
def test_the_truth_of_two_cars(ego, other, truth):
    assert decision(ego, other, RATE_HZ) == truth


def came(headway=1.5, brakes=None, nearest=True):
    return Arrival(headway_s=headway, is_nearest=nearest, brakes=brakes)


@pytest.mark.parametrize(
    ("arrival", "truth", "cut"),
    [
        (came(brakes=True), Decision.YIELD, True),
        (came(brakes=False), Decision.FOLLOW, True),
        (came(brakes=None), None, True),  # too close to say
        (came(brakes=True, headway=3.0), None, None),  # near or far?
        (came(brakes=False, headway=5.0), Decision.FOLLOW, False),
        (came(brakes=True, nearest=False), None, None),
    ],
)
def test_the_truth_of_one_that_comes_in(arrival, truth, cut):
    other = car(30.0, changing(4, 2, 2.0))
    assert decision(EGO, other, RATE_HZ, arrival) == truth
    assert cuts_in(EGO, other, RATE_HZ, arrival) is cut


def test_drivers_brake_for_who_comes_in_near_and_slow():
    """20 m/s on an empty road; the other comes in 15 m ahead at 16 m/s, or far off."""
    assert met(gap=15.0, v=16.0).brakes is True
    assert met(gap=15.0, v=16.0).headway_s == pytest.approx(0.75)
    assert met(gap=120.0, v=22.0).brakes is False
    # its leader makes it brake already
    assert met(gap=15.0, v=16.0, leader=20.0).brakes is None
    assert met(gap=15.0, v=16.0, leader=8.0).is_nearest is False


def met(gap, v, leader=None):
    """The arrival, after 2 s, of a car that starts `gap` [m] and the way ahead."""
    count = 3 if leader is not None else 2
    road = ROADS["highway_straight"]()
    s = np.empty((COUNT, count))
    s[:, 0] = 200.0 + 20.0 * CLOCK
    s[:, 1] = 200.0 + gap + 4.6 + (20.0 - v) * 2.0 + v * CLOCK
    lanes = np.full((COUNT, count), 2)
    lanes[:, 1] = changing(4, 2, 2.0)
    speed = np.broadcast_to([20.0, v, v][:count], s.shape)
    if leader is not None:
        s[:, 2] = s[:, 0] + leader + 4.6 - 4.0 * (CLOCK - 2.0)
    drivers = sample_drivers(
        np.random.default_rng(0), driver_config(SYNTHETIC, DRIVERS), road, count
    )
    drivers["speed_factor"] = 20.0 / road.limit[0]
    for name, value in (("length", 4.6), ("headway", 1.4), ("jam_gap", 2.0)):
        drivers[name] = value
    log = Log(
        road=road,
        vehicle=np.broadcast_to(np.arange(count), s.shape),
        s=s,
        l=np.zeros_like(s),
        slope=np.zeros_like(s),
        v=speed,
        lanes=lanes,
        drivers=drivers,
        signal_offset=np.zeros(0),
    )
    return arrival(log, 0, 1, slice(0, COUNT), RATE_HZ)


def test_who_cuts_in():
    enters = car(30.0, changing(4, 2, 2.0))
    for ego, other, truth in (
        (EGO, car(-30.0, changing(4, 2, 2.0)), False),
        (EGO, car(30.0, 2), False), (EGO, car(30.0, 4), False),
        (EGO, None, None), (OUT, enters, None),
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
