"""L5 prediction data: scenes, semantic map, lights, malformed arrays."""

import functools
import json
import re
import shutil
import struct

import numpy as np
import pytest

from rcirl_jax.data.cut import digest
from rcirl_jax.data.importers import parts, read_recordings
from rcirl_jax.data.importers.l5 import map as l5_map
from rcirl_jax.data.importers.l5 import reader as l5
from rcirl_jax.data.importers.l5 import scenes as l5_scenes
from rcirl_jax.data.readers import zarr2
from rcirl_jax.types import Kind
from tests.data.importers.formats import l5 as fixture
from tests.data.importers.formats.waymo import message, varint
from tests.helpers import logs
from tests.helpers.logs import lanes_of, refused, tracks_of

PACKAGED = logs.packaged("l5")
read = functools.partial(logs.read, "l5", rate_hz=10.0)
X, Y = fixture.CENTRE


def map_of(file):
    return l5_map.SemanticMap(file, l5_map.world_to_ecef(file, PACKAGED))


def lanes_around(semantic_map):
    return semantic_map.lanes(*fixture.CENTRE[:, None], np.zeros(2))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The recordings of the fixture."""
    return read(fixture.write(tmp_path_factory.mktemp("l5")).input)


@pytest.fixture
def folder(tmp_path):
    return fixture.write(tmp_path).input


DTYPES = {
    **{"scenes": fixture.SCENE_DTYPE, "frames": fixture.FRAME_DTYPE},
    "agents": fixture.AGENT_DTYPE,
}


@pytest.fixture
def dataset(tmp_path):
    """One scene without a map: (folder, function that rewrites an array)."""
    path = tmp_path / "one.zarr"
    fixture.write_zarr(path, scenes=1)

    def change(name, edit):
        kinds = {n: (np.dtype(d).kind, tuple(*s)) for n, d, *s in DTYPES[name]}
        array = zarr2.StructuredArray(path / name, kinds)
        records = array.read(0, array.size).copy()
        edited = edit(records)
        shutil.rmtree(path / name)
        records = records if edited is None else edited
        fixture.write_array(path / name, records, array.chunk)

    return path, change


# --------------------------------------------------------------------- scenes


def test_scenes_become_recordings(whole):
    first, second = whole
    assert (first.name, second.name) == ("sample-000000", "sample-000001")
    assert first.rate_hz == 10.0
    names = {"ego", "12", "15", "17", "19", "19#2", "23", "27"}
    assert set(tracks_of(first)) == names
    assert "CC BY-NC-SA" in first.licence
    assert any("unknown class" in note for note in first.notes)
    # scenes of one host that follow each other show the same cars
    assert first.group == second.group == "host-a013-from-1572643684"


def test_groups_of_other_hosts_and_days():
    scenes = np.zeros(4, fixture.SCENE_DTYPE)
    scenes["host"] = ["a", "b", "a", "a"]
    scenes["start_time"] = np.array([0, 0, 30, 300]) * 10**9
    scenes["end_time"] = scenes["start_time"] + 25 * 10**9
    expected = ["a-from-0", "b-from-0", "a-from-0", "a-from-300"]
    assert l5_scenes.groups_of(scenes, []) == expected
    # the third scene alone is still one of the drive that began with the first
    assert l5_scenes.groups_of(scenes[2:], [scenes[:1]]) == ["a-from-0", "a-from-300"]


def test_groups_over_datasets(folder):
    """Scenes of one drive in several datasets, also if only one of them is read."""
    scenes = folder / "scenes"
    later = fixture.START_NS + 80 * 10**9
    fixture.write_zarr(scenes / "train.zarr", start=later)
    fixture.write_zarr(scenes / "validate.zarr", start=later, host="host-b")
    found, _ = parts("l5", folder)
    assert [p.name for p in found] == ["sample.zarr", "train.zarr", "validate.zarr"]
    groups = [(one.name, one.group) for one in read_recordings("l5", folder)]
    drive, other = "host-a013-from-1572643684", "host-b-from-1572643764"
    assert groups == [
        *[(f"sample-00000{k}", drive) for k in (0, 1)],
        *[(f"train-00000{k}", drive) for k in (0, 1)],
        *[(f"validate-00000{k}", other) for k in (0, 1)],
    ]
    assert {one.group for one in read(scenes / "train.zarr")} == {drive}
    (scenes / "sample.zarr" / "scenes" / "0").unlink()  # of no use: not looked into
    assert {one.group for one in read(scenes / "train.zarr")} == {
        "host-a013-from-1572643764"
    }


def test_scene_in_two_datasets(folder):
    scenes = folder / "scenes"
    fixture.write_zarr(scenes / "train.zarr", scenes=1)
    line = refused(read_recordings, "l5", folder)
    words = "scene 0: host host-a013, start 1572643684801892606: met twice, also in"
    assert f"train.zarr: {words} sample.zarr: expected once" in line
    assert len(read(folder, pattern="sample.zarr")) == 2
    assert len(read(scenes / "train.zarr")) == 1


@pytest.mark.parametrize("inner", ["", "scenes", "scenes/sample.zarr"])
def test_dataset_is_found(folder, inner):
    assert [len(found.lanes) for found in read(folder / inner)] == [4, 4]


@pytest.mark.parametrize("few", [1, 2, 5])
def test_pieces_make_up_the_dataset(folder, whole, few, monkeypatch):
    monkeypatch.setattr(l5, "PIECE_SCENES", few)
    (dataset,) = l5.parts(folder, PACKAGED)
    specs = l5.pieces(dataset, PACKAGED)
    apart = [one for spec in specs for one in l5.recordings(dataset, spec)]

    def about(found):
        return [(digest(one), one.group, one.progress) for one in found]

    assert about(apart) == about(whole)


def test_a_map_that_changed_is_read_again(folder):
    def governed():
        return {lane.id for lane in read(folder)[0].lanes if lane.signal_ids}

    assert governed() == {"a1"}
    fixture.write_map(folder / "semantic_map" / "semantic_map.pb", controls=())
    assert governed() == set()


def test_reads_only_the_scene_it_is_at(folder):
    """Chunks of later scenes are not touched: the full set has 100s of GB."""
    agents = folder / "scenes" / "sample.zarr" / "agents"
    (agents / "2").unlink()  # of the second scene only
    found = read_recordings("l5", folder)
    assert next(found).name == "sample-000000"
    assert "agents/2: chunk: No such file" in refused(next, found)


# ------------------------------------------------------------------------ map


@pytest.mark.parametrize(
    ("controls", "governing"),
    [
        ((fixture.RED, fixture.GREEN), "gRN1|rED1"),
        ((fixture.LIGHT,), "gRN1|rED1"),
        # the light's other face is for another lane, say an arrow to the left
        ((fixture.LIGHT, fixture.GREEN), "gRN1"),
        ((fixture.RED, fixture.LIGHT), "rED1"),
    ],
)
def test_a_lane_that_names_faces_has_only_those_of_its_light(
    controls, governing, tmp_path
):
    made = fixture.write_map(tmp_path / "m.pb", controls)
    by_name = {lane.id: lane.signal_ids for lane in lanes_around(map_of(made))}
    assert by_name["a1"] == (governing,)
    assert by_name["a2"] == ()


EDGE = [[X + 60, Y + 1.75], [X + 60, Y - 1.75]]  # of the junction


def test_lanes_of_the_semantic_map(whole):
    lanes = lanes_of(whole[0])
    assert set(lanes) == {"a1", "a2", "b1", "c1"}  # not the stub
    # a2 is drawn against the traffic, and turned round: x grows
    for name, y in (("a1", Y), ("a2", Y + 3.5)):
        ends = lanes[name].centre[[0, -1]]
        np.testing.assert_allclose(ends, [[X - 60, y], [X + 60, y]], atol=0.03)
    np.testing.assert_allclose(lanes["a1"].left_width, 1.75, atol=0.02)
    assert (lanes["a1"].left, lanes["a2"].right) == ("a2", "a1")
    assert lanes["a1"].successors == ("b1", "c1")
    assert lanes["a1"].speed_limit == pytest.approx(11.176, abs=1e-5)
    assert lanes["b1"].speed_limit is None
    np.testing.assert_allclose(lanes["a1"].stop_line, EDGE, atol=0.03)
    assert lanes["c1"].stop_line is None


def test_the_line_of_a_lane_inside_a_junction_is_at_its_start(tmp_path):
    """Whoever is on it was held at the junction's edge."""
    made = fixture.write_map(tmp_path / "m.pb", controls=(), inside=(fixture.RED,))
    lanes = {lane.id: lane for lane in lanes_around(map_of(made))}
    np.testing.assert_allclose(lanes["c1"].stop_line, EDGE, atol=0.03)
    assert lanes["c1"].signal_ids == (fixture.RED,)
    assert lanes["a1"].stop_line is None


