"""Tiny log files of every format, written for the tests; values are exact."""

import csv
from pathlib import Path

import numpy as np

from rcirl_jax.runtime.specs import spec_root

DT = 0.1  # s
SPEED = 15.0  # m/s, of every car in these files
POINT = "<point><x>{}</x><y>{}</y></point>"


def exact(tag, value):
    return f"<{tag}><exact>{value}</exact></{tag}>"


def state(step, x, y, *, tag="state", heading=0.0, speed=SPEED, drop=()):
    """One CommonRoad state; `drop` names fields to leave out."""
    fields = {
        "position": f"<position>{POINT.format(x, y)}</position>",
        "orientation": exact("orientation", heading),
        "time": exact("time", step),
        "velocity": exact("velocity", speed),
    }
    return f"<{tag}>{''.join(v for k, v in fields.items() if k not in drop)}</{tag}>"


BOX = "<rectangle><length>4.4</length><width>1.8</width></rectangle>"


def car(
    name="10",
    *,
    version="2020a",
    x0=0.0,
    y=0.0,
    count=40,
    shape=BOX,
    kind="car",
    states=None,
):
    """A car at constant speed along +x."""
    if states is None:
        states = [state(k, x0 + SPEED * DT * k, y) for k in range(1, count)]
    tag, role = "dynamicObstacle", ""
    if version == "2018b":
        tag, role = "obstacle", "<role>dynamic</role>"
    first = state(0, x0, y, tag="initialState")
    return (
        f'<{tag} id="{name}">{role}<type>{kind}</type><shape>{shape}</shape>'
        f"{first}<trajectory>{''.join(states)}</trajectory></{tag}>"
    )


def standing(name="30", *, x=50.0, y=-5.0, version="2020a", shape=BOX, heading=0.0):
    """A static obstacle; 2018b names it by its role."""
    tag, role = "staticObstacle", ""
    if version == "2018b":
        tag, role = "obstacle", "<role>static</role>"
    first = state(0, x, y, tag="initialState", heading=heading, drop=("velocity",))
    return (
        f'<{tag} id="{name}">{role}<type>parkedVehicle</type>'
        f"<shape>{shape}</shape>{first}</{tag}>"
    )


def bound(tag, points):
    return f"<{tag}>{''.join(POINT.format(x, y) for x, y in points)}</{tag}>"


def lanelet(name="1", *, left=None, right=None, extra=""):
    """A lanelet 200 m long and 3.5 m wide unless bounds are given."""
    left = left or [(0, 1.75), (100, 1.75), (200, 1.75)]
    right = right or [(0, -1.75), (200, -1.75)]
    return (
        f'<lanelet id="{name}">{bound("leftBound", left)}'
        f"{bound('rightBound', right)}{extra}</lanelet>"
    )


def sign(name, kind, value=None):
    extra = "" if value is None else f"<additionalValue>{value}</additionalValue>"
    return (
        f'<trafficSign id="{name}"><trafficSignElement><trafficSignID>{kind}'
        f"</trafficSignID>{extra}</trafficSignElement></trafficSign>"
    )


def light(name, phases, *, offset=0, active="true"):
    cycle = "".join(
        f"<cycleElement><duration>{duration}</duration><color>{color}</color>"
        "</cycleElement>"
        for color, duration in phases
    )
    return (
        f'<trafficLight id="{name}"><cycle>{cycle}<timeOffset>{offset}</timeOffset>'
        f"</cycle><active>{active}</active></trafficLight>"
    )


def problem(goal, *, speed=10.0):
    """A planning problem that starts at the origin along +x at step 0."""
    first = state(0, 0.0, 0.0, tag="initialState", speed=speed)
    time = "<time><intervalStart>20</intervalStart><intervalEnd>40</intervalEnd></time>"
    return (
        f'<planningProblem id="900">{first}<goalState>{goal}{time}</goalState>'
        "</planningProblem>"
    )


def commonroad(path: Path, *parts, version="2020a", attributes="", prolog=""):
    """Write a CommonRoad file; without parts: one car on one lanelet."""
    body = "".join(parts) or lanelet() + car(version=version)
    path.write_text(
        f'<?xml version="1.0"?>{prolog}<commonRoad commonRoadVersion="{version}" '
        f'timeStepSize="{DT}" source="NGSIM test" {attributes}>{body}</commonRoad>'
    )
    return path


NGSIM_COLUMNS = (
    *("Vehicle_ID", "Frame_ID", "Total_Frames", "Global_Time", "Local_X", "Local_Y"),
    *("Global_X", "Global_Y", "v_length", "v_Width", "v_Class", "v_Vel", "v_Acc"),
    *("Lane_ID", "Preceding", "Following", "Space_Headway", "Time_Headway"),
)
FOOT = 0.3048  # m


def ngsim_rows(
    *, vehicle=1, first=100, count=40, lane=2, local_x=18.0, length=15.0, start_ft=20.0
):
    """Rows of one vehicle at SPEED, in feet; `lane` may be one per row."""
    lanes = np.broadcast_to(lane, (count,))
    speed = SPEED / FOOT
    rows = []
    for k in range(count):
        place = (local_x, start_ft + speed * DT * k, 0, 0)
        body = (length, 6.0, 2, speed, 0, int(lanes[k]), 0, 0, 0, 0)
        rows.append([vehicle, first + k, count, 0, *place, *body])
    return rows


def ngsim_text(path: Path, rows):
    path.write_text("\n".join(" ".join(str(v) for v in row) for row in rows) + "\n")
    return path


def ngsim_csv(path: Path, rows, *, columns=NGSIM_COLUMNS, sites=None):
    header = [*columns, *([] if sites is None else ["Location"])]
    tails = [[]] * len(rows) if sites is None else [[site] for site in sites]
    return table(path, header, [r + t for r, t in zip(rows, tails, strict=True)])


def table(path: Path, header, rows):
    """Write a CSV."""
    with path.open("w", newline="") as handle:
        writer = csv.writer(handle)
        writer.writerow(header)
        writer.writerows(rows)
    return path


def strict(path: Path, name: str):
    """The packaged source TOML of a format, by which no row may be bad."""
    text = (spec_root() / "sources" / f"{name}.toml").read_text()
    assert "max_bad_rows = 0.01" in text
    path.write_text(text.replace("max_bad_rows = 0.01", "max_bad_rows = 0.0"))
    return path
