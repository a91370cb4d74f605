"""Tracks of a perception that flickers are joined or left out before scenes are cut."""

import dataclasses

import numpy as np
import pytest

from rcirl_jax.data.scenes.collect import Collector
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.scenes.tracks import JOINED, SHORT, joined, steady_tracks
from rcirl_jax.types import Kind
from tests.helpers.roads import NO_FILTER, WIDTH, car, part, recording, speeding_up

EGO = car("ego", speeding_up(20.0))


def standing(name="parked", x=80.0, seconds=12.0, **more):
    return car(name, lambda t: x, y=-WIDTH, seconds=seconds, **more)


def starting(t):
    """Stands at 80 m for 8 s, then drives off."""
    return 80.0 + 0.5 * np.maximum(t - 8.0, 0.0) ** 2


@pytest.mark.parametrize(
    ("begin", "end", "kept"),
    [
        (3.0, 3.9, False),  # 0.9 s
        (3.0, 4.0, True),  # 1 s
        (0.0, 0.5, True),  # it may have been there before the recording
        (11.5, 12.0, True),  # or after it
    ],
)
def test_a_minimum_life(begin, end, kept):
    made = recording(EGO, part(car("other", speeding_up(60.0)), begin, end))
    found, counts = steady_tracks(made, CollectConfig())
    assert [track.id for track in found.tracks] == ["ego", "other"][: 1 + kept]
    assert counts == ({} if kept else {SHORT: 1})
    earlier = dataclasses.replace(made.tracks[1], seen_since=-4.0)  # in a longer log
    assert not steady_tracks(recording(EGO, earlier), CollectConfig())[1]


def test_fragments_of_a_standing_body_are_one():
    whole = standing(kind=Kind.STATIC)
    parts = [
        part(whole, 0.0, 2.0, "7"),
        part(whole, 2.4, 2.6, "8"),  # too short to live alone
        part(whole, 6.0, 12.0, "9"),
    ]
    made = recording(EGO, *parts)
    found, counts = steady_tracks(made, CollectConfig())
    assert counts == {JOINED: 2}
    ego, one = found.tracks
    assert (ego.id, one.id) == ("ego", "7")
    assert (one.t[0], one.t[-1]) == (0.0, 12.0)
    assert one.t.size == sum(part.t.size for part in parts)
    assert np.all(np.diff(one.t) > 0.0)
    # in the scene it is one obstacle that is there all the time
    row = next(iter(Collector(made, NO_FILTER).scenes()))
    assert np.count_nonzero(row["obstacles.kind"]) == 1
    assert row["obstacles.valid"][0].all()


def test_one_body_under_two_names():
    """Both at a time; and a waiting car that drives off under the other."""
    whole = standing()
    one, two = part(whole, 0.0, 6.0, "1"), part(whole, 4.0, 12.0, "2")
    (made,) = joined([one, two], 5.0)
    np.testing.assert_allclose(made.t, whole.t)
    whole = car("a", starting)
    (made,) = joined([part(whole, 0.0, 5.0, "1"), part(whole, 6.0, 12.0)], 5.0)
    assert made.id == "1"
    assert made.x[-1] == pytest.approx(88.0)


@pytest.mark.parametrize(
    "second",
    [
        part(standing("2", x=81.2), 5.0, 12.0),  # another place
        part(standing("2"), 8.5, 12.0),  # 5.5 s later
        part(car("2", lambda t: 56.0 + 4.8 * t, y=-WIDTH), 5.0, 12.0),  # drives past
    ],
    ids=["elsewhere", "later", "moving"],
)
def test_others_are_not_joined(second):
    first = part(standing("1"), 0.0, 3.0)
    assert [track.id for track in joined([first, second], 5.0)] == ["1", "2"]
    leader = [car("1", speeding_up(20.0), seconds=5.0), car("2", speeding_up(60.0))]
    assert joined(leader, 5.0) == leader
