"""Waymo scenarios: as published, messages, framing, hostile records."""

import gzip
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rcirl_jax.data.importers import parts, read_recordings
from rcirl_jax.data.importers.shapes import distance_to_line
from rcirl_jax.data.importers.waymo import map as waymo_map
from rcirl_jax.data.importers.waymo import widths as waymo_widths
from rcirl_jax.data.readers.tfrecord import read_records
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.specs import spec_root
from rcirl_jax.types import Kind
from tests.data.importers.formats import waymo as w
from tests.data.importers.formats.drives import straight


def read(path, source=None):
    return list(read_recordings("waymo", path, source))


def only(path, source=None):
    (recording,) = read(path, source)
    return recording


def put(folder, *records, name="a.tfrecord"):
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_bytes(w.tfrecord(records))
    return path


def scenario(folder, **changes):
    """The recording of one scenario with some fields replaced."""
    return only(put(folder, w.scenario(**changes)))


def spec(folder, old, new):
    """The packaged source TOML with a text replaced."""
    text = (spec_root() / "sources" / "waymo.toml").read_text()
    assert old in text
    path = folder / "source.toml"
    path.write_text(text.replace(old, new))
    return path


def message(path, source=None):
    with pytest.raises(InputError) as error:
        read(path, source)
    assert "\n" not in str(error.value)
    return str(error.value)


# --------------------------------------------------------------------- tracks


def test_tracks_are_what_was_written(tmp_path):
    fixture = w.write(tmp_path)
    recording = only(fixture.input)
    assert {track.id for track in recording.tracks} == set(fixture.tracks)
    assert (recording.name, recording.group) == (w.SCENARIO, w.SCENARIO)
    assert recording.rate_hz == 10.0
    for track in recording.tracks:
        written = fixture.tracks[track.id]
        assert track.kind == written.kind
        assert track.length == pytest.approx(written.length)
        assert track.width == pytest.approx(written.width)
        np.testing.assert_array_equal(track.x, written.x)
        np.testing.assert_array_equal(track.y, written.y)
        # real stamps jitter; headings and speeds are 4-byte floats
        np.testing.assert_allclose(track.t, written.t, atol=3e-5)
        np.testing.assert_allclose(track.heading, written.heading, atol=1e-6)
        np.testing.assert_allclose(track.speed, written.speed, atol=1e-5)


def test_invalid_states_are_bridged_or_end_the_track(tmp_path):
    tracks = {track.id: track for track in only(w.write(tmp_path).input).tracks}
    assert np.diff(tracks["2331"].t).max() == pytest.approx(0.4, abs=1e-3)
    assert tracks["2331"].t[-1] == pytest.approx(3.9, abs=1e-3)
    assert tracks["2331#2"].t[0] == pytest.approx(7.0, abs=1e-3)


def test_invalid_states_may_hold_anything(tmp_path):
    """Published invalid states are empty or zero; their values never count."""
    user = w.road_users()[2325][1]
    bad = [
        [(2, float("nan")), (3, 1e300), (5, w.Single(-1.0)), (9, w.Single(1e30))],
        [],
        [(11, False)],
    ]
    states = [
        (3, w.state(user, row) if 12 <= row < 60 else bad[row % 3])
        for row in range(w.NUM_STEPS)
    ]
    recording = scenario(tmp_path, f2=[[(1, 7), (2, 1), *states]])
    np.testing.assert_array_equal(recording.tracks[0].x, user.x[12:60])
    assert recording.tracks[0].length == pytest.approx(4.5)


def test_kinds_and_what_is_left_out(tmp_path):
    user = straight(w.T, (w.EAST, w.NORTH), 0.0, 3.0)
    kinds = {1: 1, 2: 2, 3: 3, 4: 4, 5: 0}
    tracks = [w.track(key, kind, user, range(91)) for key, kind in kinds.items()]
    tracks += [w.track(6, 1, user, []), [(1, 7), *w.track(8, 1, user, range(91))[2:]]]
    recording = scenario(tmp_path, f2=tracks)
    assert {track.id: track.kind for track in recording.tracks} == {
        "1": Kind.VEHICLE,
        "2": Kind.PEDESTRIAN,
        "3": Kind.CYCLIST,
        # moves, but is nobody to learn from
        "4": Kind.CYCLIST,
    }
    assert "2 tracks of unset type left out" in recording.notes
    assert "1 tracks without a valid state left out" in recording.notes


