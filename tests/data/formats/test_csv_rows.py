"""Rows that are wrong: unreadable, repeated, far away; ids and clocks met again."""

import datetime

import numpy as np
import pyproj
import pytest

from rcirl_jax.data.importing import import_logs
from rcirl_jax.data.inputs import input_files
from rcirl_jax.data.quality import format_quality
from tests.data.formats import people
from tests.data.formats.fixtures import has_note
from tests.data.formats.people import LONG, refused, write
from tests.data.small_logs import CONFIG


@LONG
@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("x", "", "line 12: x: '': expected a finite number"),
        ("y", "inf", "line 12: y: 'inf': expected a finite number"),
        ("y", "12..5", "line 12: y: '12..5': expected a finite number"),
        ("x", "1e30", "line 12: x: 1e+30: expected within 1e+08"),
        ("id", "", "line 12: id: '': expected a text"),
        ("id", "c" * 65, "line 12: id: 'c" + "c" * 39 + "...': expected up to 64"),
        ("kind", "car,car", "line 12: 9 cells: expected 8"),
        ("kind", '"car', "line 12: a quote without an end"),
    ],
)
def test_a_bad_row_is_dropped_or_named(tmp_path, name, value, words, long_bytes):
    table = people.rows()
    table[10][people.HEADER.index(name)] = value
    path = write(tmp_path, table)
    more = f"long_bytes = {long_bytes}\n"
    found = people.only(path, people.spec(tmp_path, more=more))
    assert people.rows_of(found) == (720, 1, 0, 0)
    assert sum(track.t.size for track in found.tracks) == 719
    assert has_note(found, f"1 unreadable rows dropped; first: {words}")
    line = refused(path, people.spec(tmp_path, more=more + "max_bad_rows = 0.0"))
    assert words in line
    assert line.endswith(
        "1 of 720 rows are bad: expected up to 0 % (max_bad_rows of the TOML)"
    )


@LONG
def test_rows_that_are_met_again_are_used_once(tmp_path, long_bytes):
    """Beside each other and far apart."""
    table = people.rows()
    table = [*table[:101], table[100], *table[101:], table[3], table[3]]
    source = people.spec(tmp_path, more=f"long_bytes = {long_bytes}")
    found = people.only(write(tmp_path, table), source)
    people.assert_same(found)
    assert people.rows_of(found) == (723, 0, 3, 0)
    assert "3 rows met twice, used once" in found.notes
    strict = people.spec(
        tmp_path, more=f"long_bytes = {long_bytes}\nmax_bad_rows = 0.001"
    )
    line = refused(tmp_path / "log.csv", strict)
    assert "line 103: id car4: the same row again; 3 of 723 rows are bad" in line


@LONG
def test_a_road_user_in_two_places_at_once(tmp_path, long_bytes):
    """The row that continues the track is kept, whichever comes first."""
    table = people.rows()
    for at, first in ((300, True), (350, False), (1, True)):
        odd = list(table[at])
        odd[2] += 60.0
        table.insert(at if first else at + 1, odd)
    source = people.spec(tmp_path, more=f"long_bytes = {long_bytes}")
    found = people.only(write(tmp_path, table), source)
    people.assert_same(found)
    assert people.rows_of(found) == (723, 0, 0, 3)
    assert has_note(found, "3 rows of a road user twice in one frame, one used; first")


@LONG
def test_an_import_counts_what_it_dropped(tmp_path, long_bytes):
    table = people.rows()
    table[5][2] = "west"
    table.insert(100, table[100])
    path = write(tmp_path, table)
    source = people.spec(tmp_path, more=f"long_bytes = {long_bytes}")
    manifest = import_logs(input_files("csv", path, source), tmp_path / "data", CONFIG)
    assert manifest.quality["rows"] == {"read": 721, "unreadable": 1, "repeated": 1}
    said = format_quality(manifest.quality)
    assert "rows dropped: 2 of 721 (0.28%): 1 unreadable, 1 repeated" in said
    assert any("line 7: x: 'west'" in note for note in manifest.quality["notes"])


X, T, LENGTH = (people.HEADER.index(name) for name in ("x", "t", "length"))


def joined(folder, source):
    """Id -> all its samples of t, x, from one recording or from its pieces."""
    found = {}
    for recording in people.read(folder, source):
        low, high = recording.scenes_within or (-np.inf, np.inf)
        for track in recording.tracks:
            own = (track.t >= low) & (track.t < high)
            part = np.stack([track.t, track.x], axis=1)[own]
            found.setdefault(track.id, []).append(part)
    return {user: np.concatenate(parts) for user, parts in found.items()}


@LONG
@pytest.mark.parametrize("place", [9999.0, -1e5])
def test_a_place_far_away_for_a_moment_is_dropped(tmp_path, place, long_bytes):
    table = people.rows()
    away = (100, 333, 339, 719)  # of cars 4, 3, 3 at once, and 5 at its end
    for row in away:
        table[row][X] = place
    path = people.write(tmp_path, table)
    source = people.spec(tmp_path, more=f"long_bytes = {long_bytes}")
    found = people.only(path, source)
    for car, track in enumerate(found.tracks):
        kept = [k for k in range(120) if 6 * k + car not in away]
        np.testing.assert_allclose(track.t, np.array(kept) / 10, atol=1e-5)
        own = [people.rows()[6 * k + car][X] for k in kept]
        np.testing.assert_allclose(track.x, own, atol=0.002)
    assert people.rows_of(found) == (720, 4, 0, 0)
    assert has_note(found, "line 102: id car4: x, y: ")


