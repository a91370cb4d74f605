"""Argoverse 2: a scenario as published, the real files, hostile Parquet and JSON."""

import json
import shutil
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rcirl_jax.data.importers import read_recordings
from rcirl_jax.data.importers.argoverse2 import reader as argoverse2
from rcirl_jax.data.readers.tables import columnar, table
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.specs import load_toml, spec_root
from rcirl_jax.types import Kind
from tests.data.importers.formats import argoverse2 as w


def read(path, source=None):
    return list(read_recordings("argoverse2", path, source))


def only(path, source=None):
    (recording,) = read(path, source)
    return recording


def spec(folder, old="", new=""):
    """The packaged source TOML with a text replaced."""
    text = (spec_root() / "sources" / "argoverse2.toml").read_text()
    assert old in text
    path = folder / "source.toml"
    path.write_text(text.replace(old, new))
    return path


def changed(folder, column, value, row=3):
    """A scenario with one cell changed; the column's type follows the value."""
    table = w.columns()
    table[column][row] = value
    return w.write_scenario(folder, table=table)[0]


def message(path, source=None):
    with pytest.raises(InputError) as error:
        read(path, source)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_tracks_are_what_was_written(tmp_path):
    fixture = w.write(tmp_path)
    recording = only(fixture.input)
    assert {track.id for track in recording.tracks} == set(fixture.tracks)
    assert (recording.rate_hz, recording.name) == (10.0, w.SCENARIO)
    assert recording.group == w.SLICE
    for track in recording.tracks:
        written = fixture.tracks[track.id]
        assert (track.kind, track.length) == (written.kind, written.length)
        assert track.width == written.width
        for name in ("t", "x", "y", "heading", "speed"):
            np.testing.assert_allclose(
                getattr(track, name), getattr(written, name), atol=1e-9
            )


def test_gaps_are_bridged_or_end_the_track(tmp_path):
    tracks = {track.id: track for track in only(w.write(tmp_path).input).tracks}
    assert np.diff(tracks["139400"].t).max() == pytest.approx(0.4)
    assert tracks["139400#2"].t[0] == pytest.approx(8.0)


def test_lanes(tmp_path):
    recording = only(w.write(tmp_path).input)
    lanes = {lane.id: lane for lane in recording.lanes}
    first = lanes["205119001"]
    np.testing.assert_allclose(first.left_width, w.WIDTH / 2, atol=0.01)
    np.testing.assert_allclose(first.centre[:, 0], w.EAST + w.WIDTH / 2, atol=0.01)
    assert first.successors == ("205119003", "205119006")
    # the oncoming lane is named as left neighbour in the file
    assert (first.left, first.right) == (None, "205119002")
    assert lanes["205119002"].left == "205119001"
    # the bicycle lane is left out, and so is a successor that the map lacks
    assert (lanes["205119002"].right, lanes["205119003"].successors) == (None, ())
    assert any("1 lanes not of type" in note for note in recording.notes)
    assert recording.signals == ()
    heading = lanes["205119005"].centre[-1] - lanes["205119005"].centre[0]
    assert heading[1] < 0.0


def test_turning_lane_lies_midway(tmp_path):
    recording = only(w.write(tmp_path).input)
    turn = next(lane for lane in recording.lanes if lane.id == "205119006")
    middle = np.array([w.EAST - 20.0 + w.WIDTH / 2, w.NORTH + 30.0])
    np.testing.assert_allclose(np.hypot(*(turn.centre - middle).T), 20.0, atol=0.1)


def test_bicycle_lanes_on_request(tmp_path):
    source = spec(tmp_path, '["VEHICLE", "BUS"]', '["VEHICLE", "BIKE"]')
    assert len(only(w.write(tmp_path).input, source).lanes) == 7