def test_sizes_are_medians_and_small_ones_are_clipped(tmp_path):
    user = straight(w.T, (w.EAST, w.NORTH), 0.0, 1.0)
    states = []
    for row in range(w.NUM_STEPS):
        state = dict(w.state(user, row))
        state |= {5: w.Single(4.0 if row < 60 else 9.0), 6: w.Single(0.15)}
        states.append((3, list(state.items())))
    (track,) = scenario(tmp_path, f2=[[(1, 1), (2, 2), *states]]).tracks
    assert (track.length, track.width) == (4.0, 0.2)


OUTLIERS = {  # field of all states, or of one -> its value and what is wrong
    "width": ({6: w.Single(6.4)}, range(91), "width: 6.4 m"),
    "length": ({5: w.Single(41.0)}, range(91), "length: 41 m"),
    "no size": ({5: w.Single(0.0)}, range(91), "length: 0 m"),
    "one speed": ({9: w.Single(95.0)}, range(40, 41), "speed: 95"),
}


def traffic(cars, outliers, change, rows):
    """Cars side by side of which the first ones are outliers."""
    tracks = []
    for car in range(cars):
        user = straight(w.T, (w.EAST, w.NORTH + 4.0 * car), 0.0, 8.0)
        states = [dict(w.state(user, row)) for row in range(w.NUM_STEPS)]
        for row in rows if car < outliers else ():
            states[row] |= change
        states = [(3, list(state.items())) for state in states]
        tracks.append([(1, 100 + car), (2, 1), *states])
    return tracks


@pytest.mark.parametrize("name", OUTLIERS)
def test_up_to_a_tenth_of_the_tracks_may_be_impossible(tmp_path, name):
    """As from other trackers; more of them point at a wrong file."""
    change, rows, wrong = OUTLIERS[name]
    few = scenario(tmp_path, f2=traffic(20, 2, change, rows))
    assert [track.id for track in few.tracks] == [str(102 + k) for k in range(18)]
    assert "2 tracks with an impossible size or speed left out" in few.notes
    none = scenario(tmp_path / "none", f2=traffic(20, 0, change, rows))
    assert len(none.tracks) == 20
    assert not any("impossible" in note for note in none.notes)
    one = scenario(tmp_path / "one", f2=traffic(5, 1, change, rows))
    assert len(one.tracks) == 4  # one of few is no wrong file
    many = put(tmp_path / "many", w.scenario(f2=traffic(20, 3, change, rows)))
    assert f"record 0: track 100: {wrong}" in message(many)


def test_history_only_as_in_the_testing_files(tmp_path):
    """11 states, and dynamic map states of the same steps."""
    users = {1: straight(w.T[:11], (w.EAST, w.NORTH), 0.0, 5.0)}
    recording = scenario(
        tmp_path,
        f1=[float(stamp) for stamp in w.STAMPS[:11]],
        f2=[w.track(key, 1, user, range(11)) for key, user in users.items()],
        f7=[[(1, w.signal_state(30))] for _ in range(11)],
    )
    assert recording.tracks[0].t[-1] == pytest.approx(1.0, abs=1e-3)
    assert not any("windows" in note for note in recording.notes)


def test_stamps_may_start_anywhere_and_be_packed(tmp_path):
    packed = np.asarray(w.STAMPS + 1e9, "<f8").tobytes()
    recording = scenario(tmp_path, f1=[packed])
    np.testing.assert_allclose(recording.tracks[0].t, w.T, atol=1e-4)


def test_notes_on_the_recording_car_and_shared_vehicles(tmp_path):
    recording = only(w.write(tmp_path).input)
    assert "the recording car is track 2314" in recording.notes
    automated = {track.id for track in recording.tracks if track.automated}
    assert automated == {"2314"}
    assert any("training_20s" in note for note in recording.notes)


def test_far_coordinates_get_a_local_origin(tmp_path, monkeypatch):
    near = only(w.write(tmp_path).input)
    monkeypatch.setattr(w, "EAST", w.EAST + 50_000.0)
    far = only(w.write(tmp_path / "far").input)
    assert "local origin at x = 58000 m, y = -3000 m" in far.notes
    for a, b in zip(near.tracks, far.tracks, strict=True):
        np.testing.assert_allclose(a.x - 8000.0, b.x, atol=1e-6)
        np.testing.assert_allclose(a.y + 3000.0, b.y, atol=1e-6)
    shift = np.array([-8000.0, 3000.0])
    for a, b in zip(near.lanes, far.lanes, strict=True):
        np.testing.assert_allclose(a.centre + shift, b.centre, atol=1e-6)
        np.testing.assert_allclose(a.left_width, b.left_width, atol=1e-6)
        if a.stop_line is not None:
            np.testing.assert_allclose(a.stop_line + shift, b.stop_line, atol=1e-6)


