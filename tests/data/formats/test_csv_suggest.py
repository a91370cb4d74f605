"""A source TOML suggested for a table: what is recognised, and that it imports."""

import datetime
import gzip
import tomllib

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rcirl_jax.data.formats.csv.names import base_of, fields_by_name, unit_of
from rcirl_jax.data.formats.csv.suggest import suggested
from rcirl_jax.runtime.specs import load_toml
from tests.data.formats import people
from tests.data.formats.test_csv_rows import digits
from tests.data.formats.test_csv_ways import degrees
from tests.helpers.commands import command


def taken(path):
    """(suggestion, its TOML's content, the recordings that it imports)."""
    found = suggested(path)
    source = path.parent / "suggested.toml"
    source.write_text(found.toml)
    return found, load_toml(source), people.read(path, source)


GERMAN = ("Zeit_ms", "TrackID", "UTM_E", "UTM_N", "Richtung_deg", "Tempo_kmh", "Laenge",
          "Klasse")  # fmt: skip


def test_a_german_table_of_a_spreadsheet(tmp_path):
    table = people.column(
        people.rows(0.5), "t", lambda t: round(1000 * t) + 1716200000000
    )
    table = people.column(table, "x", lambda x: x + 588_000.0)
    table = people.column(table, "heading", lambda h: 90.0 - h * 57.29578)
    table = people.column(table, "speed", lambda v: 3.6 * v)
    table = people.column(table, "kind", {"car": "Pkw", "truck": "Lkw"}.get)
    header = [*GERMAN[:5], "Geschwindigkeit", *GERMAN[6:]]
    path = tmp_path / "flug.csv"
    path.write_bytes(
        people.text(table, header, between=";", decimal=",").encode("utf-16")
    )
    found, toml, (made,) = taken(path)
    people.assert_same(made, 0.5, place=0.01)
    assert toml["columns"] == dict(
        t="Zeit_ms", id="TrackID", x="UTM_E", y="UTM_N", heading="Richtung_deg",
        speed="Geschwindigkeit", length="Laenge", kind="Klasse",
    )  # fmt: skip
    units = toml["units"]
    assert (units["t"], units["speed"], units["heading"]) == ("ms", "km/h", "deg")
    assert toml["defaults"]["rate_hz"] == 10.0
    assert toml["heading_convention"] == "cw_from_north"
    assert toml["kinds"] == {"Lkw": "vehicle", "Pkw": "vehicle"}
    assert "not known: width: no column" in "\n".join(found.lines)
    shown = found.lines[found.lines.index("the first rows as understood:") + 1 :]
    assert len(shown) == 6
    heads = "t [s] id x [m] y [m] heading [deg] speed [m/s] length [m] kind"
    assert " ".join(shown[0].split()) == heads
    assert " ".join(shown[1].split()) == "0.00 car0 588000.00 0.00 28.65 15.80 4.50 Pkw"


@pytest.mark.parametrize("rate", [10.0, 30.0])
@pytest.mark.parametrize(("unit", "factor"), [("m/s", 1.0), ("km/h", 3.6)])
def test_the_rate_of_frames_by_the_speeds(tmp_path, rate, unit, factor):
    table = []
    for k in range(200):
        for car in range(4):
            x = 14.0 * k / rate - 30.0 * car
            table.append([1000 + k, car, x, 0.0, 14.0 * factor])
    path = people.write(tmp_path, table, ("frame", "id", "x", "y", "speed"))
    _, toml, (made,) = taken(path)
    assert (toml["units"]["t"], toml["defaults"]["rate_hz"]) == ("frame", rate)
    assert toml["units"]["speed"] == unit
    for track in made.tracks:
        np.testing.assert_allclose(track.speed, 14.0, atol=0.01)
        np.testing.assert_allclose(np.diff(track.t), 1.0 / rate, atol=1e-6)


UNITS = [
    *[("speed", "m/s", 1.0), ("speed", "km/h", 3.6)],  # by the positions
    *[("speed", "mph", 2.23694), ("t", "ms", 1e3), ("t", "ns", 1e9)],
]


