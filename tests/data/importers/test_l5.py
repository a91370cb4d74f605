"""L5 prediction data: scenes, semantic map, lights, malformed arrays."""

import json
import shutil
import struct

import numpy as np
import pytest

from rcirl_jax.data.cut import digest
from rcirl_jax.data.importers import parts, read_recordings
from rcirl_jax.data.importers.l5 import map as l5_map
from rcirl_jax.data.importers.l5 import reader as l5
from rcirl_jax.data.importers.l5 import scenes as l5_scenes
from rcirl_jax.data.importers.l5.messages import read_message
from rcirl_jax.data.readers import zarr2
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.specs import load_toml, spec_root
from rcirl_jax.types import Kind
from tests.data.importers.formats import l5 as fixture
from tests.data.importers.formats.waymo import Packed, message, varint


def packaged():
    return load_toml(spec_root() / "sources" / "l5.toml")


def read(path, **options):
    return list(l5.recordings(path, {**packaged(), **options}))


def map_of(file):
    return l5_map.SemanticMap(file, l5_map.world_to_ecef(file, packaged()))


def lanes_around(semantic_map):
    return semantic_map.lanes(*fixture.CENTRE[:, None], np.zeros(2))


def track(recording, name):
    return next(found for found in recording.tracks if found.id == name)


@pytest.fixture
def folder(tmp_path):
    return fixture.write(tmp_path).input


@pytest.fixture
def dataset(tmp_path):
    """One scene without a map: (folder, function that rewrites an array)."""
    path = tmp_path / "one.zarr"
    fixture.write_zarr(path, scenes=1)

    def change(name, edit):
        file = path / name / ".zarray"
        dtype = {
            "scenes": fixture.SCENE_DTYPE,
            "frames": fixture.FRAME_DTYPE,
            "agents": fixture.AGENT_DTYPE,
            "traffic_light_faces": fixture.TL_FACE_DTYPE,
        }[name]
        kinds = {n: (np.dtype(d).kind, tuple(*s)) for n, d, *s in dtype}
        array = zarr2.StructuredArray(path / name, kinds)
        records = array.read(0, array.size).copy()
        edited = edit(records)
        records = records if edited is None else edited
        shutil.rmtree(file.parent)
        fixture.write_array(path / name, records, array.chunk)

    return path, change


# ---------------------------------------------------------------- well-formed


def test_scenes_become_recordings(folder):
    first, second = read(folder)
    assert (first.name, second.name) == ("sample-000000", "sample-000001")
    assert first.rate_hz == 10.0
    assert {t.id for t in first.tracks} == {
        *("ego", "12", "15", "17", "19", "19#2", "23", "27")
    }
    assert "CC BY-NC-SA" in first.licence
    assert any("unknown class" in note for note in first.notes)
    # scenes of one host that follow each other show the same cars
    assert first.group == second.group == "host-a013-from-1572643684"


def test_groups_of_other_hosts_and_days():
    scenes = np.zeros(4, fixture.SCENE_DTYPE)
    scenes["host"] = ["a", "b", "a", "a"]
    scenes["start_time"] = np.array([0, 0, 30, 300]) * 10**9
    scenes["end_time"] = scenes["start_time"] + 25 * 10**9
    assert l5_scenes.groups_of(scenes, []) == [
        *("a-from-0", "b-from-0", "a-from-0", "a-from-300")
    ]
    # the third scene alone is still one of the drive that began with the first
    assert l5_scenes.groups_of(scenes[2:], [scenes[:1]]) == ["a-from-0", "a-from-300"]


def test_groups_over_datasets(folder):
    """Scenes of one drive in several datasets, also if only one of them is read."""
    scenes = folder / "scenes"
    later = fixture.START_NS + 80 * 10**9
    fixture.write_zarr(scenes / "train.zarr", start=later)
    fixture.write_zarr(scenes / "validate.zarr", start=later, host="host-b")
    groups = {one.name: one.group for one in read_recordings("l5", folder)}
    drive = "host-a013-from-1572643684"
    assert groups == {
        **dict.fromkeys(("sample-000000", "sample-000001"), drive),
        **dict.fromkeys(("train-000000", "train-000001"), drive),
        **dict.fromkeys(
            ("validate-000000", "validate-000001"), "host-b-from-1572643764"
        ),
    }
    assert {one.group for one in read(scenes / "train.zarr")} == {drive}
    (scenes / "sample.zarr" / "scenes" / "0").unlink()  # of no use: not looked into
    assert {one.group for one in read(scenes / "train.zarr")} == {
        "host-a013-from-1572643764"
    }