# ------------------------------------------------------------------------ map


def lanes_of(recording):
    return {lane.id: lane for lane in recording.lanes}


def test_lanes(tmp_path):
    recording = only(w.write(tmp_path).input)
    lanes = lanes_of(recording)
    assert set(lanes) == {"101", "102", "103", "104"}
    south, north = lanes["101"], lanes["102"]
    assert (south.left, south.right) == ("102", None)
    assert (north.left, north.right) == (None, "101")
    assert (south.successors, north.successors) == (("103",), ("104",))
    np.testing.assert_array_equal(
        south.centre, np.array(w.eastward(0.0, -60.0, 40.0), float)
    )
    assert south.speed_limit == pytest.approx(25 * w.MPH)
    assert lanes["103"].speed_limit == pytest.approx(35 * w.MPH)
    assert recording.default_speed_limit == pytest.approx(25 * w.MPH)
    assert any("1 lanes not of type" in note for note in recording.notes)
    assert any("1 lanes of one point" in note for note in recording.notes)


def test_widths_come_from_lines_and_edges(tmp_path):
    lanes = lanes_of(only(w.write(tmp_path).input))
    np.testing.assert_allclose(lanes["101"].left_width, w.WIDTH / 2)
    np.testing.assert_allclose(lanes["101"].right_width, 2.0)
    np.testing.assert_allclose(lanes["102"].right_width, w.WIDTH / 2)
    # no boundary is given
    np.testing.assert_allclose(lanes["102"].left_width, 1.75)
    source = spec(tmp_path, "lane_width_m = 3.5", "lane_width_m = 3.0")
    lanes = lanes_of(only(w.write(tmp_path / "b").input, source))
    np.testing.assert_allclose(lanes["102"].left_width, 1.5)


def test_boundaries_of_a_part_far_ones_and_unknown_ones(tmp_path):
    rows = w.eastward(0.0, 0.0, 50.0)
    sides = [
        w.boundary(13, 20, 40, 901),  # a part: held beyond it
        w.boundary(13, -5, 10**6, 999),  # no such line
        w.boundary(14, 0, 100, 902),  # too far away to bound the lane
        w.boundary(14, 90, 10, 901),  # ends before it starts
    ]
    features = [
        w.lane(1, rows, sides=sides),
        w.line(901, w.eastward(2.2, -10.0, 60.0, 70.0)),
        w.line(902, w.eastward(-30.0, -10.0, 60.0), kind=5),
        w.line(903, [(w.EAST, w.NORTH)]),
        [(1, 904), (4, [(1, 2)])],
    ]
    lane = lanes_of(scenario(tmp_path, f8=features))["1"]
    np.testing.assert_allclose(lane.left_width, 2.2)
    np.testing.assert_allclose(lane.right_width, 1.75)


@given(
    seed=st.integers(0, 1000),
    counts=st.lists(st.integers(1, 12), min_size=1, max_size=6),
)
def test_distances_against_all_segments(seed, counts):
    """The tree finds what looking at every segment finds."""
    rng = np.random.default_rng(seed)
    lines = {
        10 * key: np.cumsum(rng.uniform(-8.0, 8.0, (count, 2)), axis=0)
        for key, count in enumerate(counts)
    }
    chosen = rng.integers(0, len(lines), 40)
    keys = np.array(list(lines))[chosen]
    points = np.array([lines[key][0] for key in keys]) + rng.uniform(-4, 4, (40, 2))
    bounds = waymo_widths.Bounds(lines)
    found = bounds.distances(points, bounds.numbers(keys))
    expected = [
        distance_to_line(point[None], lines[key])[0]
        for point, key in zip(points, keys, strict=True)
    ]
    # exact at the nearest point of a line with points 2 m apart
    np.testing.assert_allclose(found, expected, atol=0.3)
    assert np.median(np.abs(found - expected)) < 1e-9