def test_options(tmp_path):
    path = w.write(tmp_path).input
    source = spec(tmp_path, "speed_limit = 15.65", "speed_limit = 11.2")
    assert only(path, source).default_speed_limit == 11.2
    source = spec(tmp_path, "min_category = 0", "min_category = 1")
    recording = only(path, source)
    assert "138902" not in {track.id for track in recording.tracks}
    assert any("3 tracks below category 1" in note for note in recording.notes)
    source = spec(tmp_path, "bus = [12.0, 2.6]", "bus = [18.0, 2.55]")
    assert {t.length for t in only(path, source).tracks if "139400" in t.id} == {18.0}
    source = spec(tmp_path, 'cyclist = "cyclist"', 'cyclist = "vehicle"')
    kinds = {track.id: track.kind for track in only(path, source).tracks}
    assert kinds["139408"] == Kind.VEHICLE


def test_every_type_has_a_kind_and_a_size():
    source = load_toml(spec_root() / "sources" / "argoverse2.toml")
    assert len(source["kinds"]) == 10
    assert set(source["kinds"]) | {"AV"} == set(source["sizes"])


@pytest.mark.parametrize(("driver", "found"), [("automated", {"AV"}), ("human", set())])
def test_the_recording_car_is_no_human_unless_said(tmp_path, driver, found):
    source = spec(
        tmp_path, 'recording_car = "automated"', f'recording_car = "{driver}"'
    )
    recording = only(w.write(tmp_path).input, source)
    assert {t.id for t in recording.tracks if t.automated} == found


@pytest.mark.parametrize("nested", ["", "scenario", "split"])
def test_input_is_a_file_a_folder_or_a_split(tmp_path, nested):
    parquet_file, _ = w.write_scenario(tmp_path / "train")
    w.write_scenario(
        tmp_path / "val", name="b", table={**w.columns(), "scenario_id": None} | other()
    )
    places = {"": parquet_file, "scenario": parquet_file.parent, "split": tmp_path}
    names = [recording.name for recording in read(places[nested])]
    assert names == ([w.SCENARIO, "b"] if nested == "split" else [w.SCENARIO])


def other():
    count = len(w.columns()["timestep"])
    return {"scenario_id": ["b"] * count}


def test_columns_that_may_be_missing(tmp_path):
    table = w.columns()
    for name in ("slice_id", "map_id", "city", "focal_track_id", "observed"):
        del table[name]
    assert only(w.write_scenario(tmp_path, table=table)[0]).group == w.SCENARIO


def test_test_split_has_the_observed_part_only(tmp_path):
    table = w.columns()
    keep = [row for row, step in enumerate(table["timestep"]) if step < w.OBSERVED]
    table = {key: [values[row] for row in keep] for key, values in table.items()}
    recording = only(w.write_scenario(tmp_path, table=table)[0])
    assert max(track.t[-1] for track in recording.tracks) == pytest.approx(4.9)


def test_other_types_of_the_same_columns(tmp_path):
    """Categories, float32 positions and whole-number ids are read alike."""
    table = w.columns()
    digits = [0 if name == "AV" else int(name) for name in table["track_id"]]
    arrays = {name: pa.array(values) for name, values in table.items()}
    arrays["track_id"] = pa.array(digits, pa.int32())
    arrays["object_type"] = arrays["object_type"].dictionary_encode()
    arrays["scenario_id"] = arrays["scenario_id"].cast(pa.large_string())
    arrays["heading"] = arrays["heading"].cast(pa.float32())
    path, _ = w.write_scenario(tmp_path)
    pq.write_table(pa.table(arrays), path, row_group_size=100, compression="zstd")
    tracks = {track.id: track for track in only(path).tracks}
    assert tracks["0"].kind == Kind.VEHICLE
    assert tracks["139408"].kind == Kind.CYCLIST
    assert tracks[w.FOCAL].t.size == w.NUM_STEPS


