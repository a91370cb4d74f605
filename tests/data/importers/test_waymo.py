"""Waymo scenarios: what messages say, limits, framing, hostile records."""

import functools
import gzip
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rcirl_jax.data.importers import parts
from rcirl_jax.data.importers.shapes import distance_to_line
from rcirl_jax.data.importers.waymo import widths
from rcirl_jax.data.readers.tfrecord import read_records
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind
from tests.data.importers.formats import waymo as w
from tests.data.importers.formats.drives import straight
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


# --------------------------------------------------------------------- tracks


def test_positions_are_exact_and_speeds_are_4_byte_floats(whole):
    assert (whole.name, whole.group, whole.rate_hz) == (w.SCENARIO, w.SCENARIO, 10.0)
    written = w.expected()
    for track in whole.tracks:
        np.testing.assert_array_equal(track.x, written[track.id].x)
        np.testing.assert_array_equal(track.y, written[track.id].y)
        np.testing.assert_allclose(track.t, written[track.id].t, atol=3e-5)
        np.testing.assert_allclose(track.heading, written[track.id].heading, atol=1e-6)
        np.testing.assert_allclose(track.speed, written[track.id].speed, atol=1e-5)


def test_invalid_states_may_hold_anything(tmp_path):
    """Published invalid states are empty or zero; their values never count."""
    user = w.road_users()[2325][1]
    wild = [(2, float("nan")), (3, 1e300), (5, w.Single(-1.0)), (9, w.Single(1e30))]
    bad = [wild, [], [(11, False)]]
    states = [
        (3, w.state(user, row) if 12 <= row < 60 else bad[row % 3])
        for row in range(w.NUM_STEPS)
    ]
    recording = scenario(tmp_path, f2=[[(1, 7), (2, 1), *states]])
    np.testing.assert_array_equal(recording.tracks[0].x, user.x[12:60])
    assert recording.tracks[0].length == pytest.approx(4.5)


def test_kinds_and_what_is_left_out(tmp_path):
    user = straight(w.T, (w.EAST, w.NORTH), 0.0, 3.0)
    tracks = [
        w.track(key, kind, user, range(91)) for key, kind in enumerate((1, 2, 3, 4, 0))
    ]
    tracks += [w.track(6, 1, user, []), [(1, 7), *w.track(8, 1, user, range(91))[2:]]]
    recording = scenario(tmp_path, f2=tracks)
    # 4 moves, but is nobody to learn from
    kinds = (Kind.VEHICLE, Kind.PEDESTRIAN, Kind.CYCLIST, Kind.CYCLIST)
    assert {track.id: track.kind for track in recording.tracks} == dict(
        zip("0123", kinds, strict=True)
    )
    assert "2 tracks of unset type left out" in recording.notes
    assert "1 tracks without a valid state left out" in recording.notes


def car_with(change, rows=range(w.NUM_STEPS), key=7, user=None):
    """A track with some fields of some states replaced, by number."""
    user = w.road_users()[2314][1] if user is None else user
    states = [dict(w.state(user, row)) for row in range(w.NUM_STEPS)]
    for row in rows:
        states[row] |= change
    return [(1, key), (2, 1), *[(3, list(state.items())) for state in states]]


def test_sizes_are_medians_and_small_ones_are_raised(tmp_path):
    long = car_with({5: w.Single(9.0), 6: w.Single(0.15)}, range(60, 91))
    user = straight(w.T, (w.EAST, w.NORTH), 0.0, 1.0, size=(4.0, 0.15))
    (one, other) = scenario(tmp_path, f2=[long, car_with({}, key=8, user=user)]).tracks
    assert (one.length, one.width) == (pytest.approx(4.5), pytest.approx(1.9))
    assert (other.length, other.width) == (4.0, 0.2)


OUTLIERS = {  # field of all states, or of one -> its value and what is wrong
    "width": ({6: w.Single(6.4)}, range(91), "width: 6.4 m"),
    "length": ({5: w.Single(41.0)}, range(91), "length: 41 m"),
    "no size": ({5: w.Single(0.0)}, range(91), "length: 0 m"),
    "one speed": ({9: w.Single(95.0)}, range(40, 41), "speed: 95"),
}