@pytest.mark.parametrize(("field", "unit", "factor"), UNITS)
def test_units(tmp_path, field, unit, factor):
    table = people.column(people.rows(), field, lambda value: value * factor)
    path = people.write(tmp_path, table, ("time", *people.HEADER[1:]))
    _, toml, (made,) = taken(path)
    assert toml["units"][field] == unit
    people.assert_same(made, speed=0.01)


def test_iso_times_and_degrees_in_parquet(tmp_path):
    table = degrees(people.rows())
    header = ("datetime", "vehicle_id", "longitude", "latitude", "course", "speed_mps",
              "length", "vehicle_type")  # fmt: skip
    columns = list(zip(*table, strict=True))
    columns[0] = [f"2024-05-20T10:00:{t:06.3f}Z" for t in columns[0]]
    columns[2:4] = [list(map(float, c)) for c in columns[2:4]]
    path = tmp_path / "log.parquet"
    made = dict(zip(header, map(list, columns), strict=True))
    pq.write_table(pa.table(made), path)
    found, toml, (read,) = taken(path)
    people.assert_same(read, place=0.02)
    assert toml["columns"]["lat"] == "latitude"
    assert toml["units"]["t"] == "iso"
    assert "recognised: t: column datetime, iso" in found.lines


def test_degrees_in_columns_called_x_and_y(tmp_path):
    path = people.write(tmp_path, degrees(people.rows()))
    found, toml, (made,) = taken(path)
    assert (toml["units"]["x"], toml["units"]["y"]) == ("deg", "deg")
    assert any("longitude and latitude" in line for line in found.lines)
    people.assert_same(made, place=0.02)


# header of a known tool, with the field that each column is
TOOLS = {
    "SUMO": "timestep_time=t vehicle_angle=heading vehicle_id=id vehicle_lane=lane "
    "vehicle_pos vehicle_speed=speed vehicle_type=kind vehicle_x=x vehicle_y=y",
    "TGSIM": "id=id time=t xloc_kf=x yloc_kf=y lane_kf=lane speed_kf=speed "
    "acceleration_kf length_smoothed=length width_smoothed=width "
    "type_most_common=kind av=automated run_index=recording",
    "inD": "frame=t trackId=id xCenter=x yCenter=y heading=heading width=width "
    "length=length xVelocity=vx yVelocity=vy xAcceleration yAcceleration lonVelocity "
    "latVelocity",
    "DataFromSky": "Timestamp=t ObjectID=id Latitude=lat Longitude=lon "
    "Speed(km/h)=speed Course(deg)=heading Class=kind",
    "German": "Zeitstempel=t Fahrzeug=id Rechtswert_m=x Hochwert_m=y "
    "Fahrzeuglänge=length Fahrzeugbreite=width Fahrzeugklasse=kind Fahrstreifen=lane",
}
PLACES = [
    # pixels and points that are no middle come last
    "frame id carCenterX carCenterY headXft headYft carCenterXft=x carCenterYft=y",
    *("frame id x_px y_px x_m=x y_m=y", "frame id xpixel ypixel east=x north=y"),
    # names of the compass count before the letters; the last are estimates
    *("Czas Nr Północ_X=y Wschód_Y=x", "t id Hochwert=y Rechtswert=x", "t id N=y E=x"),
    *("t id Norte=y Leste=x", "t id X_sever=y Y_vychod=x", "t id x_est=x y_est=y"),
    # places in a picture, in several notations; degrees count in pairs
    *("frame id x_img y_img x_world=x y_world=y", "frame id x y x[m]=x y[m]=y"),
    "frame id X_Bild Y_Bild X_Welt=x Y_Welt=y",
    *("t id Latitud=lat Longitud=lon", "t id X=x Y=y Longitud=length"),
    # other cases and numbers of known words, with and without accents
    "Znacznik_czasu=t Numer_obiektu=id X Y Wartość_prędkości=speed Temp Predkosc_max",
    "Razítko_času=t Čísla_vozidel=id X Y Délky=length Smery=heading",
    "Zeitpunkt=t Fahrzeugs=id X Y Largeurs=width",
    *("Data_e_hora=t Veículos=id X Y Rumo=heading", "Tidpunkt=t Tracks=id X Y"),
    *("Marca_de_tiempo=t Coche X Y", "Date_et_heure=t Idx X Y", "Horodatage=t Id=id"),
]


