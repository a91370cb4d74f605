"""What a user's columns mean: times, places, headings, velocities, flags, wide rows."""

import math

import numpy as np
import pytest

from tests.data.formats import people
from tests.data.formats.people import LONG, Way, of, write
from tests.data.formats.test_csv_ways import degrees


def test_a_receiver_without_a_fix(tmp_path):
    """It is at (0, 0), in the gulf of Guinea."""
    table = degrees(people.rows())
    for k in (100, 101, 300):
        table[k][2] = table[k][3] = "0.0"
    source = people.spec(tmp_path, units='x = "deg"\ny = "deg"')
    found = people.only(write(tmp_path, table), source)
    assert people.rows_of(found) == (720, 3, 0, 0)
    assert sum(track.t.size for track in found.tracks) == 717


FLAGS = [("yes", "no"), ("1.0", "0.0"), ("x", ""), ("ACC", "human"), ("WAHR", "FALSCH"),
         ("L2", "L0")]  # fmt: skip


@pytest.mark.parametrize(("yes", "no"), FLAGS)
def test_flags(tmp_path, yes, no):
    """An automation drives car1 from 2 s on; nobody knows who drives car2."""
    table = [
        [*row, yes if row[1] == "car1" and row[0] >= 2.0 else no]
        for row in people.rows()
    ]
    for row in table if no else ():
        row[-1] = "" if row[1] == "car2" else row[-1]
    header = (*people.HEADER, "automated")
    own = 'automated_values = ["L2", "L3"]\n' if yes == "L2" else ""
    source = people.spec(tmp_path, header, more=own)
    found = people.only(write(tmp_path, table, header), source)
    spans = {track.id: track.automated for track in found.tracks if track.automated}
    unknown = {"car2": ((0.0, math.inf),)} if no else {}  # no demonstration
    assert spans == {"car1": ((2.0, math.inf),), **unknown}


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


def side_by_side(name="{axis}_{car}", columns="{axis}_{id}"):
    """That table, and what its columns mean."""
    fields = {"x": "x", "y": "y", "speed": "v"}
    named = {f: columns.replace("{axis}", axis) for f, axis in fields.items()}
    header, table = wide_frames(name)
    return of(table, header, columns={"t": "time", **named})


@LONG
@pytest.mark.parametrize(
    ("name", "columns"),
    [
        ("{axis}_{car}", "{axis}_{id}"),
        ("car{car}.{axis}", "car{id}.{axis}"),
        ("{axis}[{car}]", "{axis}[{id}]"),
    ],
)
def test_one_row_per_frame(tmp_path, name, columns, long_bytes):
    way = side_by_side(name, columns)
    found = people.only(*people.put(tmp_path, way, f"long_bytes = {long_bytes}"))
    assert [t.id for t in found.tracks] == ["0", "1", "2", "2#2", "3", "4", "5"]
    assert [t.t.size for t in found.tracks][:4] == [120, 120, 40, 70]
    track, rows = found.tracks[4], [r for r in people.rows() if r[1] == "car3"]
    for values, at in ((track.t, 0), (track.x, 2), (track.y, 3)):
        np.testing.assert_allclose(values, [row[at] for row in rows], atol=1e-3)
    # who is not there is no bad row
    assert people.rows_of(found) == (710, 0, 0, 0)


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


def a_row_per_vehicle():
    """That text, and what its columns mean."""
    columns = {
        **{"t": "time", "id": "track_id", "y": "lat", "x": "lon", "speed": "speed"},
        "kind": "type",
    }
    kinds = 'Car = "vehicle"\n"Heavy Vehicle" = "vehicle"'
    return Way(content=pneuma(), columns=columns, units='speed = "km/h"', rest=kinds)


@LONG
def test_a_row_per_vehicle_as_in_pneuma(tmp_path, long_bytes):
    way = a_row_per_vehicle()
    found = people.only(*people.put(tmp_path, way, f"long_bytes = {long_bytes}"))
    assert [track.id for track in found.tracks] == list("012345")
    assert [t.t.size for t in found.tracks] == [120, 110, 100, 90, 80, 70]
    for track in found.tracks:
        real = 15.0 + 0.8 * np.cos(0.4 * track.t)
        np.testing.assert_allclose(track.speed, real, atol=1e-3)
        np.testing.assert_allclose(track.heading, 0.0, atol=0.01)
        assert np.ptp(track.x) == pytest.approx(np.trapezoid(real, track.t), abs=0.1)
    assert found.rows.read == 570
