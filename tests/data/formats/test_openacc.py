"""OpenACC: metadata, columns with holes, drivers, blocks, lanes of laps."""

import functools

import numpy as np
import pytest

from tests.data.formats.fixtures import has_note
from tests.data.formats.fixtures import openacc as fixture
from tests.helpers import logs

read = functools.partial(logs.read, "openacc")
only = functools.partial(logs.only, "openacc")
TABLE = fixture.table(fixture.cars())


def drive(folder, columns=None, **options):
    return fixture.write_drive(folder / "part1.csv", columns or TABLE, **options)


def spec(folder, text):
    path = folder / "source.toml"
    path.write_text(text)
    return path


def test_who_drives_and_how_well_the_spacing_fits(tmp_path):
    """Car 2 is driven by its ACC: surroundings of cars 1 and 3."""
    recording = only(drive(tmp_path))
    assert recording.group == "drives of 04-07-2019"
    said = "\n".join(recording.notes)
    assert "car 1 100 %, car 2 0 %, car 3 100 %" in said
    assert "minus IVS: -0.0 m" in said or "minus IVS: 0.0 m" in said
    spans = [track.automated for track in recording.tracks[:3]]
    assert spans == [(), ((0.0, np.inf),), ()]


def without(*starts):
    return {n: c for n, c in TABLE.items() if not n.startswith(starts)}


META = fixture.META
CASALE = ("Date,27,10,2020", "Vehicle_order,Rexton,Hyundai,VW(GolfE)", "ACC,1")
ZALA = ("Date,9,10,2019", "Vehicle_order,SKODA_TARGET,MAZDA_3,BMW_I3,", "ACC,1")
SIZED = (*META, "Vehicle_length,5.3,4.9,4.6", "Vehicle_width,2.0,1.9,1.8")
MODELS = '[sizes]\n"Audi" = [4.0, 1.7]\n"audi a6" = [4.1, 1.8]\n'
A8, A6, X5 = "1-Audi(A8)", "2-Audi(A6)", "3-BMW(X5)"
USUAL = {A8: (5.17, True), A6: (4.94, False), X5: (4.92, True)}
# columns, metadata and source TOML -> road user: length [m], whether a human drives
SAID = {
    "no metadata": (TABLE, (), "", {"1": (4.6, True), "2": (4.6, False)}),
    "other lines": (TABLE, [f"Line{k},{k}" for k in range(7)], "", {"1": (4.6, True)}),
    "sizes of the header": (
        *(TABLE, SIZED, MODELS),
        {A8: (5.3, True), A6: (4.9, False), X5: (4.6, True)},
    ),
    "sizes of models": (
        *(TABLE, META, MODELS),
        {A8: (4.0, True), A6: (4.1, False), X5: (4.6, True)},
    ),
    "demonstrations by all": (
        *(TABLE, META, 'drivers = "all"\n'),
        dict.fromkeys(USUAL, (4.6, True)),
    ),
    # the leader was recorded otherwise: who drives it is not said
    "Casale": (
        *(without("Alt1", "U1", "Driver1"), CASALE, ""),
        {"1-Rexton": (4.85, False), "2-Hyundai": (4.6, False)}
        | {"3-VW(GolfE)": (4.27, True)},
    ),
    "ZalaZone": (
        {n: c for n, c in without("Driver", "U").items() if not n.endswith("1")},
        *(ZALA, "", {"2-MAZDA_3": (4.46, False), "3-BMW_I3": (4.01, False)}),
    ),
    # without a column of drivers the flag decides
    **{
        f"ACC {flag}": (
            without("Driver"),
            [line.replace("ACC,2", f"ACC,{flag}") for line in META],
            "",
            {name: (length, flag == "0") for name, (length, _) in USUAL.items()},
        )
        for flag in ("0", "1", "")
    },
}


@pytest.mark.parametrize("name", SAID)
def test_sizes_and_drivers(tmp_path, name):
    columns, meta, source, expected = SAID[name]
    source = spec(tmp_path, source) if source else None
    recording = only(drive(tmp_path, columns, meta=meta), source)
    found = {t.id: (t.length, t.is_human(0.0, 40.0)) for t in recording.tracks}
    assert {user: found[user] for user in expected} == expected
    is_dated = any(line.startswith("Date") for line in meta)
    assert (recording.group == "part1") != is_dated


@pytest.mark.parametrize("in_degrees", [False, True])
def test_positions_from_latitude_and_longitude(tmp_path, in_degrees):
    """ZalaZone's Lat and Lon are degrees, others' radians."""
    columns = without("E", "N")
    for name in columns if in_degrees else ():
        if name.startswith(("Lat", "Lon")):
            cells = (f"{np.rad2deg(float(c)):.9f}" if c else "" for c in columns[name])
            columns[name] = list(cells)
    recording = only(drive(tmp_path, columns))
    assert has_note(recording, "local origin")
    track = recording.tracks[0]
    assert np.abs(track.x).max() < 2000.0
    moved = np.hypot(*np.diff([track.x, track.y], axis=1)) / np.diff(track.t)
    np.testing.assert_allclose(moved, track.speed[1:], rtol=0.03, atol=0.3)


def test_who_drives_may_change(tmp_path):
    columns = fixture.table(fixture.cars(), ("Human", "Human", "Human"))
    columns["Driver2"] = ["Human"] * 150 + ["ACC"] * 100 + [""] * 50 + ["human"] * 100
    tracks = logs.tracks_of(only(drive(tmp_path, columns)))
    assert tracks[A6].automated == ((15.0, 30.0),)
    blocks = read(drive(tmp_path, columns), spec(tmp_path, "block_s = 10.0\n"))
    inside = [
        next(t.is_human(0.0, 9.0) for t in made.tracks if t.id.startswith("2"))
        for made in blocks
    ]
    assert inside == [True, False, False, True]


def test_long_drives_are_cut(tmp_path):
    found = read(drive(tmp_path), spec(tmp_path, "block_s = 10.0\n"))
    assert [r.name for r in found] == [f"part1-{k:04d}" for k in range(4)]
    assert {recording.group for recording in found} == {"drives of 04-07-2019"}
    for recording in found:
        assert min(track.t[0] for track in recording.tracks) == pytest.approx(0.0)
        assert max(track.t[-1] for track in recording.tracks) < 10.0
    assert sum(t.t.size for r in found for t in r.tracks) == 400 + 396 + 370
    assert only(drive(tmp_path), spec(tmp_path, "block_s = 0.0\n")).name == "part1"