@pytest.mark.parametrize("names", [*TOOLS.values(), *PLACES])
def test_fields_by_names(names):
    pairs = [word.partition("=") for word in names.split()]
    found = fields_by_name([column for column, _, _ in pairs])
    for column, _, field in pairs:
        assert not field or found.get(field) == column


def test_a_shorter_word_is_no_other_case():
    words = ("temp", "data", "heading", "ori", "driver", "limits")
    assert [*map(base_of, words)] == [
        "temp",
        "data",
        "heading",
        "ori",
        "driver",
        "limit",
    ]


def test_units_by_names():
    units = {"carCenterXft": "ft", "x_m": "m", "east": ""}
    assert {name: unit_of(name, ("m", "ft")) for name in units} == units


@pytest.mark.parametrize(
    "form",
    ["%d-%b-%Y %H:%M:%S.%f", "%Y%m%d_%H%M%S.%f", "%I:%M:%S.%f %p", "%M:%S.%f"],
)
def test_clocks_and_dates_over_the_end_of_a_day(tmp_path, form):
    """Without a date they go on after midnight, or after the full hour."""
    start = datetime.datetime(2024, 5, 31, 23, 59, 54)

    def clock(t):
        return (start + datetime.timedelta(seconds=t)).strftime(form)

    path = people.write(tmp_path, people.column(people.rows(), "t", clock))
    _, toml, (made,) = taken(path)
    assert toml["units"]["t"] == form
    people.assert_same(made)


def test_places_in_pixels_alone_need_a_scale(tmp_path):
    table = people.column(people.column(people.rows(), "x", lambda x: 12.5 * x), "y",
                          lambda y: 12.5 * y)  # fmt: skip
    header = ["x_px" if n == "x" else "y_px" if n == "y" else n for n in people.HEADER]
    path = people.write(tmp_path, table, header)
    found = suggested(path)
    assert "x_px" not in tomllib.loads(found.toml)["columns"].values()
    columns = dict(zip(people.HEADER, header, strict=True))
    line = people.refused(path, people.spec(tmp_path, columns))
    assert "columns.x: x_px: expected metres; places in pixels take metres per" in line
    scale = "[scale]\nx = 0.08\ny = 0.08"
    people.assert_same(people.only(path, people.spec(tmp_path, columns, rest=scale)))


def test_by_its_command(tmp_path):
    log, target = tmp_path / "log.csv.gz", tmp_path / "mine.toml"
    log.write_bytes(gzip.compress(people.text(people.rows(), between=";").encode()))
    flags = (f"--suggest={log}", f"--output={target}")
    done = command("rcirl_jax", "import", *flags)
    assert done.returncode == 0, done.stderr
    assert "recognised: text in utf-8, semicolon between cells" in done.stdout
    assert f"--source={target} --input={log}" in done.stdout
    people.assert_same(people.only(log, target))
    again = command("rcirl_jax", "import", *flags)
    assert again.returncode == 2
    assert again.stderr.startswith(
        f"error: {target}: there already: expected --overwrite"
    )
    done = command("rcirl_jax", "import", "--suggest=nowhere.csv")
    assert done.stderr == "error: nowhere.csv: --suggest: missing: expected a table\n"


@pytest.mark.parametrize(
    ("start", "unit", "is_open"),
    [((8, 4, 54), "HHMMSSmmm", False), ((8, 4, 7), "ms", True)],
)
def test_times_of_day_as_digits(tmp_path, start, unit, is_open):
    """Sure where a minute ends in the first rows; else milliseconds, and it says so."""
    path, _ = digits(tmp_path, "%-H%M%S%L", start)
    found, toml, (made,) = taken(path)
    assert toml["units"]["t"] == unit
    assert toml["defaults"]["rate_hz"] == 10.0
    line = "not known: units.t: ms, or HHMMSSmmm of times of day?"
    assert (line in found.lines) == is_open
    people.assert_same(made)


