"""Tables and source TOMLs that are wrong: one line each, with what to do."""

import gzip

import numpy as np
import pytest

from rcirl_jax.errors import InputError
from tests.data.formats import people
from tests.data.formats.people import HEADER, Way, column, of, refused, rows, text
from tests.data.formats.test_csv_meaning import wide_frames
from tests.data.formats.test_csv_ways import ISO, degrees, heading_as


def moved(**options):
    """The drive with options that are wrong."""
    return of(rows(), **options)


def headed(change, **options):
    return of(column(rows(0.5), "heading", change), **options)


def scaled(factor, *names):
    """The drive with columns in another unit than the TOML says."""
    table = rows()
    for name in names:
        table = column(table, name, lambda value: value * factor)
    return of(table)


def side_by_side(**options):
    header, table = wide_frames("{axis}_{car}")
    return of(table, header, **options)


NUMBERED = [*enumerate(rows())]
RAD, DEG = 'heading = "rad"', 'heading = "deg"'
USUAL = 'heading_convention = "ccw_from_x"'
LAB = (*HEADER[:2], "a", "b", *HEADER[4:])
LANES = '[[lanes]]\nid = "a"\npoints = [[0.0, 0.0], [9.0, 0.0]]\nspeedlimit = 9.0'
AUTOMATED = (*HEADER, "automated")
REFUSED = {
    "no header? name the columns by names in [table]": Way(
        content=text(rows()).partition("\n")[2]
    ),
    # the layout
    "table: separator: unknown: expected delimiter": moved(
        rest='[table]\nseparator = ";"'
    ),
    "table.delimiter: ab: expected one of tab": moved(rest='[table]\ndelimiter = "ab"'),
    # a row per frame
    "columns.x: px_{id}: expected columns of this name and of y_{id}": side_by_side(
        columns={"t": "time", "x": "px_{id}", "y": "y_{id}"}
    ),
    # columns and lanes
    "columns.y: missing": moved(columns=("t", "id", "x")),
    "units.x: yard": moved(units='x = "yard"'),
    # units and numbers that no road user has
    "feet taken for metres": scaled(1 / 0.3048, "x", "y", "length"),
    "km/h taken for m/s": scaled(3.6, "speed"),
    "t: median step 1: expected at most 0.55": scaled(10.0, "t"),
    "t: median step 0.2 s: expected 0.1 s": scaled(2.0, "t"),
    # times
    "units.t: ms: the cells of t are such as '2024-05-20T10:00:00.000'": of(
        column(rows(), "t", ISO["ISO"]), units='t = "ms"'
    ),
    # places
    'longitude and latitude? say units.x = "deg", units.y = "deg"': of(
        degrees(rows()), columns=HEADER[:4]
    ),
    # headings
    "leave columns.heading out": headed(lambda h: h + 2.2, units=RAD),
    'heading_convention = "cw_from_north" with units.heading = "deg" fits': headed(
        heading_as("cw_from_north", "deg"), units=DEG, more=USUAL
    ),
    # options that nobody reads
    "did you mean speed_limit?": moved(more="speedlimit = 20.0"),
    # flags
    "automated: 'L0': expected yes or no; automated_values of the source": of(
        [[*row, "L0"] for row in rows()], AUTOMATED
    ),
    # bad rows
    "11 of 720 rows are bad": of(
        [
            [*r[:2], 9999.0 if k % 71 == 0 else r[2], *r[3:]]
            for k, r in enumerate(rows())
        ]
    ),
    # two recordings in one file and no column that says so
    "id car0: met twice in one frame; 720 of 1440 rows are bad": of(
        [*rows(), *column(rows(), "y", lambda y: y + 40.0)]
    ),
    # files that are no tables
    "git lfs pull": Way(
        content=b"version https://git-lfs.github.com/spec/v1\noid sha256:1\n"
    ),
    "a spreadsheet or a zip archive": Way(content=b"PK\x03\x04" + bytes(60)),
    "Feather version 1: expected version 2": Way(content=b"FEA1" + bytes(60)),
    "10001 columns": Way(content=",".join(f"c{k}" for k in range(10_001))),
    "header: empty: expected column names": Way(content='"'),
    "gzip: ": Way(content=gzip.compress(text(rows()).encode())[:-20]),
    # packed bytes without an end are not held
    "a line of more than 16777216 characters": Way(
        content=gzip.compress(b"t,id,x,y\n" + bytes(2**26))
    ),
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_is_wrong_is_one_line(tmp_path, words):
    path, source = people.put(tmp_path, REFUSED[words])
    line = refused(path, source)
    assert words in line
    assert line.startswith((f"{path}: ", "source TOML: ", f"{source}: "))


def test_a_table_beside_the_logs_that_is_none(tmp_path):
    people.write(tmp_path, rows())
    (tmp_path / "README.csv").write_text("file,what\nlog.csv,the flight of monday\n")
    line = refused(tmp_path, people.spec(tmp_path))
    assert "README.csv: header: ['file', 'what']: none of the columns t, id, x" in line
    assert "`pattern` of the TOML leaves out" in line
    source = people.spec(tmp_path, more='pattern = "log*.csv"')
    people.assert_same(people.only(tmp_path, source))


NORTH = ("t", "id", "Northing X", "Easting Y", *people.HEADER[4:])


def test_a_mirrored_compass_is_refused(tmp_path):
    """Surveyors' X is north: as x it mirrors the world, unless one axis is turned."""
    path = people.write(tmp_path, people.rows(0.4), NORTH)
    named = dict(zip(people.HEADER, NORTH, strict=True))
    with pytest.raises(InputError, match="x is called north and y east: swap them"):
        people.read(path, people.spec(tmp_path, named))
    turned = {**named, "y": "-Easting Y"}
    turned.pop("heading")
    (made,) = people.read(path, people.spec(tmp_path, turned))
    way = made.tracks[0]
    rise = np.arctan2(way.y[-1] - way.y[0], way.x[-1] - way.x[0])
    assert rise == pytest.approx(-0.4, abs=0.01)


CURVE = 0.785 + 0.2 * np.sin(np.arange(120) / 40.0)  # rad, direction of travel


def curved(folder, convention):
    """Cars in a slight curve about 45 degrees, where compass and mathematics agree."""
    sign, zero = {"ccw": (1.0, 0.0), "cw": (-1.0, 90.0)}[convention]
    table, places = [], {}
    for k in range(120):
        turn = CURVE[k]
        for car in range(4):
            x, y = places.get(car, (0.0, 40.0 * car))
            table.append([0.1 * k, f"c{car}", x, y, sign * np.rad2deg(turn) + zero])
            places[car] = x + 1.5 * np.cos(turn), y + 1.5 * np.sin(turn)
    return people.write(folder, table, people.HEADER[:5])


@pytest.mark.parametrize("convention", ["ccw", "cw"])
def test_headings_must_turn_as_the_motion_does(tmp_path, convention):
    """The median offset is small both ways; the turns in the curve tell."""
    path = curved(tmp_path, convention)
    names = {"ccw": "ccw_from_x", "cw": "cw_from_north"}
    units, columns = 'heading = "deg"', people.HEADER[:5]
    for own, name in names.items():
        source = people.spec(
            tmp_path, columns, units, more=f'heading_convention = "{name}"'
        )
        if own == convention:
            (made,) = people.read(path, source)
            off = made.tracks[0].heading - CURVE
            assert np.abs(off).max() < 0.02
            continue
        with pytest.raises(InputError, match="in curves it turns against") as caught:
            people.read(path, source)
        hint = f'"{names[convention]}" with units.heading = "deg" fits'
        assert hint in str(caught.value)
    (made,) = people.read(path, people.spec(tmp_path, columns, units))
    off = made.tracks[0].heading - CURVE
    assert np.abs(off).max() < 0.02