def test_exits_and_entries_are_joined(tmp_path):
    rows = [w.eastward(0.0, 40.0 * k, 40.0 * k + 40.0) for k in range(3)]
    features = [
        w.lane(1, rows[0], leave=(2,)),
        w.lane(2, rows[1]),
        w.lane(3, rows[2], entry=(2, 77)),
    ]
    lanes = lanes_of(scenario(tmp_path, f8=features))
    assert lanes["1"].successors == ("2",)
    assert lanes["2"].successors == ("3",)


def test_unpacked_exits_and_the_longest_neighbour(tmp_path):
    rows = w.eastward(0.0, 0.0, 50.0)
    key, (number, inner) = w.lane(
        1, rows, neighbours=[w.neighbour(12, 3, 0, 9), w.neighbour(12, 4, 10, 60)]
    )
    features = [
        [key, (number, [*inner, (10, 3), (10, 4)])],
        w.lane(3, w.eastward(-3.0, 0.0, 50.0)),
        w.lane(4, w.eastward(-3.0, 50.0, 90.0)),
    ]
    lane = lanes_of(scenario(tmp_path, f8=features))["1"]
    assert (lane.successors, lane.right) == (("3", "4"), "4")


def test_repeated_points_are_dropped(tmp_path):
    rows = [row for row in w.eastward(0.0, 0.0, 50.0) for _ in (0, 1)]
    lane = lanes_of(scenario(tmp_path, f8=[w.lane(1, rows)]))["1"]
    assert len(lane.centre) == len(lane.left_width) == 101


def test_no_map_and_no_limits(tmp_path):
    recording = scenario(tmp_path, f8=[], f7=[])
    assert (recording.lanes, recording.signals) == ((), ())
    assert recording.default_speed_limit == 15.65
    lane = w.lane(1, w.eastward(0.0, 0.0, 50.0), limit=0.0)
    assert scenario(tmp_path, f8=[lane]).lanes[0].speed_limit is None


# -------------------------------------------------------------------- signals


def test_signal_intervals_and_stop_lines(tmp_path):
    recording = only(w.write(tmp_path).input)
    (signal,) = recording.signals
    assert (signal.id, signal.is_recorded) == ("103", True)
    # unseen first; half a second without a state between red and red is red
    assert signal.state == ("off", "red", "green")
    np.testing.assert_allclose(signal.start, [0.0, 0.3, 5.0], atol=1e-3)
    lanes = lanes_of(recording)
    assert lanes["103"].signal_ids == ("103",)
    line = lanes["103"].stop_line - [w.EAST, w.NORTH]
    np.testing.assert_allclose(line, [[40.0, 1.75], [40.0, -1.75]], atol=1e-6)
    assert not lanes["103"].stop_sign
    assert (lanes["101"].stop_line, lanes["101"].signal_ids) == (None, ())


def test_stop_sign(tmp_path):
    lane = lanes_of(only(w.write(tmp_path).input))["104"]
    assert lane.stop_sign
    # the sign stands beside the start of the turn
    middle = lane.stop_line.mean(axis=0) - [w.EAST + 40.0, w.NORTH + w.WIDTH]
    assert np.hypot(*middle) < 0.1


def shown(folder, states, source=None):
    """Signals of a scenario whose step k shows states[k] (None: nothing)."""
    rows = [
        [] if s is None else [(1, [(1, 103), *([(2, s)] if s else [])])] for s in states
    ]
    path = put(folder, w.scenario(f7=rows))
    return only(path, source)


@pytest.mark.parametrize(
    ("state", "colour"),
    [
        (0, "off"),
        (1, "red"),
        (2, "yellow"),
        (3, "green"),
        (4, "red"),
        (5, "yellow"),
        (6, "green"),
        (7, "off"),
        (8, "off"),
    ],
)
def test_every_state(tmp_path, state, colour):
    recording = shown(tmp_path, [state] * 91)
    assert recording.signals[0].state == (colour,)
    lane = lanes_of(recording)["103"]
    # flashing red is a stop sign in effect
    assert lane.stop_sign == (state == 7)
    assert lane.stop_line is None  # no stop point was given


def test_short_gaps_between_equal_colours(tmp_path):
    states = [4] * 20 + [0] * 10 + [4] * 10 + [None] * 30 + [4] * 10 + [0] * 5 + [6] * 6
    signal = shown(tmp_path, states).signals[0]
    assert signal.state == ("red", "off", "red", "off", "green")
    np.testing.assert_allclose(signal.start, [0.0, 4.0, 7.0, 8.0, 8.5], atol=1e-3)
    source = spec(tmp_path, "signal_gap_s = 2.0", "signal_gap_s = 0.0")
    assert shown(tmp_path, states, source).signals[0].state[:3] == ("red", "off", "red")


