"""Tiny log files of every format, written for the tests; values are exact."""

import csv
from pathlib import Path

import numpy as np

DT = 0.1  # s
SPEED = 15.0  # m/s, of every car in these files
POINT = "<point><x>{}</x><y>{}</y></point>"


def exact(tag, value):
    """A field of one value, or of an interval."""
    if isinstance(value, tuple):
        ends = zip(("intervalStart", "intervalEnd"), value, strict=True)
        return f"<{tag}>{''.join(f'<{k}>{v}</{k}>' for k, v in ends)}</{tag}>"
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


def car(name="10", *, version="2020a", x0=0.0, y=0.0, count=40, **options):
    """A car at constant speed along +x; `options` as of `moving`."""
    states = [state(k, x0 + SPEED * DT * k, y) for k in range(1, count)]
    options = {"states": states, "version": version, **options}
    return moving(name, state(0, x0, y, tag="initialState"), **options)


def moving(name, first, states, *, version="2020a", shape=BOX, kind="car"):
    """A road user by its states; 2018b names it by its role."""
    tag, role = "dynamicObstacle", ""
    if version == "2018b":
        tag, role = "obstacle", "<role>dynamic</role>"
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


def lanelet(name="1", *, left=None, right=None, extra="", start=0, length=200):
    """A lanelet along x, 3.5 m wide unless bounds are given."""
    end = start + length
    left = left or [(start, 1.75), (start + length / 2, 1.75), (end, 1.75)]
    right = right or [(start, -1.75), (end, -1.75)]
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


def light(name, phases, *, offset=0):
    cycle = "".join(
        f"<cycleElement><duration>{duration}</duration><color>{color}</color>"
        "</cycleElement>"
        for color, duration in phases
    )
    return (
        f'<trafficLight id="{name}"><cycle>{cycle}<timeOffset>{offset}</timeOffset>'
        "</cycle><active>true</active></trafficLight>"
    )


def problem(goal, *, speed=10.0):
    """A planning problem that starts at the origin along +x at step 0."""
    first = state(0, 0.0, 0.0, tag="initialState", speed=speed)
    time = exact("time", (20, 40))
    return (
        f'<planningProblem id="900">{first}<goalState>{goal}{time}</goalState>'
        "</planningProblem>"
    )


def commonroad(path: Path, *parts, version="2020a", attributes=""):
    """Write a CommonRoad file; without parts: one car on one lanelet."""
    body = "".join(parts) or lanelet() + car(version=version)
    path.write_text(
        f'<?xml version="1.0"?><commonRoad commonRoadVersion="{version}" '
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
    """Write a CSV, with its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as handle:
        writer = csv.writer(handle, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
    return path
