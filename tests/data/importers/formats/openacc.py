"""An OpenACC drive: five metadata lines, then columns per car of the platoon."""

import dataclasses

import numpy as np

from tests.data.importers.formats import Fixture, cell
from tests.data.importers.formats.drives import samples

T = np.round(np.arange(400) * 0.1, 1)
SPEED = 14.0  # m/s
RADIUS = 300.0  # m, of the test track's bend
NAMES = ("Audi(A8)", "Audi(A6)", "BMW(X5)")
SIZES = ((5.17, 1.95), (4.94, 1.89), (4.92, 2.0))
META = (
    "Date,04,07,2019,,,,,",
    "Vehicle_order,Audi (A8),Audi(A6),BMW(X5),,,,",
    "Number_of_vehicles,3,,,,",
    "ACC,2,,,,",
    "Distance_setting,shortest",
)
# the second receiver loses its fix for four samples, the third for three
HOLES = {2: (100, 104), 3: (200, 230)}


def on_track(s):
    """x, y [m], heading [rad] along a straight of 200 m and a left bend."""
    angle = np.maximum(s - 200.0, 0.0) / RADIUS
    along = np.minimum(s, 200.0)
    return (
        along + RADIUS * np.sin(angle),
        RADIUS * (1.0 - np.cos(angle)),
        angle,
    )


def cars():
    """Number -> (station [n] m, speed [n] m/s), front car first."""
    wave = np.sin(0.3 * T)
    s = SPEED * T + wave / 0.3
    return {
        1: (60.0 + s, SPEED + np.cos(0.3 * T)),
        2: (35.0 + s, SPEED + np.cos(0.3 * T)),
        3: (10.0 + s, SPEED + np.cos(0.3 * T)),
    }


def table(fleet, drivers=("Human", "ACC", "Human")):
    """Column name -> cells (text)."""
    columns = {"Time": [f"{value:.1f}" for value in T]}
    for car, (s, speed) in fleet.items():
        x, y, _ = on_track(s)
        values = {
            "Speed": speed,
            # radians about Gothenburg
            "Lat": 1.006 + y / 6.37e6,
            "Lon": 0.224 + x / 3.4e6,
            "Alt": np.full(T.shape, 210.0),
            "E": x,
            "N": y,
            "U": np.zeros(T.shape),
        }
        hole = slice(*HOLES.get(car, (0, 0)))
        for name, column in values.items():
            cells = [f"{value:.9f}" for value in column]
            cells[hole] = [""] * len(cells[hole])
            columns[f"{name}{car}"] = cells
    for car, driver in zip(fleet, drivers, strict=False):
        columns[f"Driver{car}"] = [driver] * T.size
    for car in list(fleet)[:-1]:
        gap = fleet[car][0] - fleet[car + 1][0]
        gap = gap - 0.5 * (SIZES[car - 1][0] + SIZES[car][0])
        columns[f"IVS{car}"] = [f"{value:.4f}" for value in gap]
    return columns


def write_drive(path, columns, meta=META, tail=""):
    """The CSV."""
    lines = [*meta, ",".join(columns)]
    for cells in zip(*columns.values(), strict=True):
        lines.append(",".join(cells) + tail)
    path.write_text("\n".join(lines) + "\n")
    return path


def road_users():
    """Track id -> road user; a hole of more than half a second ends a track."""
    found = {}
    for car, (s, speed) in cars().items():
        from tests.data.importers.formats.drives import straight

        x, y, heading = on_track(s)
        user = straight(T, (0.0, 0.0), 0.0, 0.0, size=SIZES[car - 1])
        user = dataclasses.replace(user, x=x, y=y, heading=heading, speed=speed)
        name = f"{car}-{NAMES[car - 1]}"
        rows = np.arange(T.size)
        first, last = HOLES.get(car, (T.size, T.size))
        if last - first > 5 and first < T.size:
            found[name] = samples(user, rows[:first])
            found[f"{name}#2"] = samples(user, rows[last:])
        else:
            found[name] = samples(user, (rows < first) | (rows >= last))
    return found


def write(folder):
    """A platoon of three on a test track."""
    columns = table(cars())
    log = write_drive(folder / "ASta_040719_platoon1.csv", columns, tail=",")
    (folder / "Vehicles_specifications.csv").write_text("Vehicles,Max power (kW)\n")
    return Fixture(
        input=folder,
        assumed=(2, 2, 4),  # sizes are by model
        rate_hz=10.0,
        tracks=road_users(),
        num_lanes=1,
        has_heading=False,
        files=(log,),
        drops_rows=True,
        numbers={log: cell([*columns].index("E1"))},
        has_holes=True,
    )


# options of values that are none
OPTIONS = [{"drivers": "robots"}, {"rate_hz": 0.0}]