def test_two_heads_of_one_lane(tmp_path):
    """The first known one counts."""
    rows = [
        [(1, [(1, 103), (2, 0)]), (1, [(1, 103), (2, 3)]), (1, [(1, 103), (2, 4)])]
    ] * 91
    assert scenario(tmp_path, f7=rows).signals[0].state == ("green",)


def test_signal_of_a_lane_that_is_not_read(tmp_path):
    rows = [[(1, [(1, 106), (2, 4), (3, w.point(0.0, 0.0))])]] * 91
    recording = scenario(tmp_path, f7=rows)
    assert [signal.id for signal in recording.signals] == ["106"]


# ------------------------------------------------------------------- messages


def test_unknown_fields_and_other_wire_types_are_skipped(tmp_path):
    user = w.road_users()[2314][1]
    extra = [(99, 5), (98, 1.0), (97, w.Single(1.0)), (96, "later"), (5, "no float")]
    states = [(3, [*extra, *w.state(user, row), (11, 1), *extra]) for row in range(91)]
    (track,) = scenario(
        tmp_path, f2=[[(7, 3), (1, 7), (2, 1), *states]], f12=["lidar" * 99], f2000=[1]
    ).tracks
    np.testing.assert_array_equal(track.x, user.x)
    assert track.length == pytest.approx(4.5)


def test_the_last_value_of_a_singular_field_counts(tmp_path):
    assert scenario(tmp_path, f5=["first", "second"]).name == "second"


# ------------------------------------------------------------------- framing


def test_records_are_read_one_by_one(tmp_path):
    path = put(tmp_path, b"one", b"", b"three" * 1000)
    assert list(read_records(path)) == [b"one", b"", b"three" * 1000]


def test_files_of_all_names_and_folders(tmp_path):
    names = (
        "training.tfrecord-00000-of-01000",
        "validation/uncompressed_scenario_validation_validation.tfrecord-00149-of-00150",
        "training_20s/a.tfrecord",
    )
    for number, name in enumerate(names):
        place = tmp_path / name
        data = [w.scenario(f5=[f"{number}{letter}"]) for letter in "ab"]
        put(place.parent, *data, name=place.name)
    (tmp_path / "LICENSE").write_text("text")
    recordings = read(tmp_path)
    assert sorted(recording.name for recording in recordings) == [
        "0a",
        "0b",
        "1a",
        "1b",
        "2a",
        "2b",
    ]
    assert len(parts("waymo", tmp_path)[0]) == 3


def test_a_scenario_without_an_id_is_named_by_its_place(tmp_path):
    assert scenario(tmp_path, f5=[]).name == "a.tfrecord-0"


def test_truncated_files(tmp_path):
    whole = put(tmp_path, w.scenario(), b"next").read_bytes()
    path = tmp_path / "a.tfrecord"
    for size in (0, 1, 7, 11, 12, 13, 5000, len(whole) - 21, len(whole) - 1):
        path.write_bytes(whole[:size])
        text = message(path)
        assert text.startswith(str(path))
        assert "expected" in text


def test_garbled_files(tmp_path):
    path = put(tmp_path, w.scenario())
    data = path.read_bytes()
    for place in np.linspace(0, len(data) - 1, 50).astype(int):
        changed = bytearray(data)
        changed[place] ^= 0x40
        path.write_bytes(changed)
        assert "crc32c" in message(path)


def test_a_long_record_is_refused_before_it_is_read(tmp_path):
    header = struct.pack("<Q", 2**62)
    path = tmp_path / "a.tfrecord"
    path.write_bytes(header + w.masked_crc(header) + b"x" * 100)
    assert "record 0: length: 4611686018427387904 bytes" in message(path)
    path = put(tmp_path, w.scenario())
    source = spec(tmp_path, "max_record_mib = 32", "max_record_mib = 0.01")
    assert "expected at most 10485" in message(path, source)


def test_compressed_files_and_text_are_refused(tmp_path):
    path = put(tmp_path, w.scenario())
    path.write_bytes(gzip.compress(path.read_bytes()))
    assert "gzip data: expected an uncompressed TFRecord file" in message(path)
    path.write_text("id,x,y\n" * 100)
    assert "no TFRecord file" in message(path)


