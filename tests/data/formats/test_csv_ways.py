"""One drive in every way that people write it: layouts, packing, units, conventions.

Each is the same six cars (`people.rows`), and the same recording comes out.
"""

import bz2
import datetime
import decimal
import gzip
import io
import math

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet as pq
import pyproj
import pytest

from rcirl_jax.data.formats.csv.columns import CONVENTIONS
from tests.data.formats import people
from tests.data.formats.people import HEADER, Way, column, of, rows, text

# ----------------------------------------------------------------------- layouts


def lines(change, between=","):
    """The lines of the table, header first, changed."""
    return "\n".join(change(text(rows(), between=between).splitlines()))


def above(*more):
    return "\n".join([*more, text(rows(), between=";")])


def units_below(*cells):
    return lines(lambda found: [found[0], ",".join(cells), *found[1:], ""])


def remarks():
    """A column of remarks over several lines, with delimiters inside."""
    table = [[*row, f'"a, b\n{k}"'] for k, row in enumerate(rows())]
    return text(table, (*HEADER, "remark"))


def numbered(found):
    """As R writes them: a name before each row, none above."""
    return [found[0], *(f'"{k}" {row}' for k, row in enumerate(found[1:], 1)), ""]


LAYOUTS = {
    "units below": units_below("s", "", "m", "m", "rad", "m/s", "m", ""),
    "units in brackets": units_below("[s]", "[-]", *["[m]"] * 2, *["[1]"] * 4),
    "commas": text(rows()),
    "tabs": text(rows(), between="\t"),
    "pipes": text(rows(), between="|"),
    "blanks": text(rows(), between=" "),
    "aligned": lines(
        lambda found: [
            " ".join(f"{c:>12}" for c in line.split(",")) for line in found
        ]
    ),
    "a blank behind": text(rows(), between=", "),
    "a blank behind, quoted": text(rows(), between=", ", quote='"'),
    "decimal commas": text(rows(), between=";", decimal=","),
    "decimal commas, quoted": text(rows(), decimal=",", quote='"'),
    "quoted": text(rows(), quote='"'),
    "single quotes": text(rows(), between=";", quote="'"),
    "Windows' line ends": text(rows(), end="\r\n"),
    "old Mac's line ends": text(rows(), end="\r"),
    "a line sep=": "sep=;\n" + text(rows(), between=";"),
    "comments as wide as the table": above(
        "# site; A40; 1; 2; 3; north; south; 7", "# t; x; in; SI; units; by; us; all"
    ),
    "a title above": above("Flight 42", "", "site; A40"),
    "a hash before the header": "# " + text(rows(), between=" "),
    # every row ends in a delimiter, the header's does not
    "delimiters at the ends": lines(
        lambda found: [found[0], *(row + ";" for row in found[1:]), ""], ";"
    ),
    "row names": lines(numbered, " "),
    # as pandas writes it: an unnamed number in front
    "index column": lines(
        lambda found: [
            f",{found[0]}", *(f"{k},{row}" for k, row in enumerate(found[1:])), ""
        ]
    ),
    "empty lines": lines(lambda found: [*found[:40], "", "   ", *found[40:], "", ""]),
    "remarks of several lines": remarks(),
    "no newline at the end": text(rows()).rstrip("\n"),
}  # fmt: skip
ENCODINGS = {
    **dict.fromkeys(("utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"), "Länge"),
    # names that the source TOML says tell encodings apart
    **{"cp1252": "Longueur à", "cp1250": "Długość", "cp1251": "Длина"},
    **{"cp1253": "Μήκος", "cp1254": "Uzunluğu ş", "shift_jis": "長さ"},
    "gb18030": "长度",
}
ENCODED = {
    encoding: Way(
        content=text(rows(), (*HEADER[:6], name, "kind"), between=";").encode(encoding),
        columns={**{c: c for c in HEADER}, "length": name},
    )
    for encoding, name in ENCODINGS.items()
}
NAMES = f"names = {list(HEADER)}".replace("'", '"')
# what the TOML says wins
SAID = {
    'delimiter = "^"': text(rows(), between="^"),
    'delimiter = "semicolon"': text(rows(), between=";"),
    'delimiter = "tab"\ndecimal = ","': text(rows(), between="\t", decimal=","),
    "quote = '\"'": text(rows(), quote='"'),
    "skip = 3": "a,a,a,a,a,a,a,b\n" * 3 + text(rows()),
    NAMES: text(rows()).partition("\n")[2],
}


