"""A highD recording: two carriageways, boxes by their upper-left corner."""

import dataclasses

import numpy as np

from tests.data.importers.formats import Fixture, cell
from tests.data.importers.formats.drives import samples, straight

FORMAT = "levelx"
RATE = 25.0  # 1/s
FRAMES = 300
T = np.arange(FRAMES) / RATE
UPPER, LOWER = (8.51, 12.59, 16.43), (21.0, 24.96, 28.8)  # m, y down
META = {
    **{"id": 1, "frameRate": 25, "locationId": 2, "speedLimit": "-1.00"},
    **{"month": "09.2017", "weekDay": "Tue", "startTime": "08:38"},
    **{"duration": "9.015600e+02", "totalDrivenDistance": 418549.19},
    **{"totalDrivenTime": 13908.12, "numVehicles": 4, "numCars": 3, "numTrucks": 1},
    "upperLaneMarkings": ";".join(f"{mark:.2f}" for mark in UPPER),
    "lowerLaneMarkings": ";".join(f"{mark:.2f}" for mark in LOWER),
}
ROW_COLUMNS = (
    *("frame", "id", "x", "y", "width", "height", "xVelocity", "yVelocity"),
    *("xAcceleration", "yAcceleration", "frontSightDistance", "backSightDistance"),
    *("dhw", "thw", "ttc", "precedingXVelocity", "precedingId", "followingId"),
    *("leftPrecedingId", "leftAlongsideId", "leftFollowingId", "rightPrecedingId"),
    *("rightAlongsideId", "rightFollowingId", "laneId"),
)
META_COLUMNS = (
    *("id", "width", "height", "initialFrame", "finalFrame", "numFrames", "class"),
    *("drivingDirection", "traveledDistance", "minXVelocity", "maxXVelocity"),
    *("meanXVelocity", "minDHW", "minTHW", "minTTC", "numLaneChanges"),
)


def _changing(t):
    """From lane 6 to lane 5 (to the left of the carriageway driven to +x)."""
    user = straight(t, (20.0, -26.88), 0.0, 28.0, size=(4.55, 2.02))
    u = np.clip((t - 3.0) / 5.0, 0.0, 1.0)
    y = user.y + 3.9 * u**2 * (3.0 - 2.0 * u)
    slope = np.gradient(y, t)
    return dataclasses.replace(
        user, y=y, heading=np.arctan2(slope, 28.0), speed=np.hypot(slope, 28.0)
    )


def road_users():
    """Number -> (class, direction, lane, road user, its frames from 0)."""
    left, right = (13.0, 2.5), (4.85, 2.12)
    return {
        "1": (
            "Car",
            2,
            5,
            straight(T, (5.0, -22.98), 0, 31.0, size=right),
            np.arange(300),
        ),
        "2": ("Car", 2, 6, _changing(T), np.arange(300)),
        "3": (
            "Truck",
            1,
            2,
            straight(T, (400.0, -10.55), np.pi, 24.0, size=left),
            np.arange(40, 250),
        ),
        "4": (
            "Car",
            1,
            3,
            straight(T, (410.0, -14.51), np.pi, 33.0, size=right),
            np.arange(90, 300),
        ),
    }


def write(folder):
    """The three files 01_*.csv."""
    rows, meta = [",".join(ROW_COLUMNS)], [",".join(META_COLUMNS)]
    for number, (kind, direction, lane, user, frames) in road_users().items():
        part = samples(user, frames)
        corner = (part.x - 0.5 * part.length, -part.y - 0.5 * part.width)
        vx, vy = part.speed * np.cos(part.heading), part.speed * np.sin(part.heading)
        for k, frame in enumerate(frames):
            place = (corner[0][k], corner[1][k], part.length, part.width, vx[k], -vy[k])
            floats = [f"{value:.2f}" for value in (*place, 0, 0, 300, 100, 0, 0, 0, 0)]
            cells = [frame + 1, number, *floats, *[0] * 8, lane]
            rows.append(",".join(str(cell) for cell in cells))
        ends = (frames[0] + 1, frames[-1] + 1, len(frames))
        cells = [number, part.length, part.width, *ends, kind, direction]
        meta.append(",".join(str(c) for c in [*cells, *[f"{-1.0:.2f}"] * 7, 0]))
    (folder / "01_tracks.csv").write_text("\n".join(rows) + "\n")
    (folder / "01_tracksMeta.csv").write_text("\n".join(meta) + "\n")
    values = ",".join(str(value) for value in META.values())
    (folder / "01_recordingMeta.csv").write_text(",".join(META) + "\n" + values + "\n")
    names = ("01_tracks.csv", "01_tracksMeta.csv", "01_recordingMeta.csv")
    files = tuple(folder / name for name in names)
    frame = cell(META_COLUMNS.index("initialFrame"))
    patterns = (cell(ROW_COLUMNS.index("x")), frame, r";([\d.]+);")
    return Fixture(
        input=folder,
        assumed=(4, 0, 0),
        rate_hz=RATE,
        tracks={n: samples(u, f) for n, (*_, u, f) in road_users().items()},
        num_lanes=4,
        has_heading=False,
        files=files,
        numbers=dict(zip(files, patterns, strict=True)),
        is_counted=True,
    )