def test_far_coordinates_get_a_local_origin(tmp_path):
    table, lanes = w.columns(), w.vector_map()
    table["position_x"] = [x + 60_000.0 for x in table["position_x"]]
    for lane in lanes["lane_segments"].values():
        for side in ("left", "right"):
            for point in lane[f"{side}_lane_boundary"]:
                point["x"] += 60_000.0
    recording = only(w.write_scenario(tmp_path, table=table, lanes=lanes)[0])
    assert "local origin at x = 60000 m, y = 1000 m" in recording.notes
    moved = {track.id: track for track in recording.tracks}
    np.testing.assert_allclose(moved["AV"].x, w.EAST + 1.5 * w.WIDTH, atol=1e-6)
    np.testing.assert_allclose(moved["AV"].y[0], w.NORTH - 1000.0, atol=1e-6)
    np.testing.assert_allclose(
        recording.lanes[0].centre[:, 0], w.EAST + w.WIDTH / 2, atol=0.01
    )


def test_wild_fragments_are_left_out_and_other_tracks_refused(tmp_path):
    table = w.columns()
    row = table["track_id"].index("138902")
    table["velocity_x"][row] = 300.0
    recording = only(w.write_scenario(tmp_path, table=table)[0])
    assert "138902" not in {track.id for track in recording.tracks}
    assert any("1 track fragments of impossible" in note for note in recording.notes)
    assert "track AV: speed: 300" in message(
        changed(tmp_path / "b", "velocity_x", 300.0)
    )


def test_up_to_a_tenth_of_the_tracks_may_be_too_fast(tmp_path):
    """One state of one track in twelve; sizes of the source TOML are no outliers."""
    table = w.columns()
    rows = [row for row, name in enumerate(table["track_id"]) if name == "AV"]
    for copy in range(12):
        for key, values in table.items():
            values += [f"c{copy}" if key == "track_id" else values[r] for r in rows]
    table["velocity_x"][-5] = 95.0
    path = w.write_scenario(tmp_path, table=table)[0]
    recording = only(path)
    names = {track.id for track in recording.tracks}
    assert "c10" in names
    assert "c11" not in names
    note = "1 tracks with an impossible size or speed left out"
    assert note in recording.notes
    source = spec(tmp_path, "bus = [", "bus = [1")
    assert "length: 11" in message(path, source)


def test_stamps_that_are_not_10_hz_are_noted(tmp_path):
    table = w.columns()
    table["end_timestamp"] = [w.START_NS + 4.9e9] * len(table["timestep"])
    recording = only(w.write_scenario(tmp_path, table=table)[0])
    assert any("0.1 s assumed" in note for note in recording.notes)
    assert recording.tracks[0].t[-1] > 5.0


@pytest.mark.parametrize(
    ("column", "value", "field"),
    [
        (
            "position_x",
            float("nan"),
            "row 4: position_x: 'nan': expected a finite number",
        ),
        (
            "position_y",
            float("inf"),
            "row 4: position_y: 'inf': expected a finite number",
        ),
        ("heading", None, "row 4: heading: '': expected a finite number"),
        ("track_id", None, "row 4: track_id: '': expected a text"),
        ("position_x", 1e12, "position_x: 1e+12"),
        ("velocity_y", -1e300, "velocity_y: -1e+300"),
        ("timestep", 110, "row 3: timestep: 110: expected a whole number from 0"),
        ("timestep", -1, "row 3: timestep: -1"),
        ("timestep", 2, "t: 2: met twice"),
        ("timestep", 0, "goes backwards"),
        ("object_category", 7, "row 3: object_category: 7: expected 0 to 3"),
        ("scenario_id", "x", "scenario_id: "),
        ("scenario_id", "x" * 999, "expected up to 64 characters"),
        ("slice_id", "x", "slice_id: "),
    ],
)
def test_bad_cells(tmp_path, column, value, field):
    path = changed(tmp_path, column, value)
    text = message(path)
    assert text.startswith(str(path))
    assert field in text
    assert "expected" in text