# nothing that anyone knows: time, id, x, y, heading, speed, length, kind, width
STRANGE = ("qa", "qb", "qc", "qd", "qe", "qf", "qg", "qh", "qi")


def strange(folder, *, units=True, header=STRANGE, drop=()):
    """A table of a curve whose names say nothing, with or without a line of units."""
    table = []
    for k in range(150):
        for car in range(5):
            at, v = 0.1 * k, 14.0 + car + np.sin(0.3 * k / 10 + car)
            way = (14.0 + car) * at - (np.cos(0.3 * at + car) - np.cos(car)) / 0.3
            h = 0.4 + way / 300.0
            x, y = 300.0 * np.sin(h), -300.0 * np.cos(h)
            box = [4.4 + 0.1 * car, "truck" if car == 4 else "car", 1.7 + 0.05 * car]
            motion = [90.0 - np.rad2deg(h), 3.6 * v]
            table.append([at, 7 + 3 * car, x, y, *motion, *box])
    if units:
        table.insert(0, ["s", "-", "m", "m", "°", "km/h", "m", "-", "m"])
    kept = [n for n, name in enumerate(STRANGE) if name not in drop]
    rows = [[row[n] for n in kept] for row in table]
    return people.write(folder, rows, [header[n] for n in kept], between=";")


FIELDS = ("t", "id", "x", "y", "heading", "speed", "length", "kind", "width")


@pytest.mark.parametrize("is_stated", [True, False])
def test_by_content_where_names_say_nothing(tmp_path, is_stated):
    found, toml, (made,) = taken(strange(tmp_path, units=is_stated))
    assert toml["columns"] == dict(zip(FIELDS, STRANGE, strict=True))
    assert (toml["units"]["speed"], toml["units"]["heading"]) == ("km/h", "deg")
    assert toml["heading_convention"] == "cw_from_north"
    assert sorted(track.id for track in made.tracks) == ["10", "13", "16", "19", "7"]
    assert 't = "qa"  # guessed: rises in steps of 0.1 within one qb' in found.toml
    assert found.toml.count("which of the two is x is a guess") == 2
    assert not found.last


@pytest.mark.parametrize("field", [0, 1, 2, 4])
def test_one_unknown_name_among_known_ones(tmp_path, field):
    names = ["time", "id", "x", "y", "heading", "speed", "length", "type", "width"]
    names[field] = "qq"
    found, toml, _ = taken(strange(tmp_path, header=names))
    assert toml["columns"] == dict(zip(FIELDS, names, strict=True))
    assert found.toml.count("guessed: ") == 1


def test_what_nothing_tells_is_left_open(tmp_path):
    """Without a clock: the draft names the columns, and an import refuses it."""
    path = strange(tmp_path, drop=("qa",), header=[*STRANGE[:1], "id", *STRANGE[2:]])
    found, source = suggested(path), tmp_path / "draft.toml"
    source.write_text(found.toml)
    toml = load_toml(source)
    columns, units = toml["columns"], toml["units"]
    assert (columns["t"], columns["id"]) == ("?", "id")
    assert [*units] == [field for field in columns if field in units]
    assert 't = "?"  # one of: qc, ' in found.toml
    assert any(line.startswith("not known: t: one of: qc, ") for line in found.lines)
    assert found.last.startswith('fill in the lines with "?" before you import; words ')
    assert "columns.t: ?: expected the name of a colu" in people.refused(path, source)


# the same header as firms of several countries write it
FOREIGN = {
    "cp1250": ("Czas", "Nr pojazdu", "X", "Y", "Azymut", "Prędkość", "Długość",
               "Rodzaj", "Szerokość"),
    "cp1252": ("Tiempo", "Vehículo", "X", "Y", "Rumbo", "Velocidad", "Comprimento",
               "Categoría", "Anchura"),
    "utf-8": ("Čas", "Vozidlo", "X", "Y", "Směr", "Rychlost", "Délka", "Druh", "Šířka"),
}  # fmt: skip


