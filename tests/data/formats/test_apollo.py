"""Apollo cyber records: topics, clocks, parts of a drive, windows of a long one."""

import functools
import re

import numpy as np
import pytest

from rcirl_jax.data.formats import parts, read_recordings
from rcirl_jax.types import Kind
from tests.data.formats.fixtures import apollo as fixture
from tests.data.formats.fixtures import has_note
from tests.helpers import logs
from tests.helpers.logs import tracks_of

LOCALIZATION = "/apollo/localization/pose"
CHASSIS = "/apollo/canbus/chassis"
PERCEPTION = fixture.OBSTACLES
ROUTING = "/apollo/routing_response"
read = functools.partial(logs.read, "apollo", rate_hz=10.0)


def write(path, messages, **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(fixture.record(messages, **options))
    return path


def only(path, messages=None, *, channels=fixture.CHANNELS, **options):
    """The one recording of a path, or of messages written into a folder."""
    if messages is not None:
        path = write(path / "a.record", messages, channels=channels)
    (recording,) = read(path, **options)
    return recording


def ego_only(seconds=2.0, **options):
    return [
        (LOCALIZATION, 0.1 * k, fixture.localization(0.1 * k, **options))
        for k in range(round(10 * seconds) + 1)
    ]


def test_parts_are_drives(tmp_path):
    """A part reads those that follow; behind a missing one another run begins."""
    first, second = fixture.write(tmp_path).files
    assert only(first).tracks[0].t.size == 81
    assert only(second).tracks[0].t.size < 81
    write(tmp_path / "demo_3.5.record", ego_only())
    write(tmp_path / "x.record.00007", ego_only())
    write(tmp_path / "x.record.00009", ego_only())  # a part is missing before it
    (tmp_path / "notes.record.txt").write_text("not a record")
    found, _ = parts("apollo", tmp_path)
    assert [part.name for part in found] == [
        *("20210723091215.record.00000", "demo_3.5.record"),
        *("x.record.00007", "x.record.00009"),
    ]
    recordings = list(read_recordings("apollo", tmp_path))
    assert {made.name: made.group for made in recordings} == {
        **{"20210723091215": None, "demo_3.5": None},
        **{"x": "x", "x-00009": "x"},  # they may show the same cars
    }


def test_records_that_were_never_closed_or_left_more_behind(tmp_path):
    """A record is written over without being emptied first; its index is its end.

    Where the computer lost power there is no index, and the header not completed.
    """
    path = write(tmp_path / "a.record", ego_only())
    path.write_bytes(path.read_bytes() + fixture.record(ego_only(8.0))[-3000:])
    assert only(path).tracks[0].t.size == 21
    content = write(path, ego_only(), complete=False).read_bytes()
    path.write_bytes(content[: -len(fixture.INDEX)])
    assert has_note(only(path), "never closed")


def test_prediction_where_perception_is_missing(tmp_path):
    found = only(tmp_path, fixture.drive(obstacles="/apollo/prediction"))
    expected = fixture.expected()["15"]
    np.testing.assert_allclose(tracks_of(found)["15"].x, expected.x, atol=5e-3)
    assert has_note(found, "those of prediction")


def test_heading_from_the_quaternion_and_speed_of_the_chassis(tmp_path):
    """Speed where localization has none; else differences of positions."""
    messages = ego_only(heading=False, velocity=False)
    (ego,) = only(tmp_path, messages).tracks
    np.testing.assert_allclose(ego.heading, 0.0, atol=1e-9)
    np.testing.assert_allclose(ego.x, 0.8 * np.arange(21), atol=1e-3)
    np.testing.assert_allclose(ego.speed, 8.0, atol=1e-3)
    for k in range(0, 21, 5):
        messages.append((CHASSIS, 0.1 * k, fixture.chassis(0.1 * k, speed=7.5)))
    np.testing.assert_allclose(only(tmp_path, messages).tracks[0].speed, 7.5)


def perceived(count=11, **changes):
    """The ego and one obstacle with other fields; None: not set."""
    messages = ego_only()
    for k in range(count):
        t = 0.1 * k
        item = {**fixture.seen_at(t)[0], **changes}
        item = {name: value for name, value in item.items() if value is not None}
        messages.append((PERCEPTION, t, fixture.perceived(t, [item], late=0.0)))
    return messages


@pytest.mark.parametrize(
    ("choice", "number", "kind"),
    [
        *[("auto", number, Kind.VEHICLE) for number in (0, 1)],
        *[("auto", 2, Kind.STATIC), ("static", 0, Kind.STATIC), ("drop", 0, None)],
    ],
)
def test_unknown_class(tmp_path, choice, number, kind):
    found = only(tmp_path, perceived(type=number), unknown=choice).tracks
    assert [t.kind for t in found if t.id == "12"] == ([] if kind is None else [kind])


def test_topics_stamped_on_different_clocks(tmp_path):
    """Simulated and real time: the times of recording are common to both."""
    messages = [
        (name, t, fixture.localization(t, later=12.0) if name != PERCEPTION else made)
        for name, t, made in perceived()
    ]
    recording = only(tmp_path, messages)
    assert has_note(recording, "different clocks")
    assert tracks_of(recording)["12"].t[0] == pytest.approx(0.0, abs=1e-6)


def place(number):
    """A destination, m from the local origin once it is read."""
    return (fixture.CENTRE[0] + 200.0 + number, fixture.CENTRE[1] + 1.0)


def destinations(recording):
    """Of the ego's tracks, as in the messages."""
    (note,) = [note for note in recording.notes if "local origin" in note]
    origin = np.array(re.findall(r"= (\d+) m", note), float)
    return {
        found.id: found.destination
        and tuple((np.array(found.destination) + origin).tolist())
        for found in recording.tracks
        if found.id.startswith("ego")
    }


@pytest.mark.parametrize("name", ["routing_response", "raw_rrouting_response_history"])
def test_routing(tmp_path, name):
    name, kind = f"/apollo/{name}", fixture.CHANNELS[ROUTING]
    messages = [(name, 0.3, fixture.routing(*place(0))), *ego_only(5.0)]
    channels = {**fixture.CHANNELS, name: kind}
    assert destinations(only(tmp_path, messages, channels=channels)) == {
        "ego": place(0)
    }


@pytest.mark.parametrize("name", ["planning/command", "planning_command_history"])
def test_routing_since_apollo_9(tmp_path, name):
    """A record from mid-drive has the history alone."""
    name = f"/apollo/{name}"
    messages = [(name, 0.3, fixture.command(*place(0))), *ego_only(5.0)]
    messages.append((name, 3.0, fixture.parking()))
    channels = {**fixture.CHANNELS, name: "apollo.planning.PlanningCommand"}
    recording = only(tmp_path, messages, channels=channels)
    assert destinations(recording) == {"ego": place(0)}
    assert not has_note(recording, "no routing")


def test_each_routing_begins_a_leg(tmp_path):
    """The same destination sent again does not; what comes later is not known."""
    times = {0.5: 0, 1.0: 0, 2.04: 1, 3.0: 1, 3.7: 0}
    routings = [(ROUTING, t, fixture.routing(*place(n))) for t, n in times.items()]
    recording = only(tmp_path, ego_only(5.0) + routings)
    names = ("ego", "ego-leg2", "ego-leg3")
    assert list(destinations(recording).items()) == [
        (name, place(number)) for name, number in zip(names, (0, 1, 0), strict=True)
    ]
    legs = [tracks_of(recording)[name] for name in names]
    ends = [(round(leg.t[0], 6), round(leg.t[-1], 6)) for leg in legs]
    assert ends == [(0.0, 2.0), (2.1, 3.6), (3.7, 5.0)]
    whole = only(tmp_path, ego_only(5.0)).tracks[0]
    np.testing.assert_array_equal(np.concatenate([leg.x for leg in legs]), whole.x)
    # none before a late one
    late = only(tmp_path, [*ego_only(5.0), (ROUTING, 3.0, fixture.routing(*place(0)))])
    assert destinations(late) == {"ego": None, "ego-leg2": place(0)}


@pytest.mark.dataset
def test_example_record_of_apollo(data_dir):
    """34 messages of a simulated car that stands; values read with cyber_record."""
    recording = only(data_dir / "formats" / "apollo_record" / "example.record.00000")
    (ego,) = recording.tracks
    assert recording.name == "example"
    assert ego.t.size == 2
    heading = -2.25563014963147
    x = 315323.44588835048 + fixture.AHEAD * np.cos(heading)
    np.testing.assert_allclose(ego.x, x - 315000.0, atol=1e-6)
    np.testing.assert_allclose(ego.heading, heading)
    np.testing.assert_array_equal(ego.speed, 0.0)
    assert ego.destination == pytest.approx((314.98923, 388.09329), abs=1e-4)
    assert has_note(recording, "no obstacles")
    assert has_note(recording, "100% of the time")


def test_of_a_silent_chassis_nobody_knows_the_mode(tmp_path):
    """Before the first message its mode was in force."""
    for manual, spans in ((True, [(1.2, np.inf)]), (False, [(-np.inf, np.inf)])):
        messages = [*ego_only(), (CHASSIS, 0.2, fixture.chassis(0.2, manual=manual))]
        (ego,) = only(tmp_path, messages).tracks
        np.testing.assert_allclose(ego.automated, spans)
    (ego,) = only(tmp_path, ego_only()).tracks
    assert ego.automated == ()
