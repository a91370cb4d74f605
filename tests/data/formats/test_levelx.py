"""leveLXData: highD's boxes and markings, inD's centres and maps, traps."""

import functools

import numpy as np
import pytest

from rcirl_jax.data.scenes.collect import Collector
from rcirl_jax.data.scenes.config import CollectConfig
from tests.data.formats.fixtures import levelx as ind
from tests.data.formats.fixtures import levelx_highd as highd
from tests.data.formats.fixtures.drives import straight
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


def test_highds_corners_carriageways_and_lane_numbers(motorway):
    recording = only(motorway)
    car, lanes = recording.tracks[0], lanes_of(recording)
    assert (recording.name, recording.rate_hz) == ("01", 25.0)
    # x, y of the file is the corner: 5 - 4.85 / 2, 22.98 - 2.12 / 2; y points down
    np.testing.assert_allclose((car.x[0], car.y[0]), (5.0, -22.98), atol=0.01)
    assert (car.length, car.width, car.t[0]) == (4.85, 2.12, 0.0)
    assert np.diff(car.t) == pytest.approx(0.04)
    assert sorted(lanes) == ["2", "3", "5", "6"]
    np.testing.assert_allclose(lanes["2"].centre[:, 1], -0.5 * (8.51 + 12.59))
    np.testing.assert_allclose(lanes["6"].left_width, 0.5 * (28.8 - 24.96))
    # the upper carriageway is driven towards -x: its left lane is the lower one
    assert lanes["2"].centre[0, 0] > lanes["2"].centre[-1, 0]
    assert (lanes["2"].left, lanes["2"].right) == ("3", None)
    assert (lanes["5"].left, lanes["5"].right) == (None, "6")
    assert lanes["6"].left == "5"


def test_direction_decides_the_heading_of_who_stands(motorway):
    path, change = motorway / "01_tracks.csv", {2: "200", 3: "9.4", 6: "0", 7: "0"}
    rows = [line.split(",") for line in path.read_text().splitlines()]
    for cells in rows:
        for place, cell in change.items() if cells[1] == "3" else ():
            cells[place] = cell
    path.write_text("\n".join(map(",".join, rows)) + "\n")
    np.testing.assert_allclose(tracks_of(only(motorway))["3"].heading, np.pi)


@pytest.mark.parametrize(
    ("text", "lane", "default"),
    [("-1.00", None, 36.11), ("33.33", 33.33, 33.33), ("", None, 36.11)],
)
def test_speed_limit(motorway, text, lane, default):
    edit(motorway / "01_recordingMeta.csv", ",-1.00,", f",{text},")
    recording = only(motorway)
    assert recording.lanes[0].speed_limit == lane
    assert recording.default_speed_limit == default


# -------------------------------------------------------------- inD and sisters


def test_walkers_without_a_heading_get_that_of_their_path(tmp_path):
    kind, walker, frames = ind.road_users()["3"]
    turned = straight(ind.T, (60.0, -40.0), np.pi / 2, 1.4, kind=walker.kind)
    ind.write_tracks(tmp_path, "00", {"3": (kind, turned, frames)})
    path = tmp_path / "00_tracks.csv"
    path.write_text(path.read_text().replace(",90.00000,", ",0.00000,"))
    ind.write_meta(tmp_path, "00")
    (track,) = only(tmp_path).tracks
    np.testing.assert_allclose(track.heading, np.pi / 2, atol=1e-3)


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
    assert "1 trailers are obstacles of kind cyclist, no experts" in recording.notes


def test_a_trailer_is_an_obstacle_but_no_expert(tmp_path):
    """It follows its tractor half a metre behind; a car follows the trailer."""
    fleet = [("car", 60.0, 4.5), ("trailer", 54.25, 6.0), ("car", 20.0, 4.5)]
    users = {
        str(number): (
            kind,
            straight(ind.T, (x, -41.75), 0.0, 15.0, size=(length, 2.0)),
            np.arange(ind.FRAMES),
        )
        for number, (kind, x, length) in enumerate(fleet)
    }
    ind.write_tracks(tmp_path, "00", users)
    ind.write_meta(tmp_path, "00")
    recording = only(tmp_path)
    collect = CollectConfig(require_speed_change=False)
    scenes = list(Collector(recording, collect).scenes())
    names = [recording.tracks[scene["track"]].id for scene in scenes]
    assert set(names) == {"0", "2"}
    for scene in (s for s, name in zip(scenes, names, strict=True) if name == "2"):
        length = scene["obstacles.s_upper"] - scene["obstacles.s_lower"]
        assert np.any(np.abs(length[:, 0] - 6.0) < 0.05)


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
