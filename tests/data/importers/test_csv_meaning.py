"""What a user's columns mean: times, places, headings, velocities, flags, wide rows."""

import math

import numpy as np
import pyproj
import pytest

from rcirl_jax.data.importers.csv.heading import CONVENTIONS
from rcirl_jax.data.importers.projection import projected
from tests.data.importers import people
from tests.data.importers.people import LONG, refused, write

# ------------------------------------------------------------------------- times


def stamp(form):
    """Time [s] -> text; the drive begins on 20 May 2024 at ten."""
    return lambda t: form.format(
        int(10 + t // 3600), int(t % 3600 // 60), round(t % 60, 3)
    )


TIMES = {
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


@LONG
@pytest.mark.parametrize("form", TIMES)
def test_iso_times(tmp_path, form, long_bytes):
    table = people.column(people.rows(), "t", TIMES[form])
    more = f"long_bytes = {long_bytes}"
    found = people.only(write(tmp_path, table), people.spec(tmp_path, more=more))
    people.assert_same(found)
    assert any("ISO times" in note for note in found.notes)


@pytest.mark.parametrize(
    ("pattern", "form"),
    [
        ("%d.%m.%Y %H:%M:%S.%f", stamp("20.05.2024 {:02d}:{:02d}:{:06.3f}")),
        ("%m/%d/%Y %I:%M:%S.%f %p", stamp("05/20/2024 {:02d}:{:02d}:{:06.3f} AM")),
        ("%Y%m%d-%H%M%S.%f", stamp("20240520-{:02d}{:02d}{:06.3f}")),
    ],
)
def test_times_by_a_pattern(tmp_path, pattern, form):
    table = people.column(people.rows(), "t", form)
    source = people.spec(tmp_path, units=f't = "{pattern}"')
    people.assert_same(people.only(write(tmp_path, table), source))


@pytest.mark.parametrize(
    ("pattern", "form"),
    [
        ("%d.%m.%Y %H:%M:%S.%f", stamp("03.05.2024 {:02d}:{:02d}:{:06.3f}")),
        ("%m/%d/%Y %I:%M:%S.%f %p", stamp("05/20/2024 {:02d}:{:02d}:{:06.3f} AM")),
    ],
)
def test_dates_are_recognised(tmp_path, pattern, form):
    path = write(tmp_path, people.column(people.rows(), "t", form))
    found = people.only(path, people.spec(tmp_path))
    people.assert_same(found)
    assert f"column t: times as {pattern}" in found.notes
    line = refused(path, people.spec(tmp_path, units='t = "ms"'))
    assert line.endswith(f"expected {pattern}")


def test_dates_in_a_column_of_seconds_are_named(tmp_path):
    path = write(tmp_path, people.column(people.rows(), "t", TIMES["ISO"]))
    line = refused(path, people.spec(tmp_path, units='t = "ms"'))
    assert "units.t: ms: the cells of t are such as '2024-05-20T10:00:00.000'" in line


def test_a_time_that_is_none_is_named_by_its_line(tmp_path):
    table = people.column(people.rows(), "t", TIMES["ISO"])
    table[10][0] = "2024-13-20T10:00:00"
    line = refused(
        write(tmp_path, table), people.spec(tmp_path, more="max_bad_rows = 0.0")
    )
    assert "line 12: t: '2024-13-20T10:00:00': expected a time as iso" in line


# ------------------------------------------------------------------------ places

MIDDLE = (37.97, 23.73)  # Athens


def degrees(table, form="{:.9f}", factor=1.0):
    """Rows with longitude and latitude for x and y."""
    place = pyproj.Proj(
        proj="aeqd", ellps="WGS84", lat_0=MIDDLE[0], lon_0=MIDDLE[1]
    )  # another projection than the importer's
    found = []
    for row in table:
        lon, lat = place(row[2], row[3], inverse=True)
        cells = [form.format(value * factor) for value in (lon, lat)]
        found.append([*row[:2], *cells, *row[4:]])
    return found


NAMES = [
    ("lon", "lat"),
    ("Longitude", "Latitude"),
    ("gps_lng", "gps_lat"),
    ("positionLon", "positionLat"),
    ("GPSLongitude", "GPSLatitude"),
    ("LONG [deg]", "LAT [deg]"),
]


@pytest.mark.parametrize("names", NAMES)
def test_longitude_and_latitude_by_their_names(tmp_path, names):
    header = [*people.HEADER[:2], *names, *people.HEADER[4:]]
    columns = {name: name for name in people.HEADER} | dict(
        zip("xy", names, strict=True)
    )
    path = write(tmp_path, degrees(people.rows()), header)
    found = people.only(path, people.spec(tmp_path, columns))
    people.assert_same(found, place=0.01)
    # the other way round they are told by their names too
    columns |= dict(zip("yx", names, strict=True))
    people.assert_same(people.only(path, people.spec(tmp_path, columns)), place=0.01)


@pytest.mark.parametrize(
    ("form", "factor", "units", "rest"),
    [
        ("{:.9f}", 1.0, 'x = "deg"\ny = "deg"', ""),
        ("{:.11f}", math.pi / 180.0, 'x = "rad"\ny = "rad"', ""),
        ("{:.0f}", 1e7, 'x = "deg"\ny = "deg"', "[scale]\nx = 1e-7\ny = 1e-7"),
    ],
)
def test_degrees_by_their_units(tmp_path, form, factor, units, rest):
    path = write(tmp_path, degrees(people.rows(), form, factor))
    found = people.only(path, people.spec(tmp_path, units=units, rest=rest))
    people.assert_same(found, place=0.02)


def test_fields_called_lat_and_lon(tmp_path):
    header = [*people.HEADER[:2], "a", "b", *people.HEADER[4:]]
    columns = {n: n for n in people.HEADER if n not in "xy"} | {"lon": "a", "lat": "b"}
    path = write(tmp_path, degrees(people.rows()), header)
    people.assert_same(people.only(path, people.spec(tmp_path, columns)), place=0.01)
    columns["x"] = "a"
    line = refused(path, people.spec(tmp_path, columns))
    assert "columns.lon: a: expected it, or columns.x, not both" in line


def test_degrees_that_nothing_says_are_one_line(tmp_path):
    path = write(tmp_path, degrees(people.rows()))
    line = refused(path, people.spec(tmp_path, people.HEADER[:4]))
    assert line.startswith(f"{path}: x, y: all within 0.00")
    assert 'longitude and latitude? say units.x = "deg", units.y = "deg"' in line
    line = refused(path, people.spec(tmp_path, units='x = "deg"'))
    assert "units.x, units.y: deg and m: expected both" in line


def test_a_receiver_without_a_fix(tmp_path):
    """It is at (0, 0), in the gulf of Guinea."""
    table = degrees(people.rows())
    for k in (100, 101, 300):
        table[k][2] = table[k][3] = "0.0"
    source = people.spec(tmp_path, units='x = "deg"\ny = "deg"')
    found = people.only(write(tmp_path, table), source)
    assert people.rows_of(found) == (720, 3, 0, 0)
    assert sum(track.t.size for track in found.tracks) == 717


def test_lanes_in_degrees(tmp_path):
    place = pyproj.Proj(proj="aeqd", ellps="WGS84", lat_0=MIDDLE[0], lon_0=MIDDLE[1])
    points = [list(place(x, 0.0, inverse=True)) for x in (-200.0, 300.0)]
    rest = f'[[lanes]]\nid = "1"\npoints = {points}'
    source = people.spec(tmp_path, units='x = "deg"\ny = "deg"', rest=rest)
    (lane,) = people.only(write(tmp_path, degrees(people.rows())), source).lanes
    assert np.hypot(*(lane.centre[1] - lane.centre[0])) == pytest.approx(
        500.0, abs=0.05
    )


def test_the_projection_is_true_to_length_and_north():
    """Against geodesics on the ellipsoid: a kilometre in each direction."""
    geod = pyproj.Geod(ellps="WGS84")
    for lat, lon in ((37.97, 23.73), (-33.9, 151.2), (64.1, -21.9), (0.0, 0.0)):
        x0, y0 = projected(np.array([lon]), np.array([lat]), (lat, lon))
        np.testing.assert_allclose([x0, y0], 0.0, atol=1e-6)
        for azimuth in (0.0, 60.0, 150.0, 270.0):
            far_lon, far_lat, _ = geod.fwd(lon, lat, azimuth, 1000.0)
            x, y = projected(np.array([far_lon]), np.array([far_lat]), (lat, lon))
            assert np.hypot(x, y)[0] == pytest.approx(1000.0, abs=0.01)
            compass = np.rad2deg(np.arctan2(x, y))[0] % 360.0
            assert compass == pytest.approx(azimuth, abs=0.01)


# ---------------------------------------------------------------------- headings


def as_written(convention, unit):
    """Heading [rad] ccw from x -> the file's, with what rounding leaves."""
    sign, zero = CONVENTIONS[convention]
    factor = 1.0 if unit == "rad" else 180.0 / math.pi

    def cell(heading):
        return f"{(sign * (heading - zero)) % (2.0 * math.pi) * factor:.4f}"

    return cell


@pytest.mark.parametrize("said", [True, False], ids=["unit said", "unit left out"])
@pytest.mark.parametrize("unit", ["rad", "deg"])
@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("turn", [0.5, -2.0])
def test_conventions_of_headings(tmp_path, turn, convention, unit, said):
    table = people.column(people.rows(turn), "heading", as_written(convention, unit))
    units = f'heading = "{unit}"' if said else ""
    found = people.only(write(tmp_path, table), people.spec(tmp_path, units=units))
    people.assert_same(found, turn)
    if convention != "ccw_from_x":
        assert any(f"headings read as {convention}" in note for note in found.notes)
    declared = f'heading_convention = "{convention}"'
    source = people.spec(tmp_path, units=units, more=declared)
    people.assert_same(people.only(tmp_path / "log.csv", source), turn)


def test_headings_of_noise_keep_the_usual_convention(tmp_path):
    rng = np.random.default_rng(0)
    noisy = lambda heading: heading + rng.normal(0.0, 0.15)  # noqa: E731
    path = write(tmp_path, people.column(people.rows(0.75), "heading", noisy))
    found = people.only(path, people.spec(tmp_path, units='heading = "rad"'))
    assert not any("headings" in note for note in found.notes)


@pytest.mark.parametrize(
    ("cell", "more", "units", "words"),
    [
        (lambda h: h + 2.2, "", 'heading = "rad"', "leave columns.heading out"),
        (
            as_written("ccw_from_x", "deg"),
            "",
            'heading = "rad"',
            'heading_convention = "ccw_from_x" with units.heading = "deg" fits',
        ),
        (
            as_written("cw_from_north", "deg"),
            'heading_convention = "ccw_from_x"',
            'heading = "deg"',
            'heading_convention = "cw_from_north" with units.heading = "deg" fits',
        ),
    ],
)
def test_headings_that_contradict_the_travel(tmp_path, cell, more, units, words):
    path = write(tmp_path, people.column(people.rows(0.5), "heading", cell))
    line = refused(path, people.spec(tmp_path, units=units, more=more))
    assert line.startswith(f"{path}: heading: ")
    assert (
        "degrees from the direction of travel in the median: expected up to 20" in line
    )
    assert words in line


def test_an_unknown_convention(tmp_path):
    path = write(tmp_path, people.rows())
    line = refused(path, people.spec(tmp_path, more='heading_convention = "north"'))
    assert "heading_convention: north: expected one of ccw_from_x, cw_from" in line


# -------------------------------------------------------------------- velocities


def velocities(turn, table=None):
    """Rows with vx, vy instead of heading and speed."""
    found = []
    for row in table or people.rows(turn):
        v = row[5]
        found.append([*row[:4], v * math.cos(turn), v * math.sin(turn), *row[6:]])
    return found


VELOCITY = (*people.HEADER[:4], "vx", "vy", *people.HEADER[6:])


@LONG
def test_velocities_stand_for_speed_and_heading(tmp_path, long_bytes):
    path = write(tmp_path, velocities(0.7), VELOCITY)
    source = people.spec(tmp_path, VELOCITY, more=f"long_bytes = {long_bytes}")
    found = people.only(path, source)
    people.assert_same(found, 0.7, speed=0.002, angle=0.001)


def test_velocities_in_other_units_and_frames(tmp_path):
    table = [[*r[:3], -r[3], 3.6 * r[4], -3.6 * r[5], *r[6:]] for r in velocities(0.7)]
    path = write(tmp_path, table, VELOCITY)
    columns = {name: name for name in VELOCITY} | {"y": "-y", "vy": "-vy"}
    source = people.spec(tmp_path, columns, units='vx = "km/h"\nvy = "km/h"')
    people.assert_same(people.only(path, source), 0.7, speed=0.01)


def test_velocities_along_and_across_the_car_are_no_headings(tmp_path):
    table = [[*r[:4], r[5], 0.0, *r[6:]] for r in people.rows(0.7)]
    found = people.only(
        write(tmp_path, table, VELOCITY), people.spec(tmp_path, VELOCITY)
    )
    people.assert_same(found, 0.7, speed=0.002)
    assert any("vx, vy contradict the direction" in note for note in found.notes)


def test_columns_win_over_velocities(tmp_path):
    header = (*people.HEADER, "vx", "vy")
    table = [[*row, 99.0, 99.0] for row in people.rows()]
    found = people.only(write(tmp_path, table, header), people.spec(tmp_path, header))
    people.assert_same(found, speed=0.002)


# ----------------------------------------------------------------- scale, offset


def test_scale_and_offset_of_columns(tmp_path):
    """Raw numbers of a bus: 0.01 km/h from -40, decimetres."""
    table = people.column(people.rows(), "speed", lambda v: round((3.6 * v + 40) * 100))
    table = people.column(table, "x", lambda x: f"{10.0 * (x + 500.0):.2f}")
    rest = "[scale]\nspeed = 0.01\nx = 0.1\n[offset]\nspeed = -40.0\nx = -500.0"
    source = people.spec(tmp_path, units='speed = "km/h"', rest=rest)
    people.assert_same(people.only(write(tmp_path, table), source), speed=0.01)
    source = people.spec(tmp_path, rest="[scale]\nkind = 2.0")
    assert "scale.kind: unknown: expected some of t, x, y" in refused(
        tmp_path / "log.csv", source
    )


def test_unknown_options_are_one_line(tmp_path):
    path = write(tmp_path, people.rows())
    line = refused(path, people.spec(tmp_path, more="speedlimit = 20.0"))
    assert "speedlimit: unknown: expected some of source, licence" in line
    assert line.endswith("did you mean speed_limit?")
    columns = {**{n: n for n in people.HEADER}, "heding": "heading"}
    line = refused(path, people.spec(tmp_path, columns))
    assert line.endswith("did you mean heading?")
    line = refused(path, people.spec(tmp_path, rest="[defaults]\nlenght = 4.2"))
    assert "defaults.lenght: unknown: expected some of rate_hz, length" in line
    assert line.endswith("did you mean length?")
    lanes = '[[lanes]]\nid = "a"\npoints = [[0.0, 0.0], [9.0, 0.0]]\nspeedlimit = 9.0'
    line = refused(path, people.spec(tmp_path, rest=lanes))
    assert line.endswith("did you mean speed_limit?")
    line = refused(path, people.spec(tmp_path, rest='[lanes]\nfiel = "lanes.csv"'))
    assert "source TOML: lanes.fiel: unknown: expected some of" in line
    assert line.endswith("did you mean file?")


# ------------------------------------------------------------------------- flags

FLAGS = [
    ("yes", "no"), ("Yes", "No"), ("TRUE", "FALSE"), ("true", "false"), ("1", "0"),
    ("1.0", "0.0"), ("2", "0"), ("on", "off"), ("Y", "N"), ("ja", "nein"), ("x", ""),
    ("ACC", "human"), ("auto", "manual"), ("WAHR", "FALSCH"), ("an", "aus"),
    ("vrai", "faux"), ("aktiv", "inaktiv"), ("Verdadero", "Falso"),
]  # fmt: skip


@LONG
@pytest.mark.parametrize(("yes", "no"), FLAGS)
def test_flags(tmp_path, yes, no, long_bytes):
    """An automation drives car1 from 2 s on, and nobody else."""
    table = [
        [*row, yes if row[1] == "car1" and row[0] >= 2.0 else no]
        for row in people.rows()
    ]
    header = (*people.HEADER, "automated")
    source = people.spec(tmp_path, header, more=f"long_bytes = {long_bytes}")
    found = people.only(write(tmp_path, table, header), source)
    spans = {track.id: track.automated for track in found.tracks if track.automated}
    assert spans == {"car1": ((2.0, math.inf),)}


def test_flags_of_a_user_and_unknown_ones(tmp_path):
    header = (*people.HEADER, "automated")
    table = [
        [*row, {"car1": "L2", "car2": ""}.get(row[1], "L0")] for row in people.rows()
    ]
    path = write(tmp_path, table, header)
    line = refused(path, people.spec(tmp_path, header))
    assert "automated: 'L0': expected yes or no; automated_values of the source" in line
    source = people.spec(tmp_path, header, more='automated_values = ["L2", "L3"]')
    found = people.only(path, source)
    # nobody knows who drives car2, so it is no demonstration
    automated = [track.id for track in found.tracks if track.automated]
    assert automated == ["car1", "car2"]
    line = refused(path, people.spec(tmp_path, header, more="automated_values = [1]"))
    assert "automated_values: 1: expected a text" in line


# -------------------------------------------------------------------------- wide


def wide_frames(name, cars=people.CARS):
    """(header, rows): one row per frame; car2 is not seen from 4 to 5 s."""
    header, lines = ["time"], {}
    for car in range(cars):
        header += [name.format(axis=axis, car=car) for axis in ("x", "y", "v")]
    for t, user, x, y, _, v, *_ in people.rows():
        line = lines.setdefault(t, [t])
        seen = not (user == "car2" and 4.0 <= t < 5.0)
        line += [x, y, v] if seen else ["", "", ""]
    return header, list(lines.values())


@LONG
@pytest.mark.parametrize(
    ("name", "columns"),
    [
        ("{axis}_{car}", "{axis}_{id}"),
        ("car{car}.{axis}", "car{id}.{axis}"),
        ("{axis}[{car}]", "{axis}[{id}]"),
        ("obj {car} / {axis}", "obj {id} / {axis}"),
    ],
)
def test_one_row_per_frame(tmp_path, name, columns, long_bytes):
    header, table = wide_frames(name)
    path = write(tmp_path, table, header, between=";")
    fields = {"x": "x", "y": "y", "speed": "v"}
    named = {f: columns.replace("{axis}", axis) for f, axis in fields.items()}
    source = people.spec(
        tmp_path, {"t": "time", **named}, more=f"long_bytes = {long_bytes}"
    )
    found = people.only(path, source)
    assert [t.id for t in found.tracks] == ["0", "1", "2", "2#2", "3", "4", "5"]
    sizes = {track.id: track.t.size for track in found.tracks}
    assert (sizes["0"], sizes["2"], sizes["2#2"]) == (120, 40, 70)
    t, x, y = (
        np.array([r[k] for r in people.rows() if r[1] == "car3"]) for k in (0, 2, 3)
    )
    track = found.tracks[4]
    np.testing.assert_allclose(track.t, t, atol=1e-9)
    np.testing.assert_allclose(track.x, x, atol=1e-3)
    np.testing.assert_allclose(track.y, y, atol=1e-3)
    # who is not there is no bad row
    assert people.rows_of(found) == (710, 0, 0, 0)


def test_wide_tables_whose_names_do_not_fit(tmp_path):
    header, table = wide_frames("{axis}_{car}")
    path = write(tmp_path, table, header)
    columns = {"t": "time", "x": "px_{id}", "y": "y_{id}"}
    line = refused(path, people.spec(tmp_path, columns))
    assert "columns.x: px_{id}: expected columns of this name and of y_{id}" in line
    columns = {"t": "time", "id": "x_1", "x": "x_{id}", "y": "y_{id}"}
    line = refused(path, people.spec(tmp_path, columns))
    assert "columns.id: x_1: expected none beside columns.x" in line


def pneuma(form="{:.6f}"):
    """The text of pNEUMA: a row per vehicle, whose last six columns go on repeating."""
    head = (
        "track_id; type; traveled_d; avg_speed; lat; lon; speed; lon_acc; lat_acc; time"
    )
    users: dict[str, list] = {}
    for row in degrees(people.rows()):
        users.setdefault(row[1], []).append(row)
    lines = [head]
    for name, own in users.items():
        kind = "Heavy Vehicle" if name == "car5" else "Car"
        cells = [name[3:], kind, "120.5", "54.1"]
        # vehicles leave at different times
        for t, _, lon, lat, _, v, *_ in own[: 120 - 10 * int(name[3:])]:
            cells += [lat, lon, form.format(3.6 * v), "0.01", "-0.02", form.format(t)]
        lines.append("; ".join(cells) + "; ")
    return "\n".join(lines) + "\n"


PNEUMA = {
    "t": "time", "id": "track_id", "y": "lat", "x": "lon", "speed": "speed",
    "kind": "type",
}  # fmt: skip


@LONG
def test_a_row_per_vehicle_as_in_pneuma(tmp_path, long_bytes):
    path = tmp_path / "20181024_d1_0830_0900.csv"
    path.write_text(pneuma())
    kinds = 'Car = "vehicle"\n"Heavy Vehicle" = "vehicle"'
    source = people.spec(
        tmp_path, PNEUMA, units='speed = "km/h"', more=f"long_bytes = {long_bytes}",
        rest=kinds,
    )  # fmt: skip
    found = people.only(path, source)
    assert [track.id for track in found.tracks] == list("012345")
    assert [t.t.size for t in found.tracks] == [120, 110, 100, 90, 80, 70]
    for track in found.tracks:
        real = 15.0 + 0.8 * np.cos(0.4 * track.t)
        np.testing.assert_allclose(track.speed, real, atol=1e-3)
        np.testing.assert_allclose(track.heading, 0.0, atol=0.01)
        assert np.ptp(track.x) == pytest.approx(np.trapezoid(real, track.t), abs=0.1)
    assert found.rows.read == 570


def test_a_row_per_vehicle_that_breaks_off(tmp_path):
    """The others say how many columns repeat."""
    path = tmp_path / "log.csv"
    path.write_text(pneuma().replace("; \n", "; 37.97; 23.7; \n", 1))
    columns = {field: name for field, name in PNEUMA.items() if field != "kind"}
    source = people.spec(tmp_path, columns, units='speed = "km/h"')
    found = people.only(path, source)
    assert people.rows_of(found) == (571, 1, 0, 0)
    assert any("first: line 2: 6 cells: expected 10" in note for note in found.notes)


def test_a_cell_inside_of_a_long_row_is_named_by_its_line(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(pneuma().replace("; 55.0", "; fast", 1))
    source = people.spec(tmp_path, PNEUMA, more="max_bad_rows = 0.0")
    assert "line 2: speed: 'fast" in refused(path, source)