def test_scene_in_two_datasets(folder):
    scenes = folder / "scenes"
    fixture.write_zarr(scenes / "train.zarr", scenes=1)
    with pytest.raises(
        InputError,
        match=r"train\.zarr: scene 0: host host-a013, start 1572643684801892606: met "
        r"twice, also in sample\.zarr: expected once",
    ):
        read_recordings("l5", folder)
    assert len(read(folder, pattern="sample.zarr")) == 2
    assert len(read(scenes / "train.zarr")) == 1


@pytest.mark.parametrize("inner", ["", "scenes", "scenes/sample.zarr"])
def test_dataset_is_found(folder, inner):
    assert len(read(folder / inner)) == 2
    assert len(read(folder / inner)[0].lanes) == 4


def test_parts_are_datasets(folder):
    fixture.write_zarr(folder / "scenes" / "train.zarr", start=fixture.START_NS + 1)
    found, _ = parts("l5", folder)
    assert [part.name for part in found] == ["sample.zarr", "train.zarr"]
    names = [recording.name for recording in read_recordings("l5", folder)]
    assert names == ["sample-000000", "sample-000001", "train-000000", "train-000001"]


@pytest.mark.parametrize("few", [1, 2, 5])
def test_pieces_make_up_the_dataset(folder, few, monkeypatch):
    monkeypatch.setattr(l5, "PIECE_SCENES", few)
    whole, (dataset,) = read(folder), l5.parts(folder, packaged())
    apart = [
        r
        for spec in l5.pieces(dataset, packaged())
        for r in l5.recordings(dataset, spec)
    ]
    assert len(whole) == 2
    assert [digest(r) for r in apart] == [digest(r) for r in whole]
    assert [(r.group, r.progress) for r in apart] == [
        (r.group, r.progress) for r in whole
    ]


def test_a_map_that_changed_is_read_again(folder):
    before = {lane.id for lane in read(folder)[0].lanes if lane.signal_ids}
    fixture.write_map(folder / "semantic_map" / "semantic_map.pb", controls=())
    after = {lane.id for lane in read(folder)[0].lanes if lane.signal_ids}
    assert (before, after) == ({"a1"}, set())


def test_reads_only_the_scene_it_is_at(folder):
    """Chunks of later scenes are not touched: the full set has 100s of GB."""
    agents = folder / "scenes" / "sample.zarr" / "agents"
    (agents / "2").unlink()  # of the second scene only
    found = read_recordings("l5", folder)
    assert next(found).name == "sample-000000"
    with pytest.raises(InputError, match=r"agents/2: chunk: .*: expected a file"):
        next(found)


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


def test_lanes_of_the_semantic_map(folder):
    lanes = {lane.id: lane for lane in read(folder)[0].lanes}
    assert set(lanes) == {"a1", "a2", "b1", "c1"}  # not the stub
    x, y = fixture.CENTRE
    np.testing.assert_allclose(
        lanes["a1"].centre[[0, -1]], [[x - 60, y], [x + 60, y]], atol=0.03
    )
    np.testing.assert_allclose(lanes["a1"].left_width, 1.75, atol=0.02)
    # drawn against the traffic, turned round: x grows
    np.testing.assert_allclose(
        lanes["a2"].centre[[0, -1]], [[x - 60, y + 3.5], [x + 60, y + 3.5]], atol=0.03
    )
    assert (lanes["a1"].left, lanes["a2"].right) == ("a2", "a1")
    assert lanes["a1"].successors == ("b1", "c1")
    assert lanes["a1"].speed_limit == pytest.approx(11.176, abs=1e-5)
    assert lanes["b1"].speed_limit is None
    np.testing.assert_allclose(
        lanes["a1"].stop_line, [[x + 60, y + 1.75], [x + 60, y - 1.75]], atol=0.03
    )
    assert lanes["c1"].stop_line is None