def test_light_of_a_lane(whole):
    (signal,) = whole[0].signals
    (lane,) = [lane for lane in whole[0].lanes if lane.signal_ids]
    assert lane.signal_ids == (signal.id,)
    assert (signal.state, signal.is_recorded) == (("red", "green"), True)
    green = fixture.STAMPS[fixture.GREEN_FROM]
    np.testing.assert_allclose(signal.start, [0.0, green], atol=1e-6)


def test_light_unseen_for_a_second_is_off(tmp_path):
    semantic_map = map_of(fixture.write_map(tmp_path / "m.pb"))
    seen = l5_map.LightFaces(
        t=0.1 * np.arange(40),
        frame=np.array([3, 4, 30]),
        face=np.array([fixture.RED, fixture.RED, fixture.GREEN]),
        is_active=np.ones(3, bool),
    )
    (signal,) = semantic_map.signals(lanes_around(semantic_map), seen)
    assert signal.state == ("off", "red", "off", "green")
    np.testing.assert_allclose(signal.start, [0.0, 0.3, 1.5, 3.0])


def test_without_a_map_of_the_place_lanes_are_paths(dataset):
    (recording,) = read(dataset[0].parent)
    assert recording.signals == ()
    assert recording.lanes[0].id == "path-0"
    assert any("fitted to the longest paths" in note for note in recording.notes)
    matrix = fixture.WORLD_TO_ECEF.copy()
    matrix[:3, 3] += 1e5
    beside = dataset[0].with_name("meta.json")
    beside.write_text(json.dumps({"pose_to_ecef": matrix.tolist()}))
    fixture.write_map(beside.with_name("semantic_map.pb"))
    assert read(dataset[0].parent)[0].lanes[0].id == "path-0"


