"""An inD recording in the layout of release 1.1: data/ and maps/lanelets/."""

import dataclasses

import numpy as np

from rcirl_jax.types import Kind
from tests.data.importers.formats import Fixture, cell, osm
from tests.data.importers.formats.drives import arc, samples, straight

RATE = 25.0  # 1/s
FRAMES = 300
T = np.arange(FRAMES) / RATE
SHIFT = (3.0, -41.75)  # m, of the map in the recording's frame (y is negative)
ZONE, UTM_ORIGIN = 32, (297631.3187, 5629917.34465)
META = {
    **{"recordingId": 7, "locationId": 4, "frameRate": "25.00000"},
    **{"speedLimit": "13.88889", "weekday": "wednesday", "startTime": 16},
    **{"duration": "961.08000", "numTracks": 6, "numVehicles": 4, "numVRUs": 2},
    **{"latLocation": "50.78505", "lonLocation": "6.13070"},
    **{"xUtmOrigin": UTM_ORIGIN[0], "yUtmOrigin": UTM_ORIGIN[1]},
    "orthoPxToMeter": "0.0126999352667008",
}
ROW_COLUMNS = (
    *("recordingId", "trackId", "frame", "trackLifetime", "xCenter", "yCenter"),
    *("heading", "width", "length", "xVelocity", "yVelocity", "xAcceleration"),
    *("yAcceleration", "lonVelocity", "latVelocity", "lonAcceleration"),
    "latAcceleration",
)


def place(x, y):
    """A point of the map in the recording's frame."""
    return x + SHIFT[0], y + SHIFT[1]


def turning(t, speed, before):
    """Straight east along the lane, then the right turn."""
    ahead = straight(t, place(osm.TURN_X - before, osm.EAST_Y), 0.0, speed)
    since = t - before / speed
    bend = arc(since, place(osm.TURN_X, osm.EAST_Y), 0.0, speed, -osm.RADIUS)
    series = ("x", "y", "heading")
    joined = {
        n: np.where(since < 0.0, getattr(ahead, n), getattr(bend, n)) for n in series
    }
    return dataclasses.replace(ahead, **joined)


def road_users():
    """Track number -> (class, road user, its frames)."""
    west = place(150.0, osm.WEST_Y)
    walk, ride = {"kind": Kind.PEDESTRIAN}, {"kind": Kind.CYCLIST}
    return {
        "0": ("car", straight(T, place(5.0, osm.EAST_Y), 0.0, 10.0), np.arange(300)),
        "1": ("car", turning(T, 8.0, 60.0), np.arange(20, 255)),
        "2": (
            "truck_bus",
            straight(T, west, np.pi, 11.0, size=(11.5, 2.5)),
            np.arange(50, 220),
        ),
        "3": (
            "pedestrian",
            straight(T, place(60.0, 7.0), 0.0, 1.4, size=(0.5, 0.5), **walk),
            np.arange(300),
        ),
        "4": (
            "bicycle",
            straight(T, place(10.0, -3.0), 0.0, 4.0, size=(1.8, 0.6), **ride),
            np.arange(100, 300),
        ),
        "5": ("car", straight(T, place(30.0, -22.0), 0.3, 0.0), np.arange(300)),
    }


def write_tracks(folder, name, users, columns=ROW_COLUMNS, more=None):
    """XX_tracks.csv and XX_tracksMeta.csv; `more` maps further columns to cells."""
    more, rows = more or {}, [",".join([*columns, *(more or {})])]
    meta = ["recordingId,trackId,initialFrame,finalFrame,numFrames,width,length,class"]
    for number, (kind, user, frames) in users.items():
        box = kind not in ("pedestrian", "bicycle")
        size = (user.width, user.length) if box else (0.0, 0.0)
        part = samples(user, frames)
        vx, vy = part.speed * np.cos(part.heading), part.speed * np.sin(part.heading)
        degrees = np.rad2deg(part.heading) % 360.0
        for k, frame in enumerate(frames):
            floats = [part.x[k], part.y[k], degrees[k], *size, vx[k], vy[k], 0.0, 0.0]
            floats += [part.speed[k], 0.0, 0.0, 0.0]
            cells = [7, number, frame, k, *(f"{value:.5f}" for value in floats)]
            rows.append(",".join(str(c) for c in [*cells, *more.values()]))
        ends = (frames[0], frames[-1], len(frames))
        cells = [7, number, *ends, *(f"{value:.5f}" for value in size), kind]
        meta.append(",".join(str(c) for c in cells))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}_tracks.csv").write_text("\n".join(rows) + "\n")
    (folder / f"{name}_tracksMeta.csv").write_text("\n".join(meta) + "\n")


def write_meta(folder, name, **changes):
    """XX_recordingMeta.csv."""
    meta = {**META, **changes}
    text = (
        ",".join(meta) + "\n" + ",".join(str(value) for value in meta.values()) + "\n"
    )
    (folder / f"{name}_recordingMeta.csv").write_text(text)


def write(folder):
    """The recording 07 with the map of its location beside it."""
    data = folder / "data"
    write_tracks(data, "07", road_users())
    write_meta(data, "07")
    osm.lanelet_map(
        folder / "maps" / "lanelets" / "04_aseag" / "location4.osm",
        osm.in_degrees(ZONE, UTM_ORIGIN),
        SHIFT,
    )
    names = [f"07_{kind}.csv" for kind in ("tracks", "tracksMeta", "recordingMeta")]
    place_of_map = folder / "maps" / "lanelets" / "04_aseag" / "location4.osm"
    columns = (ROW_COLUMNS.index("xCenter"), 2, [*META].index("xUtmOrigin"))
    cells = zip([data / name for name in names], map(cell, columns), strict=True)
    return Fixture(
        input=folder,
        assumed=(2, 0, 2),  # a pedestrian and a cyclist have no boxes
        rate_hz=RATE,
        tracks={n: samples(u, frames) for n, (_, u, frames) in road_users().items()},
        num_lanes=osm.NUM_LANES,
        files=(*(data / name for name in names), place_of_map),
        numbers={**dict(cells), place_of_map: "lat='([^']*)'"},
        is_counted=True,
    )