def test_no_files(tmp_path):
    (tmp_path / "a.txt").write_text("")
    assert "no file matches *.tfrecord" in message(tmp_path)


# ----------------------------------------------------------- hostile messages


def test_other_messages_are_refused(tmp_path):
    """tf_example files hold tf.train.Example: field 1 with a map of features.

    lidar_and_camera files hold scenarios of an id, laser data and camera tokens.
    """
    feature = [(1, [(1, "scenario/id"), (2, [(1, [(1, b"637f")])])])]
    sensors = [(5, "id"), (12, [(1, [(1, 1), (2, bytes(900))])]), (13, [(1, 2)])]
    for data in (w.message([(1, feature)]), b"", w.message(sensors)):
        path = put(tmp_path, data)
        found = message(path)
        assert "expected Scenario messages" in found
        assert "not tf_example/ or lidar_and_camera/" in found


def bad_track(**changes):
    """The first track with fields of all states replaced, by number."""
    user = w.road_users()[2314][1]
    numbers = {int(key[1:]): value for key, value in changes.items()}
    states = [
        (3, list((dict(w.state(user, row)) | numbers).items())) for row in range(91)
    ]
    return {"f2": [[(1, 7), (2, 1), *states]]}


def stamps(values):
    return {"f1": [float(value) for value in values]}


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"f1": []}, "timestamps_seconds: [] (0): expected increasing times"),
        (stamps([0.0] * 91), "timestamps_seconds"),
        (stamps([*w.STAMPS[:-1], float("nan")]), "timestamps_seconds"),
        (stamps(w.STAMPS[::-1]), "timestamps_seconds"),
        (stamps(w.STAMPS * 1e6), "timestamps_seconds: 9.00002e+06 s"),
        (stamps(w.STAMPS * 10), "per second: expected 10 (unit s)"),
        (stamps(w.STAMPS[:50]), "track 2314: 91 states: expected 50"),
        ({"f1": [b"1234567"]}, "expected Scenario"),
        ({"f2": []}, "tracks: none"),
        ({"f2": [[(1, 7), (2, 1)]]}, "track 7: 0 states: expected 91"),
        ({"f2": [w.track(1, 1, w.road_users()[2314][1], [])]}, "tracks: none"),
        (
            {"f2": [w.track(1, 1, w.road_users()[2314][1], range(91))] * 2},
            "track id: 1: met twice",
        ),
        (bad_track(f2=float("nan")), "center_x: nan"),
        (bad_track(f3=float("inf")), "center_y: inf"),
        (bad_track(f2=1e200), "center_x: 1e+200"),
        (bad_track(f9=w.Single(float("nan"))), "velocity_x: nan"),
        (bad_track(f9=w.Single(500.0)), "track 7: speed: 500"),
        (bad_track(f9=w.Single(1e12)), "velocity_x: 1e+12"),
        (bad_track(f8=w.Single(float("nan"))), "track 7: heading: nan"),
        (bad_track(f5=w.Single(float("nan"))), "track 7: length: nan"),
        (bad_track(f5=w.Single(0.0)), "track 7: length: 0 m"),
        (bad_track(f6=w.Single(-2.0)), "track 7: width: -2 m"),
        (bad_track(f5=w.Single(400.0)), "track 7: length: 400 m"),
        (
            {"f2": [w.track(1, 9, w.road_users()[2314][1], range(91))]},
            "track 1: object_type: 9: expected one of vehicle",
        ),
        ({"f7": [[]] * 90}, "dynamic_map_states: 90: expected 91"),
        ({"f7": [[(1, [(1, 103), (2, 77)])]] * 91}, "lane 103: signal state 77"),
        ({"f7": [[(1, [(1, 103), (2, -1)])]] * 91}, "lane 103: signal state -1"),
        ({"f8": [w.lane(1, w.eastward(0, 0, 9), limit=-5.0)]}, "speed_limit_mph: -5"),
        ({"f8": [w.lane(1, w.eastward(0, 0, 9), limit=1e9)]}, "speed_limit_mph: 1e+09"),
        (
            {"f8": [w.lane(1, w.eastward(0, 0, 9), limit=float("nan"))]},
            "speed_limit_mph: nan",
        ),
        ({"f8": [w.lane(1, [(0.0, 0.0), (float("nan"), 1.0)])]}, "map points: x: nan"),
        ({"f8": [w.lane(1, w.eastward(0, 0, 9))] * 2}, "map feature 1: met twice"),
        ({"f8": [[(1, 1), (3, b"\xff\xff")]]}, "expected Scenario"),
        ({"f8": [b"\x1b"]}, "expected Scenario"),
        ({"f2": [[(1, 7), (2, 1), *[(3, b"\x09\x00")] * 91]]}, "expected Scenario"),
        ({"f2": [[(1, 7), (2, 1), *[(3, b"\x0c")] * 91]]}, "expected Scenario"),
        ({"f2": [[(1, 7), (2, 1), *[(3, b"\xff" * 20)] * 91]]}, "expected Scenario"),
        ({"f2": [[(1, 7), (2, 1), *[(3, b"\x12\xff")] * 91]]}, "expected Scenario"),
        ({"f5": [b"\xff\xfe"]}, "expected Scenario"),
    ],
)
def test_bad_scenarios(tmp_path, changes, field):
    path = put(tmp_path, w.scenario(**changes))
    text = message(path)
    assert text.startswith(f"{path}: record 0")
    assert field in text
    assert "expected" in text