def test_map_named_in_the_source(dataset):
    fixture.write_map(dataset[0].parent / "other" / "palo.pb")
    assert len(read(dataset[0].parent, map="other/palo.pb")[0].lanes) == 4
    line = refused(read, dataset[0].parent, map="gone.pb")
    assert "source TOML: map: gone.pb: expected" in line


def test_format_version_1_has_no_lights(folder):
    shutil.rmtree(folder / "scenes" / "sample.zarr" / "traffic_light_faces")
    recording = read(folder)[0]
    assert recording.signals == ()
    assert "no traffic lights recorded" in recording.notes


# ------------------------------------------------------------------- contents


def test_older_number_types(dataset):
    """Early releases had float32 positions and int32 ids."""
    path, change = dataset
    older = {"<f8": "<f4", "<u8": "<i4"}

    def narrow(records):
        kinds = [(n, np.dtype(d).str, *s) for n, d, *s in fixture.AGENT_DTYPE]
        kinds = [(name, older.get(kind, kind), *s) for name, kind, *s in kinds]
        out = np.zeros(records.size, kinds)
        for name in out.dtype.names:
            out[name] = records[name]
        return out

    change("agents", narrow)
    found, expected = tracks_of(read(path)[0])["12"], fixture.road_users()["12"]
    np.testing.assert_allclose(found.x, expected.x, atol=1e-3)


def test_far_world_gets_a_local_origin(dataset):
    path, change = dataset

    def move(name):
        def edit(records):
            records[name][:, :2] += [500000.0, 4140000.0]

        return edit

    change("agents", move("centroid"))
    change("frames", move("ego_translation"))
    (recording,) = read(path)
    assert any("local origin" in note for note in recording.notes)
    assert abs(tracks_of(recording)["ego"].x[0]) < 1000.0


def test_options(folder):
    assert read(folder, min_probability=1.1, unknown="drop")[0].tracks[-1].id == "ego"
    size = {"length": 5.0, "width": 2.0, "centre_ahead": 1.2}
    recording = read(folder, ego=size, speed_limit=9.0)[0]
    ego = tracks_of(recording)["ego"]
    assert (ego.length, ego.width) == (5.0, 2.0)
    assert ego.x[0] == pytest.approx(fixture.CENTRE[0] + 1.2)
    assert recording.default_speed_limit == 9.0
    assert not ego.is_human(0.0, 1.0)
    human = read(folder, recording_car="human")[0]
    assert tracks_of(human)["ego"].is_human(0.0, 1.0)
    tracks = read(folder, unknown="vehicle")[0].tracks
    assert [track.kind for track in tracks if track.id == "99"] == [Kind.VEHICLE]
    bad = {"recording_car": "x", "ego": 3, "unknown": "x", "rate_hz": 0}
    for name, value in {**bad, "min_probability": "x"}.items():
        assert f"source TOML: {name}" in refused(read, folder, **{name: value})