def thousands(mark, point, between):
    """UTM coordinates as a spreadsheet shows them: 5.702.001,760."""

    def grouped(value):
        return f"{value:,.3f}".translate({ord(","): mark, ord("."): point})

    table = column(rows(), "x", lambda x: grouped(x + 588_000.0))
    table = column(table, "y", lambda y: grouped(y + 5_702_000.0))
    return text(table, between=between, decimal=point)


THOUSANDS = {
    f"thousands by {mark!r}": thousands(mark, point, between)
    for mark, point, between in (
        *((",", ".", ";"), (".", ",", ";"), (" ", ",", ";")),
        *(("'", ".", ","), ("\u202f", ",", ";")),
    )
}
PLAIN = text(rows(), between=";").encode()
PACKED = {
    "gzip": gzip.compress(PLAIN),
    "bz2": bz2.compress(PLAIN),
    "zstd": pa.compress(PLAIN, "zstd", asbytes=True),
}

# ------------------------------------------------------------- columns of a type


def cells_of(name):
    return [row[HEADER.index(name)] for row in rows()]


def stored(write, **changed):
    """The file of a table in columns."""
    out = io.BytesIO()
    write(pa.table({**{name: cells_of(name) for name in HEADER}, **changed}), out)
    return out.getvalue()


BEGIN = datetime.datetime(2024, 5, 20, 10)
NAIVE = [BEGIN + datetime.timedelta(seconds=round(t, 3)) for t in cells_of("t")]
STAMPS = [stamp.replace(tzinfo=datetime.UTC) for stamp in NAIVE]
TYPES = {
    "as they are": {},
    "texts as categories": {
        name: pa.array(cells_of(name)).dictionary_encode() for name in ("id", "kind")
    },
    "single precision": {
        name: pa.array(cells_of(name), pa.float32())
        for name in ("x", "y", "heading", "speed")
    },
    "time stamps": {"t": pa.array(STAMPS, pa.timestamp("us", "UTC"))},
    "time stamps without a zone": {"t": pa.array(NAIVE, pa.timestamp("ms"))},
    "spans of time": {
        "t": pa.array([round(1e9 * t) for t in cells_of("t")], pa.duration("ns"))
    },
    "numbers as text": {"x": [f"{x:.4f}" for x in cells_of("x")]},
    "decimal commas as text": {
        "x": [f"{x:.4f}".replace(".", ",") for x in cells_of("x")]
    },
    "decimals": {"x": pa.array([decimal.Decimal(f"{x:.3f}") for x in cells_of("x")])},
    "with an index": {"__index_level_0__": list(range(720))},
    "with lists": {"cov": [[1.0, 2.0]] * 720},
}
COLUMNAR = {
    f"{form}: {name}": Way(
        content=stored(write, **changed),
        place=0.02 if name == "single precision" else 0.002,
    )
    for form, write, types in (
        ("Parquet", pq.write_table, TYPES),
        ("Feather", pyarrow.feather.write_feather, {"as they are": {}}),
    )
    for name, changed in types.items()
}

# ------------------------------------------------------------------------- times


