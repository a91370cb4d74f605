"""Waymo scenarios: what messages say, limits, framing, hostile records."""

import functools
import gzip
import struct

import numpy as np
import pytest

from rcirl_jax.data.readers.tfrecord import read_records
from rcirl_jax.types import Kind
from tests.data.formats.fixtures import has_note
from tests.data.formats.fixtures import waymo as w
from tests.data.formats.fixtures.drives import straight
from tests.helpers import logs
from tests.helpers.logs import lanes_of, refused

read = functools.partial(logs.read, "waymo")
only = functools.partial(logs.only, "waymo")


def put(folder, *records, name="a.tfrecord"):
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_bytes(w.tfrecord(records))
    return path


def scenario(folder, options=None, **changes):
    """The recording of one scenario with some fields replaced."""
    return only(put(folder, w.scenario(**changes)), **(options or {}))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The recording of the fixture."""
    return only(w.write(tmp_path_factory.mktemp("waymo")).input)


def test_kinds_and_what_is_left_out(tmp_path):
    user = straight(w.T, (w.EAST, w.NORTH), 0.0, 3.0)
    tracks = [w.track(key, key, user, range(91)) for key in range(5)]
    tracks += [w.track(6, 1, user, []), w.track(7, 0, user, range(91))]
    recording = scenario(tmp_path, tracks=tracks)
    # 4 moves, but is nobody to learn from
    kinds = (Kind.VEHICLE, Kind.PEDESTRIAN, Kind.CYCLIST, Kind.CYCLIST)
    assert {track.id: track.kind for track in recording.tracks} == dict(
        zip("1234", kinds, strict=True)
    )
    assert "2 tracks of unset type left out" in recording.notes
    assert "1 tracks without a valid state left out" in recording.notes


def car_with(rows=range(w.NUM_STEPS), key=7, user=None, **changes):
    """A track with some fields of some states replaced."""
    user = w.road_users()[2314][1] if user is None else user
    track = w.track(key, 1, user, range(w.NUM_STEPS))
    for row in rows:
        track["states"][row] |= changes
    return track


@pytest.mark.parametrize(
    ("change", "rows", "wrong"),
    [
        ({"width": 6.4}, range(91), "width: 6.4 m"),
        ({"velocity_x": 95.0}, [40], "speed"),
    ],
)
def test_up_to_a_tenth_of_the_tracks_may_be_impossible(tmp_path, change, rows, wrong):
    """As from other trackers; more of them point at a wrong file."""

    def traffic(count, outliers):
        """Cars side by side of which the first ones are outliers."""
        starts = [(w.EAST, w.NORTH + 4.0 * car) for car in range(count)]
        return [
            car_with(rows if k < outliers else (), 100 + k, user, **change)
            for k, user in enumerate(straight(w.T, at, 0.0, 8.0) for at in starts)
        ]

    few = scenario(tmp_path, tracks=traffic(20, 2))
    assert [track.id for track in few.tracks] == [str(102 + k) for k in range(18)]
    assert "2 tracks with an impossible size or speed left out" in few.notes
    # one of few is no wrong file
    assert len(scenario(tmp_path, tracks=traffic(5, 1)).tracks) == 4
    many = refused(scenario, tmp_path, tracks=traffic(20, 3))
    assert f"record 0: track 100: {wrong}" in many


def test_lanes(whole):
    lanes = lanes_of(whole)
    assert set(lanes) == {"101", "102", "103", "104"}
    south, north = lanes["101"], lanes["102"]
    assert (south.left, south.right, south.successors) == ("102", None, ("103",))
    assert (north.left, north.right, north.successors) == (None, "101", ("104",))
    np.testing.assert_array_equal(south.centre, w.eastward(0.0, -60.0, 40.0))
    assert south.speed_limit == pytest.approx(25 * w.MPH)
    assert lanes["103"].speed_limit == pytest.approx(35 * w.MPH)
    assert whole.default_speed_limit == pytest.approx(25 * w.MPH)
    assert has_note(whole, "1 lanes not of type")
    assert has_note(whole, "1 lanes of one point")


def test_widths_come_from_lines_and_edges(whole, tmp_path):
    lanes = lanes_of(whole)
    np.testing.assert_allclose(lanes["101"].left_width, w.WIDTH / 2)
    np.testing.assert_allclose(lanes["101"].right_width, 2.0)
    np.testing.assert_allclose(lanes["102"].right_width, w.WIDTH / 2)
    # no boundary is given
    np.testing.assert_allclose(lanes["102"].left_width, 1.75)
    lanes = lanes_of(scenario(tmp_path, {"lane_width_m": 3.0}))
    np.testing.assert_allclose(lanes["102"].left_width, 1.5)


def test_boundaries_of_a_part_far_ones_and_unknown_ones(tmp_path):
    """One of a part is held beyond it; others are too far, unknown, or backwards."""
    left = [w.boundary(20, 40, 901), w.boundary(-5, 10**6, 999)]
    right = [w.boundary(0, 100, 902), w.boundary(90, 10, 901)]
    sides = {"left_boundaries": left, "right_boundaries": right}
    features = [
        w.lane(1, w.eastward(0.0, 0.0, 50.0), **sides),
        w.line(901, w.eastward(2.2, -10.0, 60.0, 70.0)),
        w.line(902, w.eastward(-30.0, -10.0, 60.0), "road_edge"),
        w.line(903, [(w.EAST, w.NORTH)]),
        w.line(904, []),
    ]
    lane = lanes_of(scenario(tmp_path, map_features=features))["1"]
    np.testing.assert_allclose(lane.left_width, 2.2)
    np.testing.assert_allclose(lane.right_width, 1.75)


def test_exits_entries_and_the_longest_neighbour(tmp_path):
    rows = [w.eastward(0.0, 40.0 * k, 40.0 * k + 40.0) for k in range(3)]
    beside = [w.neighbour(3, 0, 9), w.neighbour(2, 10, 60)]
    doubled = [row for row in rows[0] for _ in (0, 1)]
    features = [
        w.lane(1, doubled, exit_lanes=[2], right_neighbors=beside),
        w.lane(2, rows[1]),
        w.lane(3, rows[2], entry_lanes=[2, 77]),
    ]
    lanes = lanes_of(scenario(tmp_path, map_features=features))
    assert [lanes[key].successors for key in "123"] == [("2",), ("3",), ()]
    assert lanes["1"].right == "2"
    assert len(lanes["1"].centre) == len(lanes["1"].left_width) == 81


def test_no_map_and_no_limits(tmp_path):
    recording = scenario(tmp_path, map_features=[], dynamic_map_states=[])
    assert recording.signals == ()
    assert recording.lanes
    assert any(note.startswith("no lanes in the map: ") for note in recording.notes)
    assert recording.default_speed_limit == 15.65
    lane = w.lane(1, w.eastward(0.0, 0.0, 50.0), speed_limit_mph=0.0)
    # without an id it is named by its place
    recording = scenario(tmp_path, map_features=[lane], scenario_id=None)
    assert recording.name == "a.tfrecord-0"
    assert recording.lanes[0].speed_limit is None


def test_signal_intervals_and_stop_lines(whole):
    (signal,) = whole.signals
    assert (signal.id, signal.is_recorded) == ("103", True)
    # unseen first; half a second without a state between red and red is red
    assert signal.state == ("off", "red", "green")
    np.testing.assert_allclose(signal.start, [0.0, 0.3, 5.0], atol=1e-3)
    lanes = lanes_of(whole)
    assert (lanes["103"].signal_ids, lanes["103"].stop_sign) == (("103",), False)
    line = lanes["103"].stop_line - [w.EAST, w.NORTH]
    np.testing.assert_allclose(line, [[40.0, 1.75], [40.0, -1.75]], atol=1e-6)
    assert (lanes["101"].stop_line, lanes["101"].signal_ids) == (None, ())
    # the sign stands beside the start of the turn
    assert lanes["104"].stop_sign
    middle = lanes["104"].stop_line.mean(axis=0) - [w.EAST + 40.0, w.NORTH + w.WIDTH]
    assert np.hypot(*middle) < 0.1


def shown(folder, states, **options):
    """A scenario whose step k shows states[k] on lane 103 (None: nothing)."""
    rows = [{} if state is None else w.shown(state) for state in states]
    return scenario(folder, options, dynamic_map_states=rows)


COLOURS = ["off", *2 * ["red", "yellow", "green"], "off", "off"]


@pytest.mark.parametrize(("state", "colour"), [*enumerate(COLOURS)])
def test_every_state(tmp_path, state, colour):
    recording = shown(tmp_path, [state] * 91)
    assert recording.signals[0].state == (colour,)
    lane = lanes_of(recording)["103"]
    # flashing red is a stop sign in effect
    assert lane.stop_sign == (state == 7)
    assert lane.stop_line is None  # no stop point was given


def test_records_are_read_one_by_one_up_to_a_limit(tmp_path):
    path = put(tmp_path, b"one", b"", b"three" * 1000)
    assert list(read_records(path)) == [b"one", b"", b"three" * 1000]
    assert "record 2: length: 5000 bytes" in refused(list, read_records(path, 4999))
    header = struct.pack("<Q", 2**62)
    path.write_bytes(header + w.masked_crc(header) + b"x" * 100)
    assert "record 0: length: 4611686018427387904 bytes" in refused(read, path)
    path = put(tmp_path, w.scenario())
    assert "expected at most 10485" in refused(read, path, max_record_mib=0.01)
    path.write_bytes(gzip.compress(path.read_bytes()))
    assert "gzip data: expected an uncompressed TFRecord file" in refused(read, path)