def test_a_few_outliers_are_left_out(dataset):
    """One box of 90 m among many tracks is the tracker's mistake, not the file's."""
    path, change = dataset

    def add(records):
        many = np.tile(records[records["track_id"] == 12][:1], 20)
        many["track_id"] = np.arange(200, 220)
        many["extent"][0, 0] = 90.0
        return np.concatenate([many, records])

    def shift(records):
        records["agent_index_interval"] += 20
        records["agent_index_interval"][0, 0] = 0

    change("agents", add)
    change("frames", shift)
    (recording,) = read(path)
    assert any("1 tracks with an impossible size" in note for note in recording.notes)
    assert "200" not in tracks_of(recording)


# ------------------------------------------------------------------ malformed


def put(name, value, row=5):
    def edit(records):
        records[name][row] = value

    return edit


def put_character(name, point):
    """The first character of a text of the first record."""

    def edit(records):
        start = records.dtype.fields[name][1]
        character = np.frombuffer(np.uint32(point).tobytes(), np.uint8)
        records.view(np.uint8)[start : start + 4] = character

    return edit


def in_microseconds(records):
    records["timestamp"] //= 1000


NAN, INF, FRAMES = float("nan"), float("inf"), "frame_index_interval"
BAD_VALUES = [
    ("agents", put("centroid", NAN), r"centroid: x: nan"),
    ("agents", put("centroid", 1e300), r"centroid: x: 1e\+300"),
    ("agents", put("extent", INF), r"length: inf"),
    ("agents", put("extent", -1.0), r"length: -1 m: expected 0 to"),
    ("agents", put("extent", 1e6), r"length: 1e\+06 m: expected 0 to"),
    ("agents", put("yaw", NAN), r"heading: nan: expected a finite"),
    ("agents", put("velocity", 1e4, slice(0, 3)), r"speed: 14142"),
    ("agents", put("label_probabilities", NAN), r"label_probabilities"),
    ("agents", put("track_id", 15, 0), r"met twice"),
    ("frames", put("ego_translation", NAN), r"ego_translation: x: nan"),
    ("frames", put("ego_rotation", 0.0), r"ego_rotation: .*rotation matrix"),
    ("frames", put("ego_rotation", NAN), r"ego_rotation: .*rotation matrix"),
    ("frames", put("timestamp", 0), r"id 0: t: .*goes backwards"),
    ("frames", in_microseconds, r"timestamp: median step .*: expected 0\.1 s"),
    ("frames", put("agent_index_interval", [-1, 9]), r"interval within 0"),
    ("frames", put("agent_index_interval", [9, 1]), r"interval within 0"),
    ("frames", put("agent_index_interval", [0, 10**15]), r"interval within"),
    ("scenes", put_character("host", 2**31), r"host: characters that are none"),
    ("scenes", put_character("host", 0xDCFF), r"host: characters that are none"),
    ("scenes", put(FRAMES, [0, 0], 0), r"expected frames"),
    ("scenes", put(FRAMES, [0, 999], 0), r"interval within"),
    ("scenes", put(FRAMES, [-(2**63), 2**63 - 1], 0), r"int"),
]


@pytest.mark.parametrize(("array", "edit", "words"), BAD_VALUES)
def test_absurd_values(dataset, array, edit, words):
    path, change = dataset
    change(array, edit)
    line = refused(read, path)
    assert re.search(words, line)
    assert str(path) in line


