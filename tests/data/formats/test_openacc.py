"""OpenACC: metadata, columns with holes, drivers, blocks, lanes of laps."""

import dataclasses
import functools

import numpy as np
import pytest

from rcirl_jax.data.formats.lanes import path_lanes
from rcirl_jax.errors import InputError
from tests.data.formats.fixtures import openacc as fixture
from tests.data.formats.fixtures.drives import straight
from tests.helpers import logs

read = functools.partial(logs.read, "openacc")
only = functools.partial(logs.only, "openacc")


def drive(folder, columns=None, **options):
    columns = fixture.table(fixture.cars()) if columns is None else columns
    return fixture.write_drive(folder / "part1.csv", columns, **options)


def spec(folder, text):
    path = folder / "source.toml"
    path.write_text(text)
    return path


def test_platoon(tmp_path):
    recording = only(drive(tmp_path))
    names = [track.id for track in recording.tracks]
    assert names == ["1-Audi(A8)", "2-Audi(A6)", "3-BMW(X5)", "3-BMW(X5)#2"]
    lead, follower = recording.tracks[:2]
    assert (lead.length, lead.width) == (5.17, 1.95)
    x, y, heading = fixture.on_track(fixture.cars()[1][0])
    np.testing.assert_allclose(lead.x, x, atol=1e-6)
    np.testing.assert_allclose(lead.y, y, atol=1e-6)
    np.testing.assert_allclose(lead.heading, heading, atol=0.03)
    assert follower.t.size == 396
    assert recording.group == "drives of 04-07-2019"
    assert any("car 1 100 %, car 2 0 %, car 3 100 %" in n for n in recording.notes)
    assert any(
        "minus IVS: -0.0 m" in n or "minus IVS: 0.0 m" in n for n in recording.notes
    )


@pytest.mark.parametrize("count", [0, 1, 7])
def test_number_of_metadata_lines(tmp_path, count):
    meta = [f"Line{k},{k}" for k in range(count)]
    recording = only(drive(tmp_path, meta=meta))
    assert [track.id for track in recording.tracks][:2] == ["1", "2"]
    assert recording.group == "part1"


def test_sizes_of_the_header_come_first(tmp_path):
    meta = (*fixture.META, "Vehicle_length,5.3,4.9,4.6", "Vehicle_width,2.0,1.9,1.8")
    tracks = only(drive(tmp_path, meta=meta)).tracks
    assert [track.length for track in tracks[:3]] == [5.3, 4.9, 4.6]
    assert [track.width for track in tracks[:3]] == [2.0, 1.9, 1.8]


def test_sizes_of_models(tmp_path):
    source = spec(tmp_path, '[sizes]\n"Audi" = [4.0, 1.7]\n"audi a6" = [4.1, 1.8]\n')
    tracks = only(drive(tmp_path), source).tracks
    assert [track.length for track in tracks[:3]] == [4.0, 4.1, 4.6]


def test_positions_from_latitude_and_longitude_in_radians(tmp_path):
    columns = fixture.table(fixture.cars())
    for car in (1, 2, 3):
        del columns[f"E{car}"], columns[f"N{car}"]
    recording = only(drive(tmp_path, columns))
    assert any("local origin" in note for note in recording.notes)
    track = recording.tracks[0]
    assert np.abs(track.x).max() < 2000.0
    moved = np.hypot(*np.diff([track.x, track.y], axis=1)) / np.diff(track.t)
    np.testing.assert_allclose(moved, track.speed[1:], rtol=0.03, atol=0.3)


def test_positions_in_degrees(tmp_path):
    """ZalaZone's Lat and Lon are degrees."""
    columns = fixture.table(fixture.cars())
    in_radians = only(drive(tmp_path, _without_plane(columns))).tracks[0]
    for name in columns:
        if name.startswith(("Lat", "Lon")):
            cells = (f"{np.rad2deg(float(c)):.9f}" if c else "" for c in columns[name])
            columns[name] = list(cells)
    in_degrees = only(drive(tmp_path, _without_plane(columns))).tracks[0]
    np.testing.assert_allclose(in_degrees.x, in_radians.x, atol=0.01)
    np.testing.assert_allclose(in_degrees.y, in_radians.y, atol=0.01)


def _without_plane(columns):
    return {n: c for n, c in columns.items() if not n.startswith(("E", "N"))}


def test_layouts_of_the_campaigns(tmp_path):
    """Columns and metadata as Casale's and ZalaZone's files have them."""
    columns = fixture.table(fixture.cars())
    lost = ("Alt1", "U1", "Driver1")  # the leader was recorded otherwise
    casale = {name: cells for name, cells in columns.items() if name not in lost}
    meta = (
        *("Date,27,10,2020", "Vehicle_order,Rexton,Hyundai,VW(GolfE)"),
        *("Number_of_vehicles,3", "ACC,1", "Distance_setting,min"),
    )
    recording = only(drive(tmp_path, casale, meta=meta))
    names = [track.id for track in recording.tracks]
    assert names[:3] == ["1-Rexton", "2-Hyundai", "3-VW(GolfE)"]
    # who drives the leader is not said
    human = [track.is_human(0.0, 40.0) for track in recording.tracks[:3]]
    assert human == [False, False, True]
    assert [track.length for track in recording.tracks[:3]] == [4.85, 4.6, 4.27]
    order = ("Time", "Speed", "E", "N", "Lon", "Lat", "Alt", "IVS")
    zala = {
        name: cells
        for start in order
        for name, cells in columns.items()
        if name.startswith(start) and not name.endswith("1")
    }
    meta = (
        *("Date,9,10,2019", "Vehicle_order,SKODA_TARGET,MAZDA_3,BMW_I3,"),
        *("Number_of_vehicles,3", "ACC,1", "Distance_setting,SL"),
    )
    recording = only(drive(tmp_path, zala, meta=meta))
    assert [track.id for track in recording.tracks][:2] == ["2-MAZDA_3", "3-BMW_I3"]
    assert [track.length for track in recording.tracks[:2]] == [4.46, 4.01]