def test_the_line_of_a_lane_inside_a_junction_is_at_its_start(tmp_path):
    """Whoever is on it was held at the junction's edge."""
    made = fixture.write_map(tmp_path / "m.pb", controls=(), inside=(fixture.RED,))
    lanes = {lane.id: lane for lane in lanes_around(map_of(made))}
    x, y = fixture.CENTRE
    np.testing.assert_allclose(
        lanes["c1"].stop_line, [[x + 60, y + 1.75], [x + 60, y - 1.75]], atol=0.03
    )
    assert lanes["c1"].signal_ids == (fixture.RED,)
    assert lanes["a1"].stop_line is None


def test_light_of_a_lane(folder):
    recording = read(folder)[0]
    (signal,) = recording.signals
    lane = next(lane for lane in recording.lanes if lane.signal_ids)
    assert lane.signal_ids == (signal.id,)
    assert signal.state == ("red", "green")
    green = fixture.STAMPS[fixture.GREEN_FROM]
    np.testing.assert_allclose(signal.start, [0.0, green], atol=1e-6)
    assert signal.is_recorded


def test_light_unseen_for_a_second_is_off(tmp_path):
    semantic_map = map_of(fixture.write_map(tmp_path / "m.pb"))
    lanes = lanes_around(semantic_map)
    t = 0.1 * np.arange(40)
    seen = l5_map.LightFaces(
        t=t,
        frame=np.array([3, 4, 30]),
        face=np.array([fixture.RED, fixture.RED, fixture.GREEN]),
        is_active=np.ones(3, bool),
    )
    (signal,) = semantic_map.signals(lanes, seen)
    assert signal.state == ("off", "red", "off", "green")
    np.testing.assert_allclose(signal.start, [0.0, 0.3, 1.5, 3.0])


def test_without_a_map_lanes_are_paths(tmp_path):
    fixture.write_zarr(tmp_path / "sample.zarr", scenes=1)
    (recording,) = read(tmp_path)
    assert recording.signals == ()
    assert recording.lanes[0].id == "path-0"
    assert any("fitted to the longest paths" in note for note in recording.notes)


def test_map_that_is_elsewhere(tmp_path):
    """A map of another place gives no lanes: paths are used."""
    fixture.write_zarr(tmp_path / "sample.zarr", scenes=1)
    matrix = fixture.WORLD_TO_ECEF.copy()
    matrix[:3, 3] += 1e5
    fixture.write_map(tmp_path / "semantic_map.pb")
    (tmp_path / "meta.json").write_text(json.dumps({"pose_to_ecef": matrix.tolist()}))
    assert read(tmp_path)[0].lanes[0].id == "path-0"


def test_map_named_in_the_source(tmp_path):
    fixture.write_zarr(tmp_path / "sample.zarr", scenes=1)
    fixture.write_map(tmp_path / "other" / "palo.pb")
    assert len(read(tmp_path, map="other/palo.pb")[0].lanes) == 4
    with pytest.raises(InputError, match=r"source TOML: map: gone\.pb: expected"):
        read(tmp_path, map="gone.pb")


def test_format_version_1_has_no_lights(folder):
    shutil.rmtree(folder / "scenes" / "sample.zarr" / "traffic_light_faces")
    recording = read(folder)[0]
    assert recording.signals == ()
    assert "no traffic lights recorded" in recording.notes


def test_older_number_types(dataset):
    """Early releases had float32 positions and int32 ids."""
    path, change = dataset

    def narrow(records):
        kinds = [
            (n, {"<f8": "<f4", "<u8": "<i4"}.get(np.dtype(d).str, d), *s)
            for n, d, *s in fixture.AGENT_DTYPE
        ]
        out = np.zeros(records.size, kinds)
        for name in out.dtype.names:
            out[name] = records[name]
        return out

    change("agents", narrow)
    np.testing.assert_allclose(
        track(read(path)[0], "12").x, fixture.road_users()["12"].x, atol=1e-3
    )


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
    assert abs(track(recording, "ego").x[0]) < 1000.0