BAD_METADATA = [
    ({"zarr_format": 3}, "zarr_format: 3: expected 2"),
    ({"shape": [10**12]}, "shape: .*: expected one size"),
    *[({"shape": bad}, "shape") for bad in ([-1], [2, 3], [True], "x")],
    ({"chunks": [0]}, "chunks: 0 records"),
    ({"chunks": [10**9]}, "chunks: 1000000000 records: expected 1 to"),
    ({"dtype": "<f8"}, "dtype: <f8: expected a list"),
    ({"dtype": [["x", "|O"]]}, "dtype"),
    ({"filters": [{"id": "pickle"}]}, "filters: .*pickle.*: expected none"),
    ({"compressor": {"id": "zlib"}}, "compressor: .*: expected blosc"),
    ({"compressor": 7}, "compressor: 7: expected blosc"),
    (["centroid", "|O"], r"dtype: \['centroid', '\|O'\]"),
    (["centroid", "<f8", [3]], r"dtype: centroid: .*expected shape"),
    (["centroid", "<i8", [2]], r"dtype: centroid: .*kind f"),
    (["centroid", ">f8", [2]], r"dtype: .*little-endian"),
    (["centroid", "<f8", [2**40]], r"dtype"),
    (["middle", "<f8", [2]], r"dtype: centroid: missing"),
    (["yaw", "<f8", [2]], r"dtype: .*: expected different names"),
    ("x", r"dtype"),
    (["centroid", "<f8", [2], 1], r"dtype"),
]


@pytest.mark.parametrize(("change", "words"), BAD_METADATA)
def test_malformed_metadata(dataset, change, words):
    """Other fields, or another first field of a record."""
    file = dataset[0] / "agents" / ".zarray"
    found = json.loads(file.read_text())
    if isinstance(change, dict):
        found.update(change)
    else:
        found["dtype"][0] = change
    file.write_text(json.dumps(found))
    assert re.search(rf"\.zarray: {words}", refused(read, dataset[0]))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        *[(bad, "json") for bad in (b"", b"[" * 100000, b"\xff\xfe")],
        (b"[1]", "json: list: expected an object"),
        (b" " * 2**21, "size: 2097152 bytes: expected at most"),
    ],
)
def test_malformed_json(dataset, content, words):
    (dataset[0] / "frames" / ".zarray").write_bytes(content)
    assert words in refused(read, dataset[0])


@pytest.mark.parametrize(
    ("place", "content", "words"),
    [
        # blosc's own size is compared with the metadata before it is unpacked
        (4, struct.pack("<I", 2**31 - 1), "0: chunk: 2147483647 bytes decompressed"),
        (16, b"\xff" * 184, ": records 0 to "),
    ],
)
def test_damaged_chunk(dataset, place, content, words):
    chunk = dataset[0] / "agents" / "0"
    changed = bytearray(chunk.read_bytes())
    changed[place : place + len(content)] = content
    chunk.write_bytes(changed)
    line = refused(read, dataset[0])
    assert "agents" in line
    assert words in line
    assert "expected" in line


def test_limits(folder, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(l5_map, "MAX_MAP_BYTES", 500)
        assert re.search(r"\.pb: size: \d+ bytes: .* 500", refused(read, folder))
    monkeypatch.setattr(zarr2, "MAX_READ_BYTES", 1000)
    line = refused(read, folder)
    assert re.search(r"frames: records 0 to 100: .*at most 1000", line)


def test_folder_without_data(tmp_path):
    assert "no scenes/.zarray and no folder *.zarr" in refused(read, tmp_path)
    (tmp_path / "a.zarr").mkdir()
    assert "frames/.zarray: No such file" in refused(read, tmp_path)


@pytest.mark.parametrize(
    "content",
    ["x", [[1.0]], [[0.0] * 4] * 4, [[1.0, {}]], [[10**400] * 4] * 4],
)
def test_malformed_meta(folder, content):
    (folder / "meta.json").write_text(json.dumps({"world_to_ecef": content}))
    line = refused(read, folder)
    assert "meta.json: world_to_ecef: " in line
    assert "expected a rigid" in line


def element(kind, body):
    return message([(2, [(1, [(1, b"x")]), (2, [(kind, body)])])])


BAD_MAPS = [
    b"",
    b"\x12" + b"\xff" * 30,  # a varint without end
    message([(2, 5)]),  # a number instead of an element
    element(3, b"\xff"),
    element(3, [(2, [(2, 1)]), (3, [(1, b"\x02")]), (4, b"")]),  # 1 x, no y
    element(1, varint(9 << 3 | 1) + bytes(8)),
    # a frame at 200 degrees north
    element(3, [(2, [(1, fixture.fixed32(1, 2 * 10**9))]), (3, b""), (4, b"")]),
]


@pytest.mark.parametrize("content", BAD_MAPS)
def test_malformed_map(folder, content):
    (folder / "semantic_map" / "semantic_map.pb").write_bytes(content)
    assert re.search(r"semantic_map\.pb: .*expected", refused(read, folder))