def test_a_field_longer_than_its_message(tmp_path):
    """Lengths that point past the message, the record, or backwards."""
    for length in (50, 10**6, 2**63, 2**64 - 1):
        state = w.varint(2 << 3 | 2) + w.varint(length)
        tracks = [[(1, 7), (2, 1), *[(3, state)] * 91]]
        assert "expected Scenario" in message(put(tmp_path, w.scenario(f2=tracks)))
        data = w.varint(2 << 3 | 2) + w.varint(length) + b"12"
        assert "expected Scenario" in message(put(tmp_path, data))


def test_states_are_limited(tmp_path, monkeypatch):
    monkeypatch.setattr("rcirl_jax.data.importers.waymo.reader.MAX_STATES", 545)
    text = message(put(tmp_path, w.scenario()))
    assert "tracks: 6 of 91 states: expected at most 545 states" in text


def test_many_boundaries_of_one_lane_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("rcirl_jax.data.importers.waymo.map.MAX_POINTS", 1000)
    rows = w.eastward(0.0, 0.0, 50.0)
    sides = [w.boundary(13, -(2**62), 2**62, 901)] * 50
    path = put(tmp_path, w.scenario(f8=[w.lane(1, rows, sides=sides)]))
    assert "left_boundaries: " in message(path)


def test_lanes_with_signals_by_steps_are_limited(tmp_path, monkeypatch):
    rows = [[(1, [(1, lane), (2, 4)]) for lane in (103, 106)]] * 91
    path = put(tmp_path, w.scenario(f7=rows))
    monkeypatch.setattr(waymo_map, "MAX_COLOURS", 182)
    assert len(only(path).signals) == 2
    monkeypatch.setattr(waymo_map, "MAX_COLOURS", 181)
    assert "dynamic_map_states: 2 lanes over 91 steps" in message(path)


def test_any_garbled_message_is_read_or_refused(tmp_path):
    """Valid framing around damaged messages: one line, or a recording."""
    data, refused = w.scenario(), 0
    rng = np.random.default_rng(0)
    for _ in range(150):
        changed = bytearray(data)
        for place in rng.integers(0, len(data), 3):
            changed[place] = rng.integers(0, 256)
        path = put(tmp_path, bytes(changed))
        try:
            assert len(only(path).tracks) > 0
        except InputError as error:
            assert str(error).startswith(str(path))  # noqa: PT017
            refused += 1
    assert refused > 20


def test_bad_source(tmp_path):
    path = put(tmp_path, w.scenario())
    for old, new, field in [
        ('vehicle = "vehicle"', 'vehicle = "boat"', "kinds.vehicle: boat"),
        ('vehicle = "vehicle"', "", "object_type: vehicle: expected one of"),
        ("[kinds]", "kinds = 3\n[others]", "kinds: 3: expected a table"),
        ("signal_gap_s = 2.0", 'signal_gap_s = "long"', "signal_gap_s: long"),
        ('["undefined", "freeway", ', '["tram", ', "lane_types: tram"),
        ('lane_types = ["undefined"', 'lane_types = 3\nx = ["u"', "lane_types: 3"),
    ]:
        assert field in message(path, spec(tmp_path, old, new))
    source = spec(tmp_path, 'pattern = ["*.tfrecord", ', 'pattern = [3, "/", ')
    assert "pattern: [3, '/'" in message(tmp_path, source)