@pytest.mark.parametrize(
    ("column", "value", "field"),
    [
        ("object_type", "tank", "track 138902: object_type: tank"),
        ("num_timestamps", 0, "num_timestamps: 0"),
        ("num_timestamps", 10**12, "num_timestamps: 1e+12"),
        ("position_x", "left", "row 1: position_x: 'left': expected a finite number"),
        ("timestep", True, "t: 0: met twice"),
        ("heading", [1.0], "column heading: type list"),
        ("heading", {"rad": 1.0}, "column heading: type struct"),
        ("track_id", 1.5, "id 1.5: t: 0 after 109: goes backwards"),
        ("track_id", b"\xff\xfe", "column track_id: type binary: expected text"),
        ("scenario_id", "", "row 1: scenario_id: '': expected a text"),
    ],
)
def test_bad_columns(tmp_path, column, value, field):
    table = w.columns()
    table[column] = [value] * len(table["timestep"])
    path, _ = w.write_scenario(tmp_path, table=table)
    text = message(path)
    assert text.startswith(str(path))
    assert field in text


@pytest.mark.parametrize("column", [*w.columns()][1:14])
def test_missing_columns(tmp_path, column):
    table = w.columns()
    del table[column]
    path, _ = w.write_scenario(tmp_path, table=table)
    assert f"column {column}: missing" in message(path)


def test_column_met_twice(tmp_path):
    path, _ = w.write_scenario(tmp_path)
    table = pq.read_table(path)
    pq.write_table(table.append_column("heading", table["heading"]), path)
    assert "column heading: met twice" in message(path)


def test_no_rows(tmp_path):
    table = {key: values[:0] for key, values in w.columns().items()}
    path, _ = w.write_scenario(tmp_path)
    w.write_parquet(path, table)
    assert "rows: none" in message(path)


def test_sizes_are_limited_before_reading(tmp_path, monkeypatch):
    path, _ = w.write_scenario(tmp_path)
    monkeypatch.setattr(table, "MAX_ROWS", 500)
    assert "rows: more than 500: expected fewer" in message(path)
    monkeypatch.undo()
    monkeypatch.setattr(columnar, "MAX_GROUP_BYTES", 5000)
    assert "bytes: expected at most 5000" in message(path)
    monkeypatch.undo()
    monkeypatch.setattr(table, "MAX_BYTES", 5000)
    assert "size: " in message(path)
    monkeypatch.undo()
    monkeypatch.setattr(columnar, "MAX_COLUMNS", 5)
    assert "columns: 18" in message(path)


def test_bytes_of_texts_are_limited(tmp_path, monkeypatch):
    path, _ = w.write_scenario(tmp_path)
    rows, longest = pq.read_table(path).num_rows, len(w.columns()["scenario_id"][0])
    size = max(4 * rows * longest, path.stat().st_size)
    monkeypatch.setattr(table, "MAX_BYTES", size)
    only(path)
    monkeypatch.setattr(table, "MAX_BYTES", size - 1)
    line = message(path)
    assert (
        f"scenario_id: {rows} rows of texts up to {longest}" in line or "size: " in line
    )


def test_a_small_file_of_many_rows(tmp_path, monkeypatch):
    """A million equal cells take 5 kB on disk."""
    path, _ = w.write_scenario(tmp_path)
    cells = pa.array(np.zeros(1_000_000, np.int8))
    names = (*argoverse2.NUMBERS, *argoverse2.TEXT)
    pq.write_table(pa.table(dict.fromkeys(names, cells)), path)
    assert path.stat().st_size < 100_000
    monkeypatch.setattr(table, "MAX_ROWS", 500_000)
    assert "rows: more than 500000: expected fewer" in message(path)


def test_a_long_text_in_every_row_exists_once(tmp_path):
    """100 MB when written out, refused without that."""
    table = w.columns()
    table["track_id"] = ["x" * 100_000] * len(table["timestep"])
    assert "expected up to 64 characters" in message(
        w.write_scenario(tmp_path, table=table)[0]
    )


