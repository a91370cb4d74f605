"""L5 prediction data: scenes, semantic map, lights, malformed arrays."""

import functools
import shutil

import numpy as np
import pytest

from rcirl_jax.data.formats import l5, parts, read_recordings
from rcirl_jax.data.importing import digest
from tests.data.formats.fixtures import l5 as fixture
from tests.helpers import logs
from tests.helpers.logs import lanes_of, refused

PACKAGED = logs.packaged("l5")
read = functools.partial(logs.read, "l5", rate_hz=10.0)
X, Y = fixture.CENTRE


def map_of(file):
    return l5.SemanticMap(file, l5.world_to_ecef(file, PACKAGED))


def lanes_around(semantic_map):
    return semantic_map.roads.around(*fixture.CENTRE[:, None], np.zeros(2))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The recordings of the fixture."""
    return read(fixture.write(tmp_path_factory.mktemp("l5")).input)


@pytest.fixture
def folder(tmp_path):
    return fixture.write(tmp_path).input


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


@pytest.mark.parametrize("few", [1, 5])
def test_pieces_make_up_the_dataset(folder, whole, few, monkeypatch):
    monkeypatch.setattr(l5, "PIECE_SCENES", few)
    (dataset,) = l5.parts(folder, PACKAGED)
    specs = l5.pieces(dataset, PACKAGED)
    apart = [one for spec in specs for one in l5.recordings(dataset, spec)]

    def about(found):
        return [(digest(one), one.group, one.progress) for one in found]

    assert about(apart) == about(whole)


def test_reads_only_the_scene_it_is_at(folder):
    """Chunks of later scenes are not touched: the full set has 100s of GB."""
    agents = folder / "scenes" / "sample.zarr" / "agents"
    (agents / "2").unlink()  # of the second scene only
    found = read_recordings("l5", folder)
    assert next(found).name == "sample-000000"
    assert "agents/2: chunk: missing" in refused(next, found)


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


def test_format_version_1_has_no_lights(folder):
    shutil.rmtree(folder / "scenes" / "sample.zarr" / "traffic_light_faces")
    recording = read(folder)[0]
    assert recording.signals == ()
    assert "no traffic lights recorded" in recording.notes