@pytest.mark.parametrize("name", OUTLIERS)
def test_up_to_a_tenth_of_the_tracks_may_be_impossible(tmp_path, name):
    """As from other trackers; more of them point at a wrong file."""
    change, rows, wrong = OUTLIERS[name]

    def traffic(cars, outliers):
        """Cars side by side of which the first ones are outliers."""
        users = [
            straight(w.T, (w.EAST, w.NORTH + 4.0 * car), 0.0, 8.0)
            for car in range(cars)
        ]
        return [
            car_with(change, rows if car < outliers else (), 100 + car, user)
            for car, user in enumerate(users)
        ]

    few = scenario(tmp_path, f2=traffic(20, 2))
    assert [track.id for track in few.tracks] == [str(102 + k) for k in range(18)]
    assert "2 tracks with an impossible size or speed left out" in few.notes
    none = scenario(tmp_path, f2=traffic(20, 0))
    assert len(none.tracks) == 20
    assert not any("impossible" in note for note in none.notes)
    # one of few is no wrong file
    assert len(scenario(tmp_path, f2=traffic(5, 1)).tracks) == 4
    many = refused(scenario, tmp_path, f2=traffic(20, 3))
    assert f"record 0: track 100: {wrong}" in many


def test_history_only_as_in_the_testing_files(tmp_path):
    """11 states, and dynamic map states of the same steps; packed, late stamps."""
    user = straight(w.T[:11], (w.EAST, w.NORTH), 0.0, 5.0)
    recording = scenario(
        tmp_path,
        f1=[np.asarray(w.STAMPS[:11] + 1e9, "<f8").tobytes()],
        f2=[w.track(1, 1, user, range(11))],
        f7=[[(1, w.signal_state(30))] for _ in range(11)],
    )
    np.testing.assert_allclose(recording.tracks[0].t, w.T[:11], atol=1e-4)
    assert not any("windows" in note for note in recording.notes)


def test_notes_on_the_recording_car_and_shared_vehicles(whole):
    assert "the recording car is track 2314" in whole.notes
    assert {track.id for track in whole.tracks if track.automated} == {"2314"}
    assert any("training_20s" in note for note in whole.notes)


def test_far_coordinates_get_a_local_origin(whole, tmp_path, monkeypatch):
    monkeypatch.setattr(w, "EAST", w.EAST + 50_000.0)
    far = only(w.write(tmp_path).input)
    assert "local origin at x = 58000 m, y = -3000 m" in far.notes
    shift = np.array([-8000.0, 3000.0])
    for a, b in zip(whole.tracks, far.tracks, strict=True):
        np.testing.assert_allclose(a.x + shift[0], b.x, atol=1e-6)
        np.testing.assert_allclose(a.y + shift[1], b.y, atol=1e-6)
    for a, b in zip(whole.lanes, far.lanes, strict=True):
        np.testing.assert_allclose(a.centre + shift, b.centre, atol=1e-6)
        np.testing.assert_allclose(a.left_width, b.left_width, atol=1e-6)
        if a.stop_line is not None:
            np.testing.assert_allclose(a.stop_line + shift, b.stop_line, atol=1e-6)


