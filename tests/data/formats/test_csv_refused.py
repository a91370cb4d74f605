"""Tables and source TOMLs that are wrong: one line each, with what to do."""

import gzip

import numpy as np
import pytest

from rcirl_jax.errors import InputError
from tests.data.formats import people
from tests.data.formats.people import HEADER, Way, column, of, refused, rows, text
from tests.data.formats.test_csv_meaning import wide_frames
from tests.data.formats.test_csv_ways import ISO, degrees, heading_as


def scaled(name, factor):
    """The drive with a column in another unit than the TOML says."""
    return of(column(rows(), name, lambda value: value * factor))


def headed(change, **options):
    return of(column(rows(0.5), "heading", change), **options)


RAD, DEG = 'heading = "rad"', 'heading = "deg"'
USUAL = 'heading_convention = "ccw_from_x"'
AUTOMATED = (*HEADER, "automated")
WIDE, FRAMES = wide_frames("{axis}_{car}")
IN_FEET = [
    [*r[:2], *(v / 0.3048 for v in r[2:4]), *r[4:6], r[6] / 0.3048, r[7]]
    for r in rows()
]
REFUSED = {
    "no header? name the columns by names in [table]": Way(
        content=text(rows()).partition("\n")[2]
    ),
    # the layout
    "table: separator: unknown: expected delimiter": of(
        rows(), rest='[table]\nseparator = ";"'
    ),
    "table.delimiter: ab: expected one of tab": of(
        rows(), rest='[table]\ndelimiter = "ab"'
    ),
    # a row per frame
    "columns.x: px_{id}: expected columns of this name and of y_{id}": of(
        FRAMES, WIDE, columns={"t": "time", "x": "px_{id}", "y": "y_{id}"}
    ),
    # columns and lanes
    "columns.y: missing": of(rows(), columns=("t", "id", "x")),
    "columns.x: id: expected a column of numbers": of(
        rows(), columns={"t": "t", "id": "id", "x": "id", "y": "y"}
    ),
    "units.x: yard": of(rows(), units='x = "yard"'),
    # units and numbers that no road user has
    "feet taken for metres": of(IN_FEET),
    "km/h taken for m/s": scaled("speed", 3.6),
    "t: median step 1: expected at most 0.55": scaled("t", 10.0),
    "t: median step 0.2 s: expected 0.1 s": scaled("t", 2.0),
    # times
    "units.t: ms: the cells of t are such as '2024-05-20T10:00:00.000'": of(
        column(rows(), "t", ISO["ISO"]), units='t = "ms"'
    ),
    # all unknown kinds of the file at once
    "kind: bus, tractor: expected one of": of(
        column(rows(), "kind", {"car": "tractor", "truck": "bus"}.get)
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
    "did you mean speed_limit?": of(rows(), more="speedlimit = 20.0"),
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
TURNING = {
    "ccw_from_x": lambda h: np.rad2deg(h),
    "cw_from_north": lambda h: 90.0 - np.rad2deg(h),
}


@pytest.mark.parametrize("convention", TURNING)
def test_headings_must_turn_as_the_motion_does(tmp_path, convention):
    """In a slight curve about 45 degrees the median offset is small both ways."""
    x, y = (np.cumsum(1.5 * f(CURVE)) for f in (np.cos, np.sin))
    columns = [0.1 * np.arange(120), x, y, TURNING[convention](CURVE)]
    header, units = ("t", "x", "y", "heading", "id"), 'heading = "deg"'
    table = [[*row, "c"] for row in np.stack(columns, axis=1).tolist()]
    path = people.write(tmp_path, table, header)
    for name in (*TURNING, ""):
        more = f'heading_convention = "{name}"' if name else ""
        source = people.spec(tmp_path, header, units, more)
        if name in (convention, ""):
            heading = people.only(path, source).tracks[0].heading
            np.testing.assert_allclose(heading, CURVE, atol=0.02)
        else:
            line = refused(path, source)
            assert "in curves it turns against" in line
            assert f'"{convention}" with units.heading = "deg" fits' in line
