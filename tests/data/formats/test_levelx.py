"""leveLXData: highD's boxes and markings, inD's centres and maps, traps."""

import functools

import numpy as np
import pytest

from rcirl_jax.types import Kind
from tests.data.formats.fixtures import levelx as ind
from tests.data.formats.fixtures import levelx_highd as highd
from tests.helpers import logs
from tests.helpers.logs import edit, lanes_of, refused, tracks_of

read = functools.partial(logs.read, "levelx")
only = functools.partial(logs.only, "levelx")
MAP = "maps/lanelets/04_aseag/location4.osm"


@pytest.fixture
def motorway(tmp_path):
    highd.write(tmp_path)
    return tmp_path


@pytest.fixture
def junction(tmp_path):
    ind.write(tmp_path)
    return tmp_path


def test_highds_carriageways_and_lane_numbers(motorway):
    lanes = lanes_of(only(motorway))
    assert sorted(lanes) == ["2", "3", "5", "6"]
    np.testing.assert_allclose(lanes["2"].centre[:, 1], -0.5 * (8.51 + 12.59))
    np.testing.assert_allclose(lanes["6"].left_width, 0.5 * (28.8 - 24.96))
    # the upper carriageway is driven towards -x: its left lane is the lower one
    assert lanes["2"].centre[0, 0] > lanes["2"].centre[-1, 0]
    assert (lanes["2"].left, lanes["2"].right) == ("3", None)
    assert (lanes["5"].left, lanes["5"].right) == (None, "6")
    assert lanes["6"].left == "5"


@pytest.mark.parametrize(
    ("text", "limit"), [("-1.00", None), ("33.33", 33.33), ("", None)]
)
def test_speed_limit(motorway, text, limit):
    edit(motorway / "01_recordingMeta.csv", ",-1.00,", f",{text},")
    recording = only(motorway)
    assert recording.lanes[0].speed_limit == limit
    assert recording.default_speed_limit == (limit or 36.11)


EXID = {
    **{"traveledDistance": "1.5", "latLaneCenterOffset": "0.1;-3.6"},
    **{"laneletId": "1992;1996", "laneChange": 0, "leadDHW": "", "leadTTC": "nan"},
}


def test_exid_columns_with_lists_and_holes(tmp_path):
    users = ind.road_users()
    users["0"] = ("van", *users["0"][1:])
    users["2"] = ("trailer", *users["2"][1:])
    ind.write_tracks(tmp_path, "39", users, more=EXID)
    ind.write_meta(tmp_path, "39", speedLimit=-1)
    recording = only(tmp_path)
    assert len(recording.tracks) == 6
    assert recording.default_speed_limit == 36.11
    assert tracks_of(recording)["2"].kind == Kind.CYCLIST
    assert "1 trailers are obstacles of kind cyclist, no experts" in recording.notes


@pytest.mark.parametrize(
    "place",
    [
        MAP,
        "lanelets/location4.osm",
        "data/location4.osm",
        "maps/lanelets/4_somewhere/town.osm",
        "maps/rounD_4.osm",
        "maps/4_somewhere.osm",
    ],
)
def test_where_maps_lie(junction, place):
    target = junction / place
    target.parent.mkdir(parents=True, exist_ok=True)
    (junction / MAP).rename(target)
    # maps of other places and of building sites are not taken for it
    for name in ("location4_construction", "location14"):
        (target.parent / f"{name}.osm").write_text("not read")
    assert lanes_of(only(junction)).keys() >= {"30001", "30003"}


@pytest.mark.parametrize(
    ("kept", "found"),
    [
        (lambda k, _: k < 400, "track 1: numFrames: 99: expected 235"),
        (lambda k, _: k < 301, "track 1: numFrames: 0: expected 235"),
        (lambda k, _: k != 50, "track 0: numFrames: 299: expected 300"),
        (lambda _, cells: cells[1] != "5", "track 5: numFrames: 0: expected 300"),
    ],
)
def test_truncated_at_the_border_of_lines(junction, tmp_path, kept, found):
    """A part is read on request: published samples hold the first rows only."""
    path = junction / "data" / "07_tracks.csv"
    head, *lines = path.read_text().splitlines()
    lines = [x for k, x in enumerate(lines, 1) if kept(k, x.split(","))]
    path.write_text("\n".join([head, *lines, ""]))
    assert refused(read, junction) == (
        f"{path}: {found} as in 07_tracksMeta.csv; truncated file? "
        "(of a sample, set partial = true in the source TOML)"
    )
    source = tmp_path / "s.toml"
    source.write_text("partial = true\n")
    recording = only(junction, source)
    lost = 6 - len({track.id.split("#")[0] for track in recording.tracks})
    assert (f"{lost} tracks of tracksMeta have no rows" in recording.notes) == (
        lost > 0
    )