def truncations(data):
    return [data[:0], data[:3], data[: len(data) // 2], data[:-1], data[:-200]]


def garbled(data):
    rng = np.random.default_rng(0)
    for start in np.linspace(0, len(data) - 64, 40).astype(int):
        noise = rng.integers(0, 256, 64, np.uint8).tobytes()
        yield data[:start] + noise + data[start + 64 :]


def test_truncated_parquet(tmp_path):
    path, _ = w.write_scenario(tmp_path)
    for data in truncations(path.read_bytes()):
        path.write_bytes(data)
        assert message(path).startswith(str(path))


def test_garbled_parquet(tmp_path):
    """Seen, or in a part that is not read."""
    path, _ = w.write_scenario(tmp_path)
    whole, errors = repr(only(path)), []
    for data in garbled(path.read_bytes()):
        path.write_bytes(data)
        try:
            assert repr(only(path)) == whole
        except InputError as error:
            errors.append(str(error))
    assert all(error.startswith(str(path)) for error in errors)
    assert len(errors) > 20


def test_a_missing_package_is_one_line(tmp_path, monkeypatch):
    path = w.write(tmp_path).input
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert "pyarrow: not installed" in message(path)
    assert "rcirl-jax[logs]" in message(path)


def test_no_parquet_at_all(tmp_path):
    path, map_file = w.write_scenario(tmp_path)
    assert "expected Parquet" in message(map_file)
    path.write_text("a,b\n1,2\n")
    assert "expected Parquet" in message(path)
    path.unlink()
    assert "no file matches" in message(tmp_path)


def test_truncated_map_and_no_map(tmp_path):
    path, map_file = w.write_scenario(tmp_path)
    for data in truncations(map_file.read_bytes()):
        map_file.write_bytes(data)
        text = message(path)
        assert text.startswith(str(map_file))
        assert "expected JSON" in text
    map_file.write_bytes(b"\xff\xfe\x00" * 100)
    assert "expected JSON" in message(path)
    map_file.write_text("[" * 200_000)
    assert "expected JSON" in message(path)
    map_file.unlink()
    assert f"expected {map_file.name} beside it" in message(path)


def broken_map(change):
    lanes = w.vector_map()
    change(lanes)
    return lanes


def put(field, value, key="205119002"):
    def change(lanes):
        lanes["lane_segments"][key][field] = value

    return change


POINT = {"x": 1.0, "y": 2.0, "z": 3.0}


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda m: m.pop("lane_segments"), "lane_segments: NoneType"),
        (lambda m: m.update(lane_segments=[]), "lane_segments: list"),
        (lambda m: m.update(lane_segments={}), "lane_segments: 0, none of type"),
        (lambda m: m["lane_segments"].update(a=3), "lane segment a: int"),
        (put("lane_type", "RAIL"), "lane segment 205119002: lane_type: RAIL"),
        (put("lane_type", ["VEHICLE"]), "lane_type: ['VEHICLE']"),
        (put("id", "7"), "id: 7: expected a whole number"),
        (put("id", True), "id: True"),
        (put("id", 205119001), "lane segment 205119002: id: 205119001: met twice"),
        (put("successors", None), "successors: None"),
        (put("successors", ["a"]), "successors: a"),
        (put("left_neighbor_id", 1.5), "left_neighbor_id: 1.5"),
        (put("left_lane_boundary", None), "left_lane_boundary: None"),
        (put("left_lane_boundary", 7), "left_lane_boundary"),
        (put("left_lane_boundary", [POINT]), "two or more points"),
        (put("left_lane_boundary", [POINT, {"x": 1.0}]), "left_lane_boundary: 'y'"),
        (put("left_lane_boundary", [POINT, [1.0, 2.0]]), "left_lane_boundary"),
        (put("left_lane_boundary", [POINT, {"x": "1", "y": "2"}]), "numbers x and y"),
        (put("left_lane_boundary", [POINT, {"x": None, "y": 2}]), "numbers x and y"),
        (put("left_lane_boundary", [POINT, {"x": [1], "y": 2}]), "left_lane_boundary"),
        (put("left_lane_boundary", [POINT, {"x": 10**400, "y": 2}]), "numbers x and y"),
        (put("left_lane_boundary", [POINT, {"x": 1e300, "y": 2}]), "x: 1e+300"),
        (
            put("right_lane_boundary", [POINT, {"x": float("nan"), "y": 2}]),
            "right_lane_boundary: x: nan at point 1",
        ),
    ],
)
def test_bad_maps(tmp_path, change, field):
    lanes = broken_map(change)
    path, map_file = w.write_scenario(tmp_path, lanes=lanes)
    text = message(path)
    assert text.startswith(str(map_file))
    assert field in text
    assert "expected" in text