def stamp(form):
    """Time [s] -> text; the drive begins on 20 May 2024 at ten."""
    return lambda t: form.format(
        int(10 + t // 3600), int(t % 3600 // 60), round(t % 60, 3)
    )


ISO = {
    "ISO": stamp("2024-05-20T{:02d}:{:02d}:{:06.3f}"),
    "ISO in UTC": stamp("2024-05-20T{:02d}:{:02d}:{:06.3f}Z"),
    "ISO with a zone": stamp("2024-05-20T{:02d}:{:02d}:{:06.3f}+02:00"),
    "ISO with a zone behind a blank": stamp("2024-05-20 {:02d}:{:02d}:{:06.3f} +0530"),
    "ISO with a blank": stamp("2024-05-20 {:02d}:{:02d}:{:06.3f}"),
    "ISO with a comma": lambda t: f'"2024-05-20 10:00:{t:06.3f}"'.replace(".", ","),
    "ISO with nanoseconds": stamp("2024-05-20 {:02d}:{:02d}:{:06.3f}000000"),
    "a clock": stamp("{:02d}:{:02d}:{:06.3f}"),
    "ISO, short": lambda t: f"20240520T1000{t:06.3f}",
}
PATTERNS = {
    "%d.%m.%Y %H:%M:%S.%f": stamp("20.05.2024 {:02d}:{:02d}:{:06.3f}"),
    "%m/%d/%Y %I:%M:%S.%f %p": stamp("05/20/2024 {:02d}:{:02d}:{:06.3f} AM"),
    "%Y%m%d-%H%M%S.%f": stamp("20240520-{:02d}{:02d}{:06.3f}"),
}
TIMES = {
    **{
        name: of(column(rows(), "t", form), note="ISO times")
        for name, form in ISO.items()
    },
    **{
        pattern: of(column(rows(), "t", form), units=f't = "{pattern}"')
        for pattern, form in PATTERNS.items()
    },
    **{
        f"{pattern}, recognised": of(
            column(rows(), "t", PATTERNS[pattern]), note=f"column t: times as {pattern}"
        )
        for pattern in ("%d.%m.%Y %H:%M:%S.%f", "%m/%d/%Y %I:%M:%S.%f %p")
    },
}

# ------------------------------------------------------------------------ places

MIDDLE = (37.97, 23.73)  # Athens


def degrees(table, form="{:.9f}", factor=1.0):
    """Rows with longitude and latitude for x and y, by another projection."""
    place = pyproj.Proj(proj="aeqd", ellps="WGS84", lat_0=MIDDLE[0], lon_0=MIDDLE[1])
    found = []
    for row in table:
        lon, lat = place(row[2], row[3], inverse=True)
        cells = [form.format(value * factor) for value in (lon, lat)]
        found.append([*row[:2], *cells, *row[4:]])
    return found


def named(*names, turned=False):
    """Degrees in columns of such names; turned: told by their names all the same."""
    header = (*HEADER[:2], *names, *HEADER[4:])
    fields = {name: name for name in HEADER}
    fields |= dict(zip("yx" if turned else "xy", names, strict=True))
    return of(degrees(rows()), header, columns=fields, place=0.01)


DEGREES = [
    *(("lon", "lat"), ("Longitude", "Latitude"), ("gps_lng", "gps_lat")),
    *(("positionLon", "positionLat"), ("GPSLongitude", "GPSLatitude")),
    ("LONG [deg]", "LAT [deg]"),
]
IN_DEGREES = 'x = "deg"\ny = "deg"'
PLACES = {
    **{" ".join(names): named(*names) for names in DEGREES},
    **{f"{names[1]}, turned": named(*names, turned=True) for names in DEGREES[:2]},
    "degrees": of(degrees(rows()), units=IN_DEGREES, place=0.02),
    "radians": of(
        degrees(rows(), "{:.11f}", math.pi / 180.0),
        units='x = "rad"\ny = "rad"',
        place=0.02,
    ),
    "whole numbers": of(
        degrees(rows(), "{:.0f}", 1e7),
        units=IN_DEGREES,
        rest="[scale]\nx = 1e-7\ny = 1e-7",
        place=0.02,
    ),
    "fields lat and lon": of(
        degrees(rows()),
        (*HEADER[:2], "a", "b", *HEADER[4:]),
        columns={n: n for n in HEADER if n not in "xy"} | {"lon": "a", "lat": "b"},
        place=0.01,
    ),
}

# ---------------------------------------------------------- headings, velocities


def heading_as(convention, unit):
    """Heading [rad] ccw from x -> the file's, with what rounding leaves."""
    sign, zero = CONVENTIONS[convention]
    factor = 1.0 if unit == "rad" else 180.0 / math.pi
    return lambda h: f"{(sign * (h - zero)) % (2.0 * math.pi) * factor:.4f}"


def headed(convention, unit, said):
    table = column(rows(-2.0), "heading", heading_as(convention, unit))
    more = f'heading_convention = "{convention}"' if said == "all" else ""
    units = "" if said == "nothing" else f'heading = "{unit}"'
    is_usual = more or convention == "ccw_from_x"
    note = "" if is_usual else f"headings read as {convention}"
    return of(table, turn=-2.0, units=units, more=more, note=note)


HEADINGS = {
    f"{convention} {unit}, {said} said": headed(convention, unit, said)
    for convention in CONVENTIONS
    for unit in ("rad", "deg")
    for said in ("nothing", "unit", "all")
}
VELOCITY = (*HEADER[:4], "vx", "vy", *HEADER[6:])


def moving(change):
    """Rows with two more cells for heading and speed, of a road turned by 0.7."""
    return [[*row[:4], *change(row[5]), *row[6:]] for row in rows(0.7)]


def along(v):
    return v * math.cos(0.7), v * math.sin(0.7)


VELOCITIES = {
    "velocities": of(moving(along), VELOCITY, turn=0.7, speed=0.002, angle=0.001),
    "velocities in km/h, y down": of(
        [[*r[:3], -r[3], 3.6 * r[4], -3.6 * r[5], *r[6:]] for r in moving(along)],
        VELOCITY,
        columns={name: name for name in VELOCITY} | {"y": "-y", "vy": "-vy"},
        units='vx = "km/h"\nvy = "km/h"',
        turn=0.7,
        speed=0.01,
    ),
    "along and across the car": of(
        moving(lambda v: (v, 0.0)),
        VELOCITY,
        turn=0.7,
        speed=0.002,
        note="vx, vy contradict the direction",
    ),
    "beside heading and speed": of(
        [[*row, 99.0, 99.0] for row in rows()], (*HEADER, "vx", "vy"), speed=0.002
    ),
}
# raw numbers of a bus: 0.01 km/h from -40, decimetres
RAW = column(rows(), "speed", lambda v: round((3.6 * v + 40) * 100))
RAW = column(RAW, "x", lambda x: f"{10.0 * (x + 500.0):.2f}")
SCALE = "[scale]\nspeed = 0.01\nx = 0.1\n[offset]\nspeed = -40.0\nx = -500.0"


def unknown(empty):
    """Half the speeds and headings, most lengths and kinds are not known."""
    table = rows()
    for k, row in enumerate(table):
        known = (k % 2, k % 3, k % 11 == 0, k % 13 == 0)
        row[4:] = [
            x if is_known else empty for x, is_known in zip(row[4:], known, strict=True)
        ]
    return table


EMPTY = ["", "NaN", "nan", "NA", "N/A", "null", "None", "-", "\\N", "#N/A", " "]
# as SUMO's table has them: frames without anybody
NOBODY = [[f"{-0.1 * k:.1f}", *[""] * 7] for k in range(200, 0, -1)]
SHUFFLED = [rows()[k] for k in np.random.default_rng(0).permutation(720)]
UPPER = ["T", "Id", "X", "Y", "Heading", "SPEED", "Length", "kind"]
WAYS = {
    **{n: Way(content=x) for n, x in {**LAYOUTS, **THOUSANDS, **PACKED}.items()},
    **ENCODED,
    **{n: Way(content=x, rest=f"[table]\n{n}") for n, x in SAID.items()},
    **COLUMNAR,
    **TIMES,
    **PLACES,
    **HEADINGS,
    **VELOCITIES,
    "scale and offset": of(RAW, units='speed = "km/h"', rest=SCALE, speed=0.01),
    **{f"empty: {cell!r}": of(unknown(cell)) for cell in EMPTY},
    "frames without anybody": of([*NOBODY, *rows()]),
    "rows in any order": of(SHUFFLED),
    "names in another case": of(rows(), UPPER, columns=HEADER),
    "a name in its own case wins": of(
        [[*row, 1e3 - row[2]] for row in rows()], (*HEADER, "X"), columns=HEADER
    ),
}


@pytest.mark.parametrize("name", WAYS)
def test_the_same_drive(tmp_path, name):
    """Every other one read in pieces, as a long file is."""
    way = WAYS[name]
    long_bytes = 1 if list(WAYS).index(name) % 2 else 10**9
    found = people.only(*people.put(tmp_path, way, f"long_bytes = {long_bytes}"))
    near = {"place": way.place, "angle": way.angle, "speed": way.speed}
    people.assert_same(found, way.turn, **near)
    assert people.rows_of(found) == (720, 0, 0, 0)
    assert way.note in "\n".join(found.notes)