# ------------------------------------------------------------------------ map


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
    assert any("1 lanes not of type" in note for note in whole.notes)
    assert any("1 lanes of one point" in note for note in whole.notes)


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
    sides = [
        w.boundary(13, 20, 40, 901),  # a part: held beyond it
        w.boundary(13, -5, 10**6, 999),  # no such line
        w.boundary(14, 0, 100, 902),  # too far away to bound the lane
        w.boundary(14, 90, 10, 901),  # ends before it starts
    ]
    features = [
        w.lane(1, w.eastward(0.0, 0.0, 50.0), sides=sides),
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
    keys = np.array(list(lines))[rng.integers(0, len(lines), 40)]
    points = np.array([lines[key][0] for key in keys]) + rng.uniform(-4, 4, (40, 2))
    bounds = widths.Bounds(lines)
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
    ends = ({"leave": (2,)}, {}, {"entry": (2, 77)})
    features = [w.lane(k + 1, rows[k], **ends[k]) for k in range(3)]
    lanes = lanes_of(scenario(tmp_path, f8=features))
    assert [lanes[key].successors for key in "123"] == [("2",), ("3",), ()]


def test_unpacked_exits_the_longest_neighbour_and_repeated_points(tmp_path):
    rows = [row for row in w.eastward(0.0, 0.0, 50.0) for _ in (0, 1)]
    beside = [w.neighbour(12, 3, 0, 9), w.neighbour(12, 4, 10, 60)]
    key, (number, inner) = w.lane(1, rows, neighbours=beside)
    features = [
        [key, (number, [*inner, (10, 3), (10, 4)])],
        w.lane(3, w.eastward(-3.0, 0.0, 50.0)),
        w.lane(4, w.eastward(-3.0, 50.0, 90.0)),
    ]
    lane = lanes_of(scenario(tmp_path, f8=features))["1"]
    assert (lane.successors, lane.right) == (("3", "4"), "4")
    assert len(lane.centre) == len(lane.left_width) == 101


def test_no_map_and_no_limits(tmp_path):
    recording = scenario(tmp_path, f8=[], f7=[])
    assert (recording.lanes, recording.signals) == ((), ())
    assert recording.default_speed_limit == 15.65
    lane = w.lane(1, w.eastward(0.0, 0.0, 50.0), limit=0.0)
    # without an id it is named by its place
    recording = scenario(tmp_path, f8=[lane], f5=[])
    assert recording.name == "a.tfrecord-0"
    assert recording.lanes[0].speed_limit is None


# -------------------------------------------------------------------- signals


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
    rows = [
        [] if s is None else [(1, [(1, 103), *([(2, s)] if s else [])])] for s in states
    ]
    return scenario(folder, options, f7=rows)


COLOURS = ["off", *2 * ["red", "yellow", "green"], "off", "off"]


@pytest.mark.parametrize(("state", "colour"), [*enumerate(COLOURS)])
def test_every_state(tmp_path, state, colour):
    recording = shown(tmp_path, [state] * 91)
    assert recording.signals[0].state == (colour,)
    lane = lanes_of(recording)["103"]
    # flashing red is a stop sign in effect
    assert lane.stop_sign == (state == 7)
    assert lane.stop_line is None  # no stop point was given


def test_short_gaps_between_equal_colours(tmp_path):
    states = [4] * 20 + [0] * 10 + [4] * 10 + [None] * 30 + [4] * 10 + [0] * 5 + [6] * 6
    (signal,) = shown(tmp_path, states).signals
    assert signal.state == ("red", "off", "red", "off", "green")
    np.testing.assert_allclose(signal.start, [0.0, 4.0, 7.0, 8.0, 8.5], atol=1e-3)
    (signal,) = shown(tmp_path, states, signal_gap_s=0.0).signals
    assert signal.state[:3] == ("red", "off", "red")


def test_two_heads_of_one_lane_and_a_lane_that_is_not_read(tmp_path):
    """The first known one counts."""
    heads = [(1, [(1, 103), (2, state)]) for state in (0, 3, 4)]
    rows = [[*heads, (1, [(1, 106), (2, 4), (3, w.point(0.0, 0.0))])]] * 91
    signals = scenario(tmp_path, f7=rows).signals
    assert {s.id: s.state for s in signals} == {"103": ("green",), "106": ("red",)}


# ------------------------------------------------------- messages and framing


def test_unknown_fields_are_skipped_and_the_last_value_counts(tmp_path):
    user = w.road_users()[2314][1]
    extra = [(99, 5), (98, 1.0), (97, w.Single(1.0)), (96, "later"), (5, "no float")]
    states = [(3, [*extra, *w.state(user, row), (11, 1), *extra]) for row in range(91)]
    tracks = [[(7, 3), (1, 7), (2, 1), *states]]
    changes = {"f12": ["lidar" * 99], "f2000": [1], "f5": ["first", "second"]}
    recording = scenario(tmp_path, f2=tracks, **changes)
    assert recording.name == "second"
    np.testing.assert_array_equal(recording.tracks[0].x, user.x)
    assert recording.tracks[0].length == pytest.approx(4.5)


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
    found = sorted(recording.name for recording in read(tmp_path))
    assert found == ["0a", "0b", "1a", "1b", "2a", "2b"]
    assert len(parts("waymo", tmp_path)[0]) == 3


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


def test_other_messages_are_refused(tmp_path):
    """tf_example files hold tf.train.Example: field 1 with a map of features.

    lidar_and_camera files hold scenarios of an id, laser data and camera tokens.
    """
    feature = [(1, [(1, "scenario/id"), (2, [(1, [(1, b"637f")])])])]
    sensors = [(5, "id"), (12, [(1, [(1, 1), (2, bytes(900))])]), (13, [(1, 2)])]
    for data in (w.message([(1, feature)]), b"", w.message(sensors)):
        line = refused(read, put(tmp_path, data))
        assert "expected Scenario messages" in line
        assert "not tf_example/ or lidar_and_camera/" in line


def stamps(values):
    return {"f1": [float(value) for value in values]}


def car(**changes):
    return {"f2": [car_with({int(k[1:]): v for k, v in changes.items()})]}


def sole(key=1, kind=1, seen=range(91)):
    return w.track(key, kind, w.road_users()[2314][1], seen)


def raw(state):
    """A track whose states are some bytes."""
    return {"f2": [[(1, 7), (2, 1), *[(3, state)] * 91]]}


def limit(value):
    return {"f8": [w.lane(1, w.eastward(0, 0, 9), limit=value)]}


def signal(state):
    return {"f7": [[(1, [(1, 103), (2, state)])]] * 91}


NAN = float("nan")
BAD = [
    ({"f1": []}, "timestamps_seconds: [] (0): expected increasing times"),
    (stamps([0.0] * 91), "timestamps_seconds"),
    (stamps([*w.STAMPS[:-1], NAN]), "timestamps_seconds"),
    (stamps(w.STAMPS[::-1]), "timestamps_seconds"),
    (stamps(w.STAMPS * 1e6), "timestamps_seconds: 9.00002e+06 s"),
    (stamps(w.STAMPS * 10), "per second: expected 10 (unit s)"),
    (stamps(w.STAMPS[:50]), "track 2314: 91 states: expected 50"),
    ({"f1": [b"1234567"]}, "expected Scenario"),
    ({"f2": []}, "tracks: none"),
    ({"f2": [[(1, 7), (2, 1)]]}, "track 7: 0 states: expected 91"),
    ({"f2": [sole(seen=[])]}, "tracks: none"),
    ({"f2": [sole()] * 2}, "track id: 1: met twice"),
    ({"f2": [sole(kind=9)]}, "track 1: object_type: 9: expected one of vehicle"),
    (car(f2=NAN), "center_x: nan"),
    (car(f3=float("inf")), "center_y: inf"),
    (car(f2=1e200), "center_x: 1e+200"),
    (car(f9=w.Single(NAN)), "velocity_x: nan"),
    (car(f9=w.Single(500.0)), "track 7: speed: 500"),
    (car(f9=w.Single(1e12)), "velocity_x: 1e+12"),
    (car(f8=w.Single(NAN)), "track 7: heading: nan"),
    (car(f5=w.Single(NAN)), "track 7: length: nan"),
    (car(f5=w.Single(0.0)), "track 7: length: 0 m"),
    (car(f6=w.Single(-2.0)), "track 7: width: -2 m"),
    (car(f5=w.Single(400.0)), "track 7: length: 400 m"),
    ({"f7": [[]] * 90}, "dynamic_map_states: 90: expected 91"),
    (signal(77), "lane 103: signal state 77"),
    (signal(-1), "lane 103: signal state -1"),
    (limit(-5.0), "speed_limit_mph: -5"),
    (limit(1e9), "speed_limit_mph: 1e+09"),
    (limit(NAN), "speed_limit_mph: nan"),
    ({"f8": [w.lane(1, [(0.0, 0.0), (NAN, 1.0)])]}, "map points: x: nan"),
    ({"f8": [w.lane(1, w.eastward(0, 0, 9))] * 2}, "map feature 1: met twice"),
    ({"f8": [[(1, 1), (3, b"\xff\xff")]]}, "expected Scenario"),
    (raw(b"\x12\xff"), "expected Scenario"),
    ({"f5": [b"\xff\xfe"]}, "expected Scenario"),
]


@pytest.mark.parametrize(("changes", "words"), BAD)
def test_bad_scenarios(tmp_path, changes, words):
    path = put(tmp_path, w.scenario(**changes))
    line = refused(read, path)
    assert line.startswith(f"{path}: record 0")
    assert words in line
    assert "expected" in line


WIDE = w.lane(1, w.eastward(0, 0, 50), sides=[w.boundary(13, -(2**62), 2**62, 9)] * 50)
TWO = [[(1, [(1, lane), (2, 4)]) for lane in (103, 106)]] * 91
LIMITS = [
    ("reader.MAX_STATES", 545, {}, "tracks: 6 of 91 states: expected at most 545"),
    ("map.MAX_POINTS", 1000, {"f8": [WIDE]}, "left_boundaries: "),
    ("map.MAX_COLOURS", 181, {"f7": TWO}, "dynamic_map_states: 2 lanes over 91 steps"),
]


@pytest.mark.parametrize(("name", "most", "changes", "words"), LIMITS)
def test_limits(tmp_path, monkeypatch, name, most, changes, words):
    monkeypatch.setattr(f"rcirl_jax.data.importers.waymo.{name}", most)
    assert words in refused(scenario, tmp_path, **changes)
    monkeypatch.setattr(f"rcirl_jax.data.importers.waymo.{name}", most * 50)
    assert scenario(tmp_path, **changes).tracks


def test_any_garbled_message_is_read_or_refused(tmp_path):
    """Valid framing around damaged messages: one line, or a recording."""
    data, refusals = w.scenario(), 0
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
            refusals += 1
    assert refusals > 20


KINDS = logs.packaged("waymo")["kinds"]


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ({"kinds": {**KINDS, "vehicle": "boat"}}, "kinds.vehicle: boat"),
        ({"kinds": {"cyclist": "cyclist"}}, "object_type: vehicle: expected one of"),
        ({"kinds": 3}, "kinds: 3: expected a table"),
        ({"signal_gap_s": "long"}, "signal_gap_s: long"),
        ({"lane_types": ["tram"]}, "lane_types: tram"),
        ({"lane_types": 3}, "lane_types: 3"),
        ({"pattern": [3, "/"]}, "pattern: [3, '/'"),
    ],
)
def test_bad_options(tmp_path, option, words):
    put(tmp_path, w.scenario())
    assert words in refused(read, tmp_path, **option)