@pytest.mark.parametrize(
    ("choice", "kind"),
    [
        ("vehicle", Kind.VEHICLE),
        ("static", Kind.STATIC),
        ("auto", Kind.STATIC),
        ("drop", None),
    ],
)
def test_unknown_class(folder, choice, kind):
    bushes = [t for t in read(folder, unknown=choice)[0].tracks if t.id == "99"]
    assert [bush.kind for bush in bushes] == ([] if kind is None else [kind])


def test_options(folder):
    assert read(folder, min_probability=1.1, unknown="drop")[0].tracks[-1].id == "ego"
    recording = read(
        folder, ego={"length": 5.0, "width": 2.0, "centre_ahead": 1.2}, speed_limit=9.0
    )[0]
    ego = track(recording, "ego")
    assert (ego.length, ego.width) == (5.0, 2.0)
    assert ego.x[0] == pytest.approx(fixture.CENTRE[0] + 1.2)
    assert recording.default_speed_limit == 9.0
    assert not ego.is_human(0.0, 1.0)
    assert track(read(folder, recording_car="human")[0], "ego").is_human(0.0, 1.0)
    for bad in (
        {"recording_car": "x"},
        {"ego": 3},
        {"unknown": "x"},
        {"rate_hz": 0},
        {"min_probability": "x"},
    ):
        with pytest.raises(InputError, match="source TOML"):
            read(folder, **bad)


def test_a_few_outliers_are_left_out(dataset):
    """One box of 90 m among many tracks is the tracker's mistake, not the file's."""
    path, change = dataset

    def add(records):
        rows = records[records["track_id"] == 12][:1]
        many = np.tile(rows, 20)
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
    assert not any(t.id == "200" for t in recording.tracks)


# ------------------------------------------------------------------ malformed


def set_field(name, value, row=5):
    def edit(records):
        records[name][row] = value

    return edit


NAN, INF = float("nan"), float("inf")


def set_character(name, point):
    """The first character of a text of the first record."""

    def edit(records):
        start = records.dtype.fields[name][1]
        records.view(np.uint8)[start : start + 4] = np.frombuffer(
            np.uint32(point).tobytes(), np.uint8
        )

    return edit


