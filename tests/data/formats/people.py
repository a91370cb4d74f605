"""A drive as people hand it over: the same rows in every layout that tables have."""

import dataclasses
import functools

import numpy as np
import pytest

from tests.helpers import logs

CARS, SECONDS, RATE = 6, 12.0, 10.0
LANE_M = 3.5
LONG = pytest.mark.parametrize(
    "long_bytes", [1, 10**9], ids=["in pieces", "whole"]
)  # both ways in which a table is read
HEADER = ("t", "id", "x", "y", "heading", "speed", "length", "kind")


def rows(turn=0.0):
    """Six cars on two lanes of a road that runs `turn` rad from the x axis.

    Each is (t s, id, x m, y m, heading rad, speed m/s, length m, kind).
    """
    found = []
    for k in range(round(SECONDS * RATE)):
        t = k / RATE
        for car in range(CARS):
            along = 15.0 * t + 2.0 * np.sin(0.4 * t) - 25.0 * car
            aside = -LANE_M * (car % 2)
            speed = 15.0 + 0.8 * np.cos(0.4 * t)
            x = along * np.cos(turn) - aside * np.sin(turn)
            y = along * np.sin(turn) + aside * np.cos(turn)
            kind = "truck" if car == 5 else "car"
            length = 12.0 if car == 5 else 4.5
            found.append([t, f"car{car}", x, y, turn, speed, length, kind])
    return found


def column(table, name, change, header=HEADER):
    """Rows with `change` of the cells of one column."""
    at = header.index(name)
    return [[*row[:at], change(row[at]), *row[at + 1 :]] for row in table]


def cell(value, decimal="."):
    """A cell as text, numbers with three decimals."""
    return (
        f"{value:.3f}".replace(".", decimal) if isinstance(value, float) else str(value)
    )


def text(table, header=HEADER, *, between=",", decimal=".", end="\n", quote=""):
    """A table of text."""
    lines = [[*header], *([cell(value, decimal) for value in row] for row in table)]
    joined = (between.join(f"{quote}{c}{quote}" for c in line) for line in lines)
    return end.join([*joined, ""])


SPEC = """
{more}
[columns]
{columns}
[units]
{units}
[kinds]
car = "vehicle"
truck = "vehicle"
{rest}
"""


def spec(folder, columns=HEADER, units="", more="", rest=""):
    """A source TOML; `columns` may be a dict field -> column."""
    named = columns if isinstance(columns, dict) else {c: c for c in columns}
    lines = "\n".join(f'{field} = "{name}"' for field, name in named.items())
    path = folder / "map.toml"
    path.write_text(SPEC.format(more=more, columns=lines, units=units, rest=rest))
    return path


@dataclasses.dataclass(frozen=True, kw_only=True)
class Way:
    """A file, what its source TOML says, and how near to the drive it is read."""

    content: str | bytes
    columns: dict | tuple = HEADER
    units: str = ""
    more: str = ""
    rest: str = ""
    turn: float = 0.0  # rad, of the road
    place: float = 0.002  # m
    angle: float = 0.02  # rad
    speed: float = 0.35  # m/s
    note: str = ""  # a part of a note of the recording


def of(table, header=HEADER, **options):
    """A table with commas; its columns are named as they are."""
    return Way(content=text(table, header), **{"columns": tuple(header), **options})


def put(folder, way, more=""):
    """(log, source TOML) of a way, written into a folder."""
    path, content = folder / "log.csv", way.content
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    more = f"{more}\n{way.more}"
    options = {"units": way.units, "more": more, "rest": way.rest}
    return path, spec(folder, way.columns, **options)


def write(folder, table, header=HEADER, **layout):
    """log.csv, a table of text."""
    path = folder / "log.csv"
    path.write_text(text(table, header, **layout))
    return path


read, only = functools.partial(logs.read, "csv"), functools.partial(logs.only, "csv")


def refused(path, source):
    """The line with which a table is refused."""
    return logs.refused(read, path, source)


def assert_same(found, turn=0.0, *, place=0.002, angle=0.02, speed=0.35):
    """A recording of the drive: every road user, where it was, how it moved."""
    expected = {}
    for t, name, x, y, *_ in rows(turn):
        expected.setdefault(name, []).append((t, x, y))
    assert [track.id for track in found.tracks] == sorted(expected)
    for track in found.tracks:
        t, x, y = np.array(expected[track.id]).T
        np.testing.assert_allclose(track.t, t, atol=1e-5)
        # large coordinates have a local origin, and projections their middle
        shift = np.array([np.median(track.x - x), np.median(track.y - y)])
        np.testing.assert_allclose(track.x - shift[0], x, atol=place)
        np.testing.assert_allclose(track.y - shift[1], y, atol=place)
        off = np.angle(np.exp(1j * (track.heading - turn)))
        assert np.abs(off).max() < angle, (track.id, off)
        real = 15.0 + 0.8 * np.cos(0.4 * t)
        assert np.abs(track.speed - real).max() < speed
        assert track.length == (12.0 if track.id == "car5" else 4.5)


def rows_of(found):
    """(read, unreadable, repeated, doubled)."""
    return tuple(vars(found.rows).values())
