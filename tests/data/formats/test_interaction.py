"""INTERACTION: recordings with pedestrians, cases of the challenge, maps."""

import functools

import numpy as np
import pytest

from rcirl_jax.types import Kind
from tests.data.formats.fixtures import interaction as fixture
from tests.data.formats.fixtures import interaction_challenge as challenge
from tests.helpers import logs

read = functools.partial(logs.read, "interaction")
only = functools.partial(logs.only, "interaction")


@pytest.fixture
def root(tmp_path):
    fixture.write(tmp_path)
    return tmp_path


@pytest.fixture
def scene(root):
    return root / "recorded_trackfiles" / fixture.SCENE


@pytest.fixture
def cases(tmp_path):
    challenge.write(tmp_path)
    return tmp_path / "train" / f"{challenge.PLACE}_train.csv"


def test_vehicles_and_pedestrians_are_one_recording(root):
    recording = only(root)
    assert recording.name == f"{fixture.SCENE}-000"
    kinds = {track.id: track.kind for track in recording.tracks}
    assert kinds["1"] == Kind.VEHICLE
    assert kinds["P4"] == Kind.PEDESTRIAN
    # the same class, but at 5 m/s
    assert kinds["P13"] == Kind.CYCLIST
    assert recording.group is None
    assert recording.tracks[0].heading.dtype == np.float64


def test_who_rides_is_decided_by_the_source(root, tmp_path):
    source = tmp_path / "s.toml"
    source.write_text("cyclist_speed_mps = 6.0\n")
    kinds = {track.id: track.kind for track in only(root, source).tracks}
    assert kinds["P13"] == Kind.PEDESTRIAN


def test_inputs_from_the_release_down_to_a_file(root, scene):
    whole = only(root)
    for path in (root / "recorded_trackfiles", scene, scene / "vehicle_tracks_000.csv"):
        recording = only(path)
        assert (recording.name, len(recording.tracks)) == (whole.name, 5)
        assert len(recording.lanes) == len(whole.lanes)


@pytest.mark.parametrize("kept", [".osm_xy", ".osm"])
def test_map_in_metres_and_in_degrees(root, kept):
    both = {lane.id: lane for lane in only(root).lanes}
    for ending in {".osm_xy", ".osm"} - {kept}:
        (root / "maps" / f"{fixture.SCENE}{ending}").unlink()
    lanes = only(root).lanes
    assert len(lanes) == len(both)
    for lane in lanes:
        np.testing.assert_allclose(lane.centre, both[lane.id].centre, atol=0.01)
    assert lanes[0].speed_limit == pytest.approx(50 / 3.6)


@pytest.mark.parametrize(
    ("maps", "found"), [(["ZS"], True), (["ZS2"], True), (["ZS0", "ZS2"], False)]
)
def test_maps_with_another_number(root, scene, maps, found):
    scene.rename(scene.with_name("DR_CHN_Merging_ZS"))
    (root / "maps" / f"{fixture.SCENE}.osm").unlink()
    content = (root / "maps" / f"{fixture.SCENE}.osm_xy").read_bytes()
    (root / "maps" / f"{fixture.SCENE}.osm_xy").unlink()
    for name in maps:
        (root / "maps" / f"DR_CHN_Merging_{name}.osm_xy").write_bytes(content)
    ids = {lane.id for lane in only(root).lanes}
    assert ("30001" in ids) == found


def test_logs_split_by_the_scripts_of_the_data_set(root, scene):
    """SCENE/train and SCENE/val are no places: names and map are the scene's."""
    whole = only(root)
    (scene / "train").mkdir()
    for path in sorted(scene.glob("*.csv")):
        path.rename(scene / "train" / path.name)
    recording = only(root)
    assert recording.name == whole.name == f"{fixture.SCENE}-000"
    assert [lane.id for lane in recording.lanes] == [lane.id for lane in whole.lanes]
    (scene / "train").rename(scene / "val")
    (scene / "sorted").mkdir()
    (scene / "val").rename(scene / "sorted" / "val")
    assert only(root).name == whole.name


def test_the_map_of_a_neighbouring_place_is_not_taken(root):
    """EP0 and EP1 are two places: without its own map a log has none."""
    for ending in (".osm_xy", ".osm"):
        path = root / "maps" / f"{fixture.SCENE}{ending}"
        path.rename(path.with_name(f"DR_USA_Intersection_EP1{ending}"))
    recording = only(root)
    assert "no map found; lanes fitted to the longest paths" in recording.notes


def test_cases_are_recordings_of_one_group(cases):
    first, second = read(cases.parent)
    stem = f"{challenge.PLACE}_train"
    assert (first.name, second.name) == (f"{stem}-case1", f"{stem}-case2")
    assert {first.group, second.group} == {stem}
    assert [track.id for track in first.tracks] == ["1", "P4"]
    assert first.tracks[0].t.size == 40
    assert second.tracks[0].t[0] == 0.0
    assert len(second.lanes) == 7


def test_observations_and_submissions_are_left_out(cases):
    for name in ("test_multi-agent/DR_CHN_Merging_ZS0_obs.csv", "DR_A_sub.csv"):
        path = cases.parent.parent / name
        path.parent.mkdir(exist_ok=True)
        path.write_text("not read")
    assert len(read(cases.parent.parent)) == 2


def test_pedestrians_head_where_they_walk(root):
    (walker,) = [track for track in only(root).tracks if track.id == "P4"]
    assert (walker.length, walker.width) == (0.5, 0.5)
    np.testing.assert_allclose(walker.heading, 0.0, atol=1e-3)
    np.testing.assert_allclose(walker.speed, 1.3, atol=1e-3)