@pytest.mark.parametrize(
    ("array", "edit", "expected"),
    [
        ("agents", set_field("centroid", NAN), r"centroid: x: nan"),
        ("agents", set_field("centroid", 1e300), r"centroid: x: 1e\+300"),
        ("agents", set_field("extent", INF), r"length: inf"),
        ("agents", set_field("extent", -1.0), r"length: -1 m: expected 0 to"),
        ("agents", set_field("extent", 1e6), r"length: 1e\+06 m: expected 0 to"),
        ("agents", set_field("yaw", NAN), r"heading: nan: expected a finite"),
        ("agents", set_field("velocity", 1e4, row=slice(0, 3)), r"speed: 14142"),
        ("agents", set_field("label_probabilities", NAN), r"label_probabilities"),
        ("agents", set_field("track_id", 15, row=0), r"met twice"),
        ("frames", set_field("ego_translation", NAN), r"ego_translation: x: nan"),
        ("frames", set_field("ego_rotation", 0.0), r"ego_rotation: .*rotation matrix"),
        ("frames", set_field("ego_rotation", NAN), r"ego_rotation: .*rotation matrix"),
        ("frames", set_field("timestamp", 0), r"id 0: t: .*goes backwards"),
        ("frames", set_field("agent_index_interval", [-1, 9]), r"interval within 0"),
        ("frames", set_field("agent_index_interval", [9, 1]), r"interval within 0"),
        ("frames", set_field("agent_index_interval", [0, 10**15]), r"interval within"),
        ("scenes", set_character("host", 2**31), r"host: characters that are none"),
        ("scenes", set_character("host", 0xDCFF), r"host: characters that are none"),
        ("scenes", set_field("frame_index_interval", [0, 0], 0), r"expected frames"),
        ("scenes", set_field("frame_index_interval", [0, 999], 0), r"interval within"),
        ("scenes", set_field("frame_index_interval", [-(2**63), 2**63 - 1], 0), r"int"),
    ],
)
def test_absurd_values(dataset, array, edit, expected):
    path, change = dataset
    change(array, edit)
    with pytest.raises(InputError, match=expected) as error:
        read(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_wrong_unit_of_time(dataset):
    """Microseconds in a field of nanoseconds."""
    path, change = dataset

    def shrink(records):
        records["timestamp"] //= 1000

    change("frames", shrink)
    with pytest.raises(InputError, match=r"timestamp: median step .*: expected 0\.1 s"):
        read(path)


def metadata(**changes):
    def edit(found):
        found.update(changes)

    return edit


def dtype_of(place, value):
    def edit(found):
        found["dtype"][place] = value

    return edit


@pytest.mark.parametrize(
    ("edit", "expected"),
    [
        (metadata(zarr_format=3), "zarr_format: 3: expected 2"),
        (metadata(shape=[10**12]), "shape: .*: expected one size"),
        (metadata(shape=[-1]), "shape"),
        (metadata(shape=[2, 3]), "shape"),
        (metadata(shape=[True]), "shape"),
        (metadata(shape="x"), "shape"),
        (metadata(chunks=[0]), "chunks: 0 records"),
        (metadata(chunks=[10**9]), "chunks: 1000000000 records: expected 1 to"),
        (metadata(dtype="<f8"), "dtype: <f8: expected a list"),
        (metadata(dtype=[["x", "|O"]]), "dtype"),
        (metadata(filters=[{"id": "pickle"}]), "filters: .*pickle.*: expected none"),
        (metadata(compressor={"id": "zlib"}), "compressor: .*: expected blosc"),
        (metadata(compressor=7), "compressor: 7: expected blosc"),
        (dtype_of(0, ["centroid", "|O"]), r"dtype: \['centroid', '\|O'\]"),
        (dtype_of(0, ["centroid", "<f8", [3]]), r"dtype: centroid: .*expected shape"),
        (dtype_of(0, ["centroid", "<i8", [2]]), r"dtype: centroid: .*kind f"),
        (dtype_of(0, ["centroid", ">f8", [2]]), r"dtype: .*little-endian"),
        (dtype_of(0, ["centroid", "<f8", [2**40]]), r"dtype"),
        (dtype_of(0, ["middle", "<f8", [2]]), r"dtype: centroid: missing"),
        (dtype_of(0, ["yaw", "<f8", [2]]), r"dtype: .*: expected different names"),
        (dtype_of(0, "x"), r"dtype"),
        (dtype_of(0, ["centroid", "<f8", [2], 1]), r"dtype"),
    ],
)
def test_malformed_metadata(dataset, edit, expected):
    path, _ = dataset
    file = path / "agents" / ".zarray"
    found = json.loads(file.read_text())
    edit(found)
    file.write_text(json.dumps(found))
    with pytest.raises(InputError, match=expected) as error:
        read(path)
    assert ".zarray: " in str(error.value)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "json"),
        (b"[" * 100000, "json"),
        (b"[1]", "json: list: expected an object"),
        (b"\xff\xfe", "json"),
        (b" " * 2**21, "size: 2097152 bytes: expected at most"),
    ],
)
def test_malformed_json(dataset, content, expected):
    path, _ = dataset
    (path / "frames" / ".zarray").write_bytes(content)
    with pytest.raises(InputError, match=expected):
        read(path)


def test_chunk_that_claims_gigabytes(dataset):
    """Blosc's own size is compared with the metadata before it is unpacked."""
    path, _ = dataset
    chunk = path / "agents" / "0"
    content = bytearray(chunk.read_bytes())
    content[4:8] = struct.pack("<I", 2**31 - 1)
    chunk.write_bytes(content)
    with pytest.raises(
        InputError, match=r"agents/0: chunk: 2147483647 bytes decompressed: expected"
    ):
        read(path)


