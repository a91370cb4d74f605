"""INTERACTION recordings of 2019: track files per scene, maps in their folder."""

import numpy as np

from rcirl_jax.types import Kind
from tests.data.importers.formats import Fixture, cell, osm
from tests.data.importers.formats.drives import samples, straight
from tests.data.importers.formats.levelx import turning

SCENE = "DR_USA_Intersection_EP0"
STEPS = 150
T = np.arange(STEPS) / 10.0
SHIFT = (1000.0, 1000.0)  # m, coordinates lie about (1000, 1000)
VEHICLE_COLUMNS = (
    *("track_id", "frame_id", "timestamp_ms", "agent_type", "x", "y", "vx", "vy"),
    *("psi_rad", "length", "width"),
)
# UTM of (0, 0) in zone 31: what maps in degrees are relative to
ORIGIN = (166021.44308054057, 0.0)


def place(x, y):
    """A point of the map in the recording's frame."""
    return x + SHIFT[0], y + SHIFT[1]


def road_users():
    """Number -> (agent type, road user, its steps)."""
    moved = turning(T, 7.0, 50.0)
    # `turning` starts in the frame of the inD fixture
    shifted = straight(T, (0.0, 0.0), 0.0, 0.0)
    dx, dy = place(osm.TURN_X - 50.0, osm.EAST_Y)
    x, y = moved.x - moved.x[0] + dx, moved.y - moved.y[0] + dy
    series = {"t": T, "heading": moved.heading, "speed": moved.speed, "x": x, "y": y}
    bend = type(shifted)(kind=Kind.VEHICLE, length=4.8, width=1.9, **series)
    walk, ride = {"kind": Kind.PEDESTRIAN}, {"kind": Kind.CYCLIST}
    return {
        "1": ("car", straight(T, place(5.0, osm.EAST_Y), 0.0, 9.0), np.arange(150)),
        "2": ("car", bend, np.arange(20, 115)),
        "3": (
            "car",
            straight(T, place(150.0, osm.WEST_Y), np.pi, 8.0, size=(7.2, 2.3)),
            np.arange(40, 150),
        ),
        "P4": (
            "pedestrian/bicycle",
            straight(T, place(60.0, 7.0), 0.0, 1.3, size=(0.5, 0.5), **walk),
            np.arange(150),
        ),
        "P13": (
            "pedestrian/bicycle",
            straight(T, place(10.0, 7.0), 0.0, 5.0, size=(1.8, 0.6), **ride),
            np.arange(30, 150),
        ),
    }


def row(number, kind, user, k, step):
    """Cells of one state up to vy, as the files write them."""
    vx = user.speed[k] * np.cos(user.heading[k])
    vy = user.speed[k] * np.sin(user.heading[k])
    numbers = (user.x[k], user.y[k], vx, vy)
    return [number, step + 1, 100 * (step + 1), kind, *(f"{v:.3f}" for v in numbers)]


def write_scene(folder, users):
    """vehicle_tracks_000.csv and pedestrian_tracks_000.csv."""
    folder.mkdir(parents=True, exist_ok=True)
    vehicles = [",".join(VEHICLE_COLUMNS)]
    pedestrians = [",".join(VEHICLE_COLUMNS[:8])]
    for number, (kind, user, steps) in users.items():
        part = samples(user, steps)
        for k, step in enumerate(steps):
            cells = row(number, kind, part, k, step)
            if kind == "car":
                box = (f"{part.heading[k]:.3f}", part.length, part.width)
                vehicles.append(",".join(str(c) for c in [*cells, *box]))
            else:
                pedestrians.append(",".join(str(c) for c in cells))
    (folder / "vehicle_tracks_000.csv").write_text("\n".join(vehicles) + "\n")
    (folder / "pedestrian_tracks_000.csv").write_text("\n".join(pedestrians) + "\n")


def write(folder):
    """One scene with vehicles and pedestrians, and its map in both forms."""
    scene = folder / "recorded_trackfiles" / SCENE
    write_scene(scene, road_users())
    maps = folder / "maps"
    osm.lanelet_map(maps / f"{SCENE}.osm_xy", osm.in_metres, SHIFT)
    osm.lanelet_map(maps / f"{SCENE}.osm", osm.in_degrees(31, ORIGIN), SHIFT)
    tracks = [scene / f"{kind}_tracks_000.csv" for kind in ("vehicle", "pedestrian")]
    place_of_map, x = maps / f"{SCENE}.osm_xy", cell(VEHICLE_COLUMNS.index("x"))
    return Fixture(
        input=folder,
        assumed=(2, 0, 2),  # a pedestrian and a cyclist have no boxes
        rate_hz=10.0,
        tracks={n: samples(u, steps) for n, (_, u, steps) in road_users().items()},
        num_lanes=osm.NUM_LANES,
        files=(*tracks, place_of_map),
        drops_rows=True,
        numbers={**dict.fromkeys(tracks, x), place_of_map: " x='([^']*)'"},
    )
