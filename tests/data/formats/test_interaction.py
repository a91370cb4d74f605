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
NAME = f"{fixture.SCENE}-000"


@pytest.fixture
def root(tmp_path):
    fixture.write(tmp_path)
    return tmp_path


@pytest.fixture
def scene(root):
    return root / "recorded_trackfiles" / fixture.SCENE


def test_vehicles_and_pedestrians_are_one_recording(root, tmp_path):
    """The release, a folder and a file give the same; who rides, the source says."""
    recording = only(root)
    assert (recording.name, recording.group) == (NAME, None)
    folder = root / "recorded_trackfiles"
    for path in (folder, folder / fixture.SCENE / "vehicle_tracks_000.csv"):
        found = only(path)
        assert (found.name, len(found.tracks)) == (NAME, 5)
        assert len(found.lanes) == len(recording.lanes)
    source = tmp_path / "s.toml"
    source.write_text("cyclist_speed_mps = 6.0\n")
    assert logs.tracks_of(only(root, source))["P13"].kind == Kind.PEDESTRIAN


@pytest.mark.parametrize("kept", [".osm_xy", ".osm"])
def test_map_in_metres_and_in_degrees(root, kept):
    both = logs.lanes_of(only(root))
    for ending in {".osm_xy", ".osm"} - {kept}:
        (root / "maps" / f"{fixture.SCENE}{ending}").unlink()
    lanes = only(root).lanes
    assert len(lanes) == len(both)
    for lane in lanes:
        np.testing.assert_allclose(lane.centre, both[lane.id].centre, atol=0.01)
    assert lanes[0].speed_limit == pytest.approx(50 / 3.6)


@pytest.mark.parametrize(
    ("name", "maps", "is_found"),
    [
        ("DR_CHN_Merging_ZS", ["DR_CHN_Merging_ZS2"], True),
        ("DR_CHN_Merging_ZS", ["DR_CHN_Merging_ZS0", "DR_CHN_Merging_ZS2"], False),
        # EP0 and EP1 are two places
        (fixture.SCENE, ["DR_USA_Intersection_EP1"], False),
    ],
)
def test_maps_with_another_number(root, scene, name, maps, is_found):
    scene.rename(scene.with_name(name))
    (root / "maps" / f"{fixture.SCENE}.osm").unlink()
    place = root / "maps" / f"{fixture.SCENE}.osm_xy"
    content = place.read_bytes()
    place.unlink()
    for other in maps:
        place.with_name(f"{other}.osm_xy").write_bytes(content)
    recording = only(root)
    assert ("30001" in logs.lanes_of(recording)) == is_found
    is_estimated = any(x.startswith("no map found; ") for x in recording.notes)
    assert is_estimated != is_found


@pytest.mark.parametrize("split", ["train", "sorted/val"])
def test_logs_split_by_the_scripts_of_the_data_set(root, scene, split):
    """SCENE/train and SCENE/val are no places: names and map are the scene's."""
    whole = only(root)
    (scene / split).mkdir(parents=True)
    for path in sorted(scene.glob("*.csv")):
        path.rename(scene / split / path.name)
    recording = only(root)
    assert recording.name == NAME
    assert [lane.id for lane in recording.lanes] == [lane.id for lane in whole.lanes]


def test_cases_are_recordings_of_one_group(tmp_path):
    """Observations and submissions beside them are left out."""
    challenge.write(tmp_path)
    for name in ("test_multi-agent/DR_CHN_Merging_ZS0_obs.csv", "DR_A_sub.csv"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("not read")
    first, second = read(tmp_path)
    stem = f"{challenge.PLACE}_train"
    assert (first.name, second.name) == (f"{stem}-case1", f"{stem}-case2")
    assert {first.group, second.group} == {stem}
    assert [track.id for track in first.tracks] == ["1", "P4"]