@LONG
def test_an_id_that_goes_on_elsewhere_is_somebody_else(tmp_path, long_bytes):
    """Also over the border of a minute, at which a long file is cut."""
    table = []
    for row in people.rows():
        later = [row[T] + 60.0, *row[1:]]
        later[X] += 900.0
        later[LENGTH] = 9.0 if row[1] == "car0" else row[LENGTH]
        table += [[row[T] + 48.0, *row[1:]], later]
    table.sort(key=lambda row: row[T])
    path = people.write(tmp_path, table)
    source = people.spec(tmp_path, more=f"long_bytes = {long_bytes}")
    found = joined(path, source)
    assert sorted(found) == sorted(f"car{k}{n}" for k in range(6) for n in ("", "#2"))
    assert {part.shape for part in found.values()} == {(120, 2)}
    sizes = {t.id: t.length for made in people.read(path, source) for t in made.tracks}
    assert (sizes["car0"], sizes["car0#2"]) == (4.5, 9.0)


@LONG
@pytest.mark.parametrize("form", ["%H:%M:%S.%f", "%I:%M:%S.%f %p"])
@pytest.mark.parametrize("by_car", [False, True])
def test_a_time_of_day_passes_midnight(tmp_path, form, by_car, long_bytes):
    start = datetime.datetime(2024, 5, 31, 23, 59, 54)

    def clock(t):
        return (start + datetime.timedelta(seconds=t)).strftime(form)

    table = people.column(people.rows(), "t", clock)
    if by_car:
        table.sort(key=lambda row: row[1])
    path = people.write(tmp_path, table)
    unit = "" if form.startswith("%H") else f't = "{form}"'
    source = people.spec(tmp_path, units=unit, more=f"long_bytes = {long_bytes}")
    found = joined(path, source)
    assert sorted(found) == [f"car{k}" for k in range(6)]
    for part in found.values():
        np.testing.assert_allclose(part[:, 0], np.arange(120) / 10, atol=1e-5)
        assert np.all(np.diff(part[:, 1]) > 0.0)


@LONG
@pytest.mark.parametrize("first", [-180.0, 0.0])
def test_longitudes_over_the_180th_meridian(tmp_path, first, long_bytes):
    """Cars on both sides of it from the first row on, some of which pass it."""
    place = pyproj.Proj(proj="tmerc", ellps="WGS84", lat_0=-17.8, lon_0=180.0, k=1.0)
    table = []
    for row in people.rows():
        east, south = place(row[X] + 20.0, row[X + 1], inverse=True)
        east = (east - first) % 360.0 + first
        table.append([*row[:X], f"{east:.9f}", f"{south:.9f}", *row[X + 2 :]])
    header = ["lon" if h == "x" else "lat" if h == "y" else h for h in people.HEADER]
    columns = dict(zip(people.HEADER, header, strict=True))
    path = people.write(tmp_path, table, header)
    more = f"long_bytes = {long_bytes}"
    people.assert_same(people.only(path, people.spec(tmp_path, columns, more=more)))


def as_digits(start, form):
    """Seconds since a time of day, as digits."""

    def cell(t):
        moment = start + datetime.timedelta(seconds=round(t, 3))
        text = moment.strftime(form.replace("%L", f"{moment.microsecond // 1000:03d}"))
        return str(int(text)) if form == "%-H%M%S%L" else text

    return cell


def digits(folder, form, start, unit="", more=""):
    """(log, source TOML) of the drive at times of day as digits."""
    clock = as_digits(datetime.datetime(2024, 5, 31, *start), form)
    path = people.write(folder, people.column(people.rows(), "t", clock))
    return path, people.spec(folder, units=unit and f't = "{unit}"', more=more)


DIGITS = [  # unit, form (%L: milliseconds; a number loses its zeros)
    ("HHMMSSmmm", "%-H%M%S%L"),
    ("HHMMSS", "%H%M%S.%L"),
    ("%Y%m%d%H%M%S%f", "%Y%m%d%H%M%S%L"),
]
STARTS = [(8, 4, 54), (8, 59, 54), (23, 59, 54)]


@LONG
@pytest.mark.parametrize(("unit", "form"), DIGITS)
@pytest.mark.parametrize("start", STARTS[1:])
def test_times_as_digits(tmp_path, unit, form, start, long_bytes):
    """A minute ends, an hour ends, a day ends: no hole of 40 s."""
    found = joined(*digits(tmp_path, form, start, unit, f"long_bytes = {long_bytes}"))
    assert sorted(found) == [f"car{k}" for k in range(6)]
    for part in found.values():
        np.testing.assert_allclose(part[:, 0], np.arange(120) / 10, atol=1e-5)


@pytest.mark.parametrize("form", ["%H%M%S%L", "%H%M%S.%L", "%Y%m%d%H%M%S%L"])
def test_digits_that_can_only_be_times_are_recognised(tmp_path, form):
    found = people.only(*digits(tmp_path, form, (8, 4, 54)))
    assert found.start_s % 86400.0 == 8 * 3600 + 4 * 60 + 54
    people.assert_same(found)
    assert any(note.startswith("column t: times as ") for note in found.notes)


@pytest.mark.parametrize("unit", ["ms", "s"])
def test_a_unit_that_leaves_a_hole_in_each_minute(tmp_path, unit):
    forms = {"ms": ("%-H%M%S%L", "HHMMSSmmm"), "s": ("%-H%M%S.%L", "HHMMSS")}
    form, right = forms[unit]
    log, source = digits(tmp_path, form, STARTS[0], unit)
    assert refused(log, source) == (
        f"{log}: units.t: {unit}: no row has seconds 60 to 99, and those after 59 are "
        f'of the next minute: expected units.t = "{right}" (times as digits)'
    )
