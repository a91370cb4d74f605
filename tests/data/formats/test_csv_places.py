"""Places where nobody can be, ids given again, and clocks that pass midnight."""

import datetime

import numpy as np
import pyproj
import pytest

from tests.data.formats import people
from tests.data.formats.people import LONG

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
    assert any("line 102: id car4: x, y: " in note for note in found.notes)


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