@pytest.mark.parametrize("encoding", FOREIGN)
def test_words_of_names_tell_the_encoding(tmp_path, encoding):
    path = strange(tmp_path, header=FOREIGN[encoding])
    path.write_bytes(path.read_text().encode(encoding))
    found, toml, (made,) = taken(path)
    assert toml["columns"] == dict(zip(FIELDS, FOREIGN[encoding], strict=True))
    assert toml.get("table", {}).get("encoding", "utf-8") == encoding
    assert "a guess" not in found.toml
    assert len(made.tracks) == 5


def test_letters_tell_the_encoding_where_no_word_does(tmp_path):
    header = ("時刻", "車両番号", "X座標", "Y座標", "方位角", "速度", "全長", "種別")
    path = tmp_path / "log.csv"
    path.write_bytes(people.text(people.rows(), header).encode("shift_jis"))
    toml = tomllib.loads(suggested(path).toml)
    assert toml["table"]["encoding"] == "shift_jis"


def changed(path, **changes):
    """That table with other cells in some columns, at those numbers: _0=..."""
    lines = [line.split(";") for line in path.read_text().splitlines()]
    is_row = [line[2][-1:].isdigit() for line in lines]
    for name, change in changes.items():
        for line in (one for one, good in zip(lines, is_row, strict=True) if good):
            line[int(name[1:])] = change(line[int(name[1:])])
    path.write_text("\n".join(map(";".join, lines)) + "\n")
    return path


def date(zone):
    """A change of seconds into dates whose day comes first."""
    start = datetime.datetime(2025, 3, 7, 6, 58)

    def written(cell):
        time = start + datetime.timedelta(seconds=float(cell))
        return f"{time:%d.%m.%Y %H:%M:%S}.{time.microsecond // 1000:03d}{zone}"

    return written


@pytest.mark.parametrize("unit", ["dd.mm.rrrr gg:mm:ss,fff", "-"])
@pytest.mark.parametrize(
    ("zone", "form"), [("", ""), (" +01:00", " %z"), ("+0100", "%z"), ("Z", "%z")]
)
def test_dates_with_a_zone_by_their_content(tmp_path, zone, form, unit):
    """Whatever the line of units says of them; 06:58 is an hour earlier in UTC."""
    path = changed(strange(tmp_path), _0=date(zone))
    path.write_text(path.read_text().replace("\ns;", f"\n{unit};"))
    _, toml, (made,) = taken(path)
    assert toml["columns"] == dict(zip(FIELDS, STRANGE, strict=True))
    assert toml["units"]["t"] == f"%d.%m.%Y %H:%M:%S.%f{form}"
    assert toml["defaults"]["rate_hz"] == 10.0
    (track, *_) = made.tracks
    np.testing.assert_allclose(np.diff(track.t), 0.1, atol=1e-5)


def test_zones_are_read(tmp_path):
    table = people.column(people.rows(), "t", lambda t: date(" +01:00")(t))
    for row in table[360:]:  # the clocks go forward
        row[0] = row[0].replace("06:58", "07:58").replace("+01", "+02")
    path = people.write(tmp_path, table, ("Czas", *people.HEADER[1:]))
    _, _, (made,) = taken(path)
    people.assert_same(made)


NAMED = ("Czas", "id", "x", "y", "Azymut", "speed", "length", "type", "width")


@pytest.mark.parametrize("drop", ["qf", ""])
def test_a_time_that_nobody_reads(tmp_path, drop):
    """The draft has what does not depend on it; speeds tell the rate, if they can."""
    header = [*NAMED[:5], "speed_kmh", *NAMED[6:]]
    path = strange(tmp_path, units=False, header=header, drop=(drop,))
    found = suggested(changed(path, _0=lambda cell: f"klatka {float(cell):.1f}"))
    toml = tomllib.loads(found.toml)
    reason = "t = \"?\"  # one of: Czas; its cells are such as 'klatka 0.0', no time in"
    assert reason in found.toml
    assert 't = "?"  # one of s, ms, us, ' in found.toml
    assert (toml["columns"]["t"], toml["units"]["t"]) == ("?", "?")
    assert toml["heading_convention"] == "cw_from_north"
    assert toml["kinds"] == {"car": "vehicle", "truck": "vehicle"}
    assert ("rate_hz = 10  # not measured" in found.toml) == bool(drop)
    told = "recognised: rate_hz = 10: by the speeds, if they are in km/h"
    assert (told in found.lines) != bool(drop)
    assert any(line.split()[:2] == ["id", "x"] for line in found.lines)
    assert found.last.startswith("fill in")
    source = tmp_path / "draft.toml"
    source.write_text(found.toml.replace('"?"', '"Czas"', 1))
    assert "units.t: ?: expected one of s, ms, " in people.refused(path, source)