def test_read_is_limited(dataset, monkeypatch):
    monkeypatch.setattr(zarr2, "MAX_READ_BYTES", 1000)
    with pytest.raises(InputError, match=r"frames: records 0 to 100: .*at most 1000"):
        read(dataset[0])


def test_damaged_chunk(dataset):
    path, _ = dataset
    chunk = path / "agents" / "0"
    content = bytearray(chunk.read_bytes())
    content[16:200] = b"\xff" * 184
    chunk.write_bytes(content)
    with pytest.raises(InputError, match=r"agents: records 0 to .*: expected whole"):
        read(path)


def test_folder_without_data(tmp_path):
    with pytest.raises(InputError, match=r"no scenes/\.zarray and no folder \*\.zarr"):
        read(tmp_path)
    (tmp_path / "a.zarr").mkdir()
    with pytest.raises(InputError, match=r"frames/\.zarray: No such file"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ({"world_to_ecef": "x"}, "world_to_ecef: x: expected a rigid"),
        ({"world_to_ecef": [[1.0]]}, "world_to_ecef"),
        ({"world_to_ecef": [[0.0] * 4] * 4}, "world_to_ecef"),
        ({"world_to_ecef": [[1.0, {}]]}, "world_to_ecef"),
        ({"world_to_ecef": [[10**400] * 4] * 4}, "world_to_ecef"),
    ],
)
def test_malformed_meta(folder, content, expected):
    (folder / "meta.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=rf"meta\.json: {expected}"):
        read(folder)


def element(kind, body):
    return message([(2, [(1, [(1, b"x")]), (2, [(kind, body)])])])


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x12\xff\xff\xff\xff\xff\xff\xff\xff\xff\x01",  # a length beyond the file
        b"\x12" + b"\xff" * 30,  # a varint without end
        b"\x0b",  # a wire type that is none
        message([(2, 5)]),  # a number instead of an element
        element(3, b"\xff"),
        element(3, [(2, [(2, 1)]), (3, [(1, b"\x02")]), (4, b"")]),  # 1 x, no y
        element(3, [(2, varint(2 << 3 | 1) + bytes(8)), (3, b""), (4, b"")]),
        element(1, varint(9 << 3 | 1) + bytes(8)),
        # a frame at 200 degrees north
        element(3, [(2, [(1, fixture.fixed32(1, 2 * 10**9))]), (3, b""), (4, b"")]),
    ],
)
def test_malformed_map(folder, content):
    (folder / "semantic_map" / "semantic_map.pb").write_bytes(content)
    with pytest.raises(InputError, match=r"semantic_map\.pb: .*expected"):
        read(folder)


def test_steps_of_a_bound_of_any_size(tmp_path):
    """Steps are packed and zigzag-coded, of 1 to 5 bytes."""
    steps = np.array([-(2**31), 2**31 - 1, 0, -1, 64, -65, 10_000_000])
    body = message([(1, Packed(fixture.zigzag(step) for step in steps.tolist()))])
    np.testing.assert_array_equal(
        read_message(element(3, [(3, body)])).elements[0].element.lane.left.x, steps
    )


def test_a_map_of_many_bytes_is_refused(folder, monkeypatch):
    monkeypatch.setattr(l5_map, "MAX_MAP_BYTES", 500)
    with pytest.raises(
        InputError, match=r"\.pb: size: \d+ bytes: expected at most 500"
    ):
        read(folder)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "name", ["semantic_map/semantic_map.pb", "scenes/sample.zarr/agents/.zarray"]
)
def test_flipped_bytes_are_one_line(folder, name, seed):
    file = folder / name
    content = file.read_bytes()
    rng = np.random.default_rng(seed)
    for _ in range(25):
        damaged = bytearray(content)
        for place in rng.integers(0, len(content), 4):
            damaged[place] = rng.integers(0, 256)
        file.write_bytes(damaged)
        try:
            next(l5.recordings(folder, packaged()))
        except InputError as error:
            line = str(error)
            assert "\n" not in line