def test_lane_without_length_is_left_out(tmp_path):
    lanes = broken_map(put("left_lane_boundary", [POINT, POINT]))
    lanes["lane_segments"]["205119002"]["right_lane_boundary"] = [POINT, POINT]
    recording = only(w.write_scenario(tmp_path, lanes=lanes)[0])
    assert any("1 lanes without length" in note for note in recording.notes)


def test_scenario_id_does_not_lead_out_of_the_folder(tmp_path):
    table = w.columns()
    table["scenario_id"] = ["/../../secret"] * len(table["timestep"])
    path, map_file = w.write_scenario(tmp_path, table=table)
    assert only(path).name == "/../../secret"
    map_file.unlink()
    assert "map: missing" in message(path)


def test_bad_source(tmp_path):
    path = w.write(tmp_path).input
    source = spec(tmp_path, "bus = [12.0, 2.6]", 'bus = "long"')
    assert "sizes.bus: long" in message(path, source)
    source = spec(tmp_path, "bus = [12.0, 2.6]", "bus = [12.0]")
    assert "sizes.bus: [12.0]" in message(path, source)
    source = spec(tmp_path, "bus = [12.0, 2.6]", "")
    assert "sizes.bus: None" in message(path, source)
    source = spec(tmp_path, 'bus = "vehicle"', 'bus = "boat"')
    assert "kinds.bus: boat" in message(path, source)
    source = spec(tmp_path, "speed_limit = 15.65", 'speed_limit = "fast"')
    assert "speed_limit: fast" in message(path, source)
    source = spec(tmp_path, '["VEHICLE", "BUS"]', '["TRAM"]')
    assert "lane_types: TRAM" in message(path, source)


@pytest.mark.dataset
def test_recorded_scenario(data_dir):
    folder = data_dir / "formats" / "argoverse2_motion"
    recording = only(folder)
    assert (len(recording.tracks), recording.rate_hz) == (58, 10.0)
    assert sum(track.t.size for track in recording.tracks) == 2434
    tracks = {track.id: track for track in recording.tracks}
    assert tracks["AV"].length == 4.87
    assert tracks["138951"].t.size == 110
    assert len(recording.lanes) == 34
    assert sum(lane.right is not None for lane in recording.lanes) == 7
    for lane in recording.lanes:
        assert 1.0 < np.median(lane.left_width) < 4.0
    away = np.hypot(*(recording.lanes[0].centre - [-436.0, 1350.0]).T)
    assert away.min() < 300.0


@pytest.mark.dataset
def test_recorded_map_without_centre_lines(data_dir, tmp_path):
    """The map of a sensor log has no `centerline`; it is read alike."""
    folder = data_dir / "formats" / "argoverse2_motion"
    (real,) = folder.glob("*PIT*.json")
    path, map_file = w.write_scenario(tmp_path)
    shutil.copy(real, map_file)
    recording = only(path)
    content = json.loads(real.read_text())["lane_segments"].values()
    driven = [lane for lane in content if lane["lane_type"] != "BIKE"]
    assert len(recording.lanes) == len(driven) == 180