def test_only_human_drives_are_demonstrations(tmp_path):
    """Car 2 is driven by its ACC: surroundings of cars 1 and 3."""
    recording = only(drive(tmp_path))
    spans = [track.automated for track in recording.tracks[:3]]
    assert spans == [(), ((0.0, np.inf),), ()]
    all_of_them = only(drive(tmp_path), spec(tmp_path, 'drivers = "all"\n'))
    assert not any(track.automated for track in all_of_them.tracks)


@pytest.mark.parametrize("flag", ["0", "1", "2", ""])
def test_without_a_driver_column_the_flag_decides(tmp_path, flag):
    columns = fixture.table(fixture.cars(), ())
    meta = [line.replace("ACC,2", f"ACC,{flag}") for line in fixture.META]
    recording = only(drive(tmp_path, columns, meta=meta))
    assert len(recording.tracks) == 4
    assert {track.is_human(0.0, 40.0) for track in recording.tracks} == {flag == "0"}
    share = "100 %" if flag == "0" else "unknown"
    assert any(f"driven by a human: car 1 {share}" in n for n in recording.notes)


def test_who_drives_may_change(tmp_path):
    columns = fixture.table(fixture.cars(), ("Human", "Human", "Human"))
    columns["Driver2"] = ["Human"] * 150 + ["ACC"] * 100 + [""] * 50 + ["human"] * 100
    tracks = {t.id: t for t in only(drive(tmp_path, columns)).tracks}
    assert tracks["2-Audi(A6)"].automated == ((15.0, 30.0),)
    blocks = read(drive(tmp_path, columns), spec(tmp_path, "block_s = 10.0\n"))
    inside = [
        next(t.is_human(0.0, 9.0) for t in made.tracks if t.id.startswith("2"))
        for made in blocks
    ]
    assert inside == [True, False, False, True]


def test_long_drives_are_cut(tmp_path):
    source = spec(tmp_path, "block_s = 10.0\n")
    found = read(drive(tmp_path), source)
    assert [r.name for r in found] == [f"part1-{k:04d}" for k in range(4)]
    assert {recording.group for recording in found} == {"drives of 04-07-2019"}
    for recording in found:
        assert min(track.t[0] for track in recording.tracks) == pytest.approx(0.0)
        assert max(track.t[-1] for track in recording.tracks) < 10.0
    assert sum(t.t.size for r in found for t in r.tracks) == 400 + 396 + 370
    whole = only(drive(tmp_path), spec(tmp_path, "block_s = 0.0\n"))
    assert whole.name == "part1"


def lap(radius, turns, noise=0.0):
    """A car on a round track, at 20 m/s."""
    t = np.arange(0.0, turns * 2 * np.pi * radius / 20.0, 0.1)
    angle = 20.0 * t / radius
    jitter = noise * np.random.default_rng(0).normal(size=(2, t.size))
    user = straight(t, (0.0, 0.0), 0.0, 0.0)
    return dataclasses.replace(
        user,
        x=radius * np.cos(angle) + jitter[0],
        y=radius * np.sin(angle) + jitter[1],
        heading=angle + np.pi / 2,
        speed=np.full(t.shape, 20.0),
    )


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_lanes_close_a_lap(noise):
    """Three laps of 1,885 m: one chain of lanes that leads back to its start."""
    lanes = {lane.id: lane for lane in path_lanes([lap(300.0, 3.2, noise)], 3.5, None)}
    assert len(lanes) <= 6
    name, seen = "path-0", []
    while name not in seen:
        seen.append(name)
        (name,) = lanes[name].successors
    assert set(seen) == set(lanes)
    length = sum(np.hypot(*np.diff(ln.centre, axis=0).T).sum() for ln in lanes.values())
    assert 1870.0 < length < 1930.0
    for lane in lanes.values():
        steps = np.hypot(*np.diff(lane.centre, axis=0).T)
        assert steps.max() < 26.0


def test_lanes_of_opposite_directions_and_of_a_second_lane():
    t = np.arange(200) * 0.1
    there = straight(t, (0.0, 0.0), 0.0, 15.0)
    back = straight(t, (300.0, 1.0), np.pi, 15.0)
    beside = straight(t, (0.0, -5.0), 0.0, 15.0)
    same = straight(t, (0.0, -1.0), 0.0, 14.0)
    assert len(path_lanes([there, back, beside, same], 3.5, 20.0)) == 3


def test_standing_cars_make_no_lanes():
    t = np.arange(200) * 0.1
    parked = straight(t, (5.0, 5.0), 0.0, 0.0)
    jitter = np.random.default_rng(1).normal(size=t.size)
    assert path_lanes([dataclasses.replace(parked, x=5.0 + jitter)], 3.5, None) == ()


def test_columns_but_no_car(tmp_path):
    columns = {"Time": ["0.0", "0.1"], "IVS1": ["1", "2"]}
    with pytest.raises(InputError, match="expected Speed1, E1, N1"):
        read(drive(tmp_path, columns))