def test_kinds_are_told_without_a_place(tmp_path):
    header = ("Czas", "id", "qc", "qd", "qe", "qf", "length", "type", "width")
    kept = strange(tmp_path, units=False, header=header)
    toml = tomllib.loads(
        suggested(changed(kept, _2=lambda _: "1", _3=lambda _: "1")).toml
    )
    assert toml["columns"]["x"] == "?"
    assert toml["kinds"] == {"car": "vehicle", "truck": "vehicle"}


SIZES = [  # names of length and width, factor, units of length, width and places
    ("length [cm]", "width [cm]", 100.0, ("cm", "cm", "m")),
    ("length", "width", 100.0, ("cm", "cm", "m")),
    ("length [ft]", "width [ft]", 3.2808, ("ft", "ft", "m")),
    ("length", "width", 3.2808, ("ft", "ft", "ft")),
    ("length", "width", 1000.0, ("mm", "mm", "m")),
]


@pytest.mark.parametrize(("length", "width", "factor", "units"), SIZES)
def test_units_of_sizes_and_places(tmp_path, length, width, factor, units):
    header = ["time", *NAMED[1:6], length, "type", width]
    path = strange(tmp_path, units=False, header=header)
    places = 3.2808 if units[2] == "ft" else 1.0

    def times(by):
        return lambda cell: f"{by * float(cell):.3f}"

    path = changed(path, _2=times(places), _3=times(places), _6=times(factor),
                   _8=times(factor))  # fmt: skip
    _, toml, (made,) = taken(path)
    found = toml["units"]
    assert (found["length"], found["width"], found["x"]) == units
    assert found["speed"] == "km/h"
    np.testing.assert_allclose(made.tracks[0].length, 4.5, atol=0.11)


@pytest.mark.parametrize("name", ["Azymut", "Bearing [deg]", "Kompass", "Rumbo"])
def test_a_compass_tells_that_x_points_north(tmp_path, name):
    """Surveyors' X and Y are swapped; an import that does not says so."""
    right = strange(tmp_path, units=False, header=[*NAMED[:4], name, *NAMED[5:]])
    (as_is,) = taken(right)[2]
    header, rows = right.read_text().split("\n", 1)
    right.write_text(f"{header.replace('x;y', 'Y;X')}\n{rows}")
    found, toml, (made,) = taken(right)
    assert (toml["columns"]["x"], toml["columns"]["y"]) == ("Y", "X")
    assert toml["heading_convention"] == "cw_from_north"
    assert f'x = "Y"  # swapped: {name} turns as a compass' in found.toml
    for track, expected in zip(made.tracks, as_is.tracks, strict=True):
        np.testing.assert_allclose(track.heading, expected.heading, atol=1e-6)
    source = tmp_path / "mirrored.toml"
    text = found.toml.replace('x = "Y"', 'x = "X"').replace('y = "X"', 'y = "Y"')
    text = text.replace('heading_convention = "cw_from_north"', "")
    source.write_text(text)
    (mirrored,) = people.read(right, source)
    assert any(f"{name} is a compass's by its name" in n for n in mirrored.notes)


@pytest.mark.parametrize(
    ("name", "turn"), [("heading", 0.3), ("azimuth", np.pi / 4), ("azimuth", 0.3)]
)
def test_x_and_y_stay_where_no_compass_tells(tmp_path, name, turn):
    """Named otherwise, or at 45 degrees, where both ways of counting are the same."""
    table = people.column(people.rows(turn), "heading", np.rad2deg)
    header = [name if n == "heading" else n for n in people.HEADER]
    found = suggested(people.write(tmp_path, table, header))
    is_compass = name == "azimuth" and turn == 0.3
    assert ("swapped" in found.toml) == is_compass
