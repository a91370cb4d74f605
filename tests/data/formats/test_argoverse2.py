"""Argoverse 2: a scenario as published, the real files, hostile Parquet and JSON."""

import functools

import numpy as np
import pytest

from rcirl_jax.types import Kind
from tests.data.formats.fixtures import argoverse2 as w
from tests.data.formats.fixtures import has_note
from tests.helpers import logs
from tests.helpers.logs import lanes_of, refused, tracks_of

PACKAGED = logs.packaged("argoverse2")
read = functools.partial(logs.read, "argoverse2")
only = functools.partial(logs.only, "argoverse2")


def scenario(folder, **options):
    """The recording of one scenario; `table` and `lanes` of it may be given."""
    made = {key: options.pop(key) for key in ("table", "lanes") if key in options}
    return only(w.write_scenario(folder, **made)[0], **options)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The recording of the fixture."""
    return only(w.write(tmp_path_factory.mktemp("argoverse2")).input)


def test_lanes(whole):
    assert (whole.rate_hz, whole.name, whole.group) == (10.0, w.SCENARIO, w.SLICE)
    lanes = lanes_of(whole)
    inner, outer = lanes["205119001"], lanes["205119002"]
    np.testing.assert_allclose(outer.left_width, w.WIDTH / 2, atol=0.01)
    np.testing.assert_allclose(outer.centre[:, 1], w.PLACE[1], atol=0.01)
    assert outer.successors == ("205119004", "205119006")
    # the oncoming lane is named as left neighbour in the file
    assert (inner.left, inner.right, outer.left) == (None, "205119002", "205119001")
    # the bicycle lane is left out, and so is a successor that the map lacks
    assert (outer.right, lanes["205119003"].successors) == (None, ())
    assert has_note(whole, "1 lanes not of type")
    assert whole.signals == ()
    oncoming, turn = lanes["205119005"].centre, lanes["205119006"].centre
    assert oncoming[-1, 0] < oncoming[0, 0]
    # a turning lane lies midway between its bounds
    middle = np.add(w.PLACE, (60.0, 25.0))
    np.testing.assert_allclose(np.hypot(*(turn - middle).T), 25.0, atol=0.1)


def test_options(tmp_path):
    assert len(scenario(tmp_path, lane_types=["VEHICLE", "BIKE"]).lanes) == 7
    recording = scenario(tmp_path, min_category=1)
    assert "138902" not in tracks_of(recording)
    assert has_note(recording, "3 tracks below category 1")
    sizes = {**PACKAGED["sizes"], "bus": [18.0, 2.55]}
    tracks = scenario(tmp_path, sizes=sizes).tracks
    assert {track.length for track in tracks if "139400" in track.id} == {18.0}
    kinds = {**PACKAGED["kinds"], "cyclist": "vehicle"}
    tracks = tracks_of(scenario(tmp_path, kinds=kinds))
    assert tracks["139408"].kind == Kind.VEHICLE


def test_columns_that_may_be_missing_and_the_test_split(tmp_path):
    """The test split has the observed part only."""
    table = w.columns()
    for name in ("slice_id", "map_id", "city", "focal_track_id", "observed"):
        del table[name]
    keep = [row for row, step in enumerate(table["timestep"]) if step < w.OBSERVED]
    table = {key: [values[row] for row in keep] for key, values in table.items()}
    recording = scenario(tmp_path, table=table)
    assert recording.group == w.SCENARIO
    assert max(track.t[-1] for track in recording.tracks) == pytest.approx(4.9)


def test_scenario_id_does_not_lead_out_of_the_folder(tmp_path):
    table = w.columns()
    table["scenario_id"] = ["/../../secret"] * len(table["timestep"])
    path, map_file = w.write_scenario(tmp_path, table=table)
    assert only(path).name == "/../../secret"
    map_file.rename(tmp_path / "secret.json")
    (path.parent / "log_map_archive_").mkdir()
    assert "map: missing" in refused(read, path)


@pytest.mark.dataset
def test_recorded_scenario(data_dir):
    recording = only(data_dir / "formats" / "argoverse2_motion")
    assert (len(recording.tracks), recording.rate_hz) == (58, 10.0)
    assert sum(track.t.size for track in recording.tracks) == 2434
    tracks = tracks_of(recording)
    assert tracks["AV"].length == 4.87
    assert tracks["138951"].t.size == 110
    assert len(recording.lanes) == 34
    assert sum(lane.right is not None for lane in recording.lanes) == 7
    for lane in recording.lanes:
        assert 1.0 < np.median(lane.left_width) < 4.0
    away = np.hypot(*(recording.lanes[0].centre - [-436.0, 1350.0]).T)
    assert away.min() < 300.0
