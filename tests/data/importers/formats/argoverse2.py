"""An Argoverse 2 motion scenario: Parquet columns and map as published.

Columns, their order and types follow the published files (av2-api,
scenario_serialization.py): ids are text, `map_id` is uint64, the stamps are
nanoseconds as doubles. The map has the motion data set's `centerline`.
"""

import dataclasses
import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from rcirl_jax.types import Kind
from tests.data.importers.formats import Fixture
from tests.data.importers.formats.drives import arc, samples, straight

SCENARIO = "0a0b3c1d-0000-4a98-b02e-db8c9327d151"
SLICE = "7bef7e1f-8c90-4ba5-b39e-b3f134aa5bbe"
FOCAL = "138951"
NUM_STEPS = 110
STEP_S = 0.1
OBSERVED = 50  # steps before the forecast horizon
START_NS = 3.15986559459579e17
# east and north of the city's origin [m], where the road begins
EAST, NORTH = -436.0, 1310.0
WIDTH = 3.4  # m, of a lane

# track id -> (object type, category, road user, steps with an observation)
T = np.arange(NUM_STEPS) * STEP_S


def road_users():
    """Everyone in the scenario, at every step of the clock."""
    up = np.pi / 2
    right = EAST + 1.5 * WIDTH
    av = straight(T, (right, NORTH), up, 9.0, wave=2.5, size=(4.87, 1.85))
    return {
        "AV": ("vehicle", 1, av),
        FOCAL: ("vehicle", 3, arc(T, (EAST + WIDTH / 2, NORTH + 30.0), up, 6.0, 20.0)),
        "138902": ("vehicle", 0, straight(T, (right, NORTH + 20.0), up, 9.5)),
        "139400": ("bus", 2, straight(T, (right, NORTH - 30.0), up, 8.0, wave=1.0)),
        "139408": ("cyclist", 1, straight(T, (right + 3.0, NORTH + 5.0), up, 4.0)),
        "139397": ("pedestrian", 0, straight(T, (EAST + 9.0, NORTH + 60.0), 3.0, 1.4)),
        "139507": ("static", 0, straight(T, (EAST + 9.0, NORTH + 10.0), 1.5, 0.0)),
    }


OBSERVATIONS = {
    # in view for a part of the scenario only
    "138902": np.arange(30, 81),
    # three steps missing, then twenty: the second gap ends the track
    "139400": np.r_[5:40, 43:60, 80:105],
    "139397": np.arange(0, 65),
}
SIZES = {
    "bus": (12.0, 2.6),
    "cyclist": (1.8, 0.7),
    "pedestrian": (0.7, 0.7),
    "static": (1.0, 1.0),
}
KINDS = {
    "cyclist": Kind.CYCLIST,
    "pedestrian": Kind.PEDESTRIAN,
    "static": Kind.STATIC,
}


def columns():
    """The columns of the Parquet file as lists, in the published order."""
    parts = []
    for name, (kind, category, user) in road_users().items():
        steps = OBSERVATIONS.get(name, np.arange(NUM_STEPS))
        user = samples(user, steps)
        parts.append(
            {
                "observed": (steps < OBSERVED).tolist(),
                "track_id": [name] * steps.size,
                "object_type": [kind] * steps.size,
                "object_category": [category] * steps.size,
                "timestep": steps.tolist(),
                "position_x": user.x.tolist(),
                "position_y": user.y.tolist(),
                "heading": user.heading.tolist(),
                "velocity_x": (user.speed * np.cos(user.heading)).tolist(),
                "velocity_y": (user.speed * np.sin(user.heading)).tolist(),
            }
        )
    table = {key: [v for part in parts for v in part[key]] for key in parts[0]}
    count = len(table["timestep"])
    end = START_NS + (NUM_STEPS - 1) * STEP_S * 1e9
    for key, value in {
        **{"scenario_id": SCENARIO, "start_timestamp": START_NS},
        **{"end_timestamp": end, "num_timestamps": NUM_STEPS},
        **{"focal_track_id": FOCAL, "city": "austin"},
        **{"map_id": 74806, "slice_id": SLICE},
    }.items():
        table[key] = [value] * count
    return table


def write_parquet(path, table):
    """Columns -> Parquet, with the published types."""
    arrays = {
        key: pa.array(values, pa.uint64()) if key == "map_id" else pa.array(values)
        for key, values in table.items()
    }
    # checksums, so that a garbled page is seen for certain
    pq.write_table(pa.table(arrays), path, write_page_checksum=True)
    return path


def points(*rows):
    return [{"x": round(x, 2), "y": round(y, 2), "z": 22.27} for x, y in rows]


def segment(key, left, right, **changes):
    """A lane segment with all of its published keys."""
    middle = 0.5 * (np.array([left[0], left[-1]]) + np.array([right[0], right[-1]]))
    return {
        "centerline": points(*middle),
        "id": key,
        "is_intersection": False,
        "lane_type": "VEHICLE",
        "left_lane_boundary": points(*left),
        "left_lane_mark_type": "DASHED_WHITE",
        "left_neighbor_id": None,
        "predecessors": [],
        "right_lane_boundary": points(*right),
        "right_lane_mark_type": "SOLID_WHITE",
        "right_neighbor_id": None,
        "successors": [],
        **changes,
    }


def straight_segment(key, x, south, north, width=WIDTH, **changes):
    """A lane straight north (south > north: straight south) about x [m]."""
    half = 0.5 * width * np.sign(north - south)
    middle = 0.4 * south + 0.6 * north
    left = [(x - half, south), (x - half, middle), (x - half, north)]
    return segment(key, left, [(x + half, south), (x + half, north)], **changes)


def vector_map():
    """Two lanes north, one south, a left turn, a bicycle lane."""
    inner, outer = EAST + WIDTH / 2, EAST + 1.5 * WIDTH
    south, middle, north = NORTH - 60.0, NORTH + 30.0, NORTH + 140.0
    turn = np.linspace(0.0, np.pi / 2, 8)
    ring = np.stack([EAST - 20.0 + WIDTH / 2 + 0.0 * turn, middle + 0.0 * turn], 1)
    circle = np.stack([np.cos(turn), np.sin(turn)], 1)
    segments = [
        straight_segment(205119001, inner, south, middle, right_neighbor_id=205119002),
        straight_segment(205119002, outer, south, middle, left_neighbor_id=205119001),
        straight_segment(205119003, inner, middle, north),
        straight_segment(205119004, outer, middle, north),
        # the other way: the devkit names it as left neighbour nevertheless
        straight_segment(205119005, EAST - WIDTH / 2, north, south),
        segment(
            205119006,
            ring + (20.0 - WIDTH / 2) * circle,
            ring + (20.0 + WIDTH / 2) * circle,
            is_intersection=True,
        ),
        straight_segment(205119007, outer + 3.0, south, north, 1.6, lane_type="BIKE"),
    ]
    lanes = {str(lane["id"]): lane for lane in segments}
    lanes["205119001"].update(
        left_neighbor_id=205119005,
        left_lane_mark_type="DOUBLE_SOLID_YELLOW",
        successors=[205119003, 205119006],
    )
    lanes["205119002"].update(successors=[205119004], right_neighbor_id=205119007)
    lanes["205119003"].update(predecessors=[205119001], successors=[205999999])
    area = [(EAST - WIDTH, south), (outer + 4.0, south), (outer + 4.0, north)]
    return {
        "drivable_areas": {"1": {"area_boundary": points(*area), "id": 1}},
        "lane_segments": lanes,
        "pedestrian_crossings": {},
    }


def write_scenario(folder, *, name=SCENARIO, table=None, lanes=None):
    """One scenario folder; returns the paths of its two files."""
    place = folder / name
    place.mkdir(parents=True, exist_ok=True)
    parquet = write_parquet(place / f"scenario_{name}.parquet", table or columns())
    map_file = place / f"log_map_archive_{name}.json"
    map_file.write_text(json.dumps(vector_map() if lanes is None else lanes))
    return parquet, map_file


def expected():
    """Tracks by the ids that the importer gives."""
    tracks = {}
    for name, (kind, _, user) in road_users().items():
        steps = OBSERVATIONS.get(name, np.arange(NUM_STEPS))
        length, width = SIZES.get(kind, (user.length, user.width))
        about = {"kind": KINDS.get(kind, Kind.VEHICLE), "length": length}
        written = dataclasses.replace(samples(user, steps), **about, width=width)
        cuts = np.flatnonzero(np.diff(steps) > 10) + 1
        for part, rows in enumerate(np.split(np.arange(steps.size), cuts), start=1):
            label = name if part == 1 else f"{name}#{part}"
            tracks[label] = samples(written, rows)
    return tracks


def write(folder):
    """A split folder `train` with one scenario."""
    files = write_scenario(folder / "train")
    return Fixture(
        input=folder / "train",
        assumed=(6, 0, 8),  # sizes are by type
        rate_hz=1.0 / STEP_S,
        tracks=expected(),
        num_lanes=6,
        files=files,
        checked=files[:1],
        numbers={files[1]: r'left_lane_boundary": \[\{"x": ([^,}]*)'},
        is_counted=True,
    )


# ---------------------------------------------------------------------- harms


def cells(column, value, rows=slice(None)):
    """What puts a value into rows of a column."""

    def harm(fixture):
        table = columns()
        table[column][rows] = [value] * len(table[column][rows])
        write_parquet(fixture.files[0], table)

    return harm


def without(column):
    def harm(fixture):
        table = pq.read_table(fixture.files[0]).drop_columns(column)
        pq.write_table(table, fixture.files[0])

    return harm


def segment_with(**changes):
    """What changes fields of a lane segment."""

    def harm(fixture):
        lanes = vector_map()
        lanes["lane_segments"]["205119002"].update(changes)
        fixture.files[1].write_text(json.dumps(lanes))

    return harm


ONE = slice(3, 4)
POINT, NAN = {"x": 1.0, "y": 2.0, "z": 3.0}, float("nan")
# what is done to the table or the map, and what the line says
HARMS = {
    "row 4: position_x: 'nan': expected a finite": cells("position_x", NAN, ONE),
    "row 1: position_x: 'left': expected a finite": cells("position_x", "left"),
    # the recording car's own speed is measured: if that is wrong, so is the file
    "track AV: speed: 300": cells("velocity_x", 300.0, ONE),
    "row 3: timestep: 110: expected a whole number from 0": cells("timestep", 110, ONE),
    "t: 2: met twice": cells("timestep", 2, slice(0, 40)),
    "row 3: object_category: 7: expected 0 to 3": cells("object_category", 7, ONE),
    "track 138902: object_type: tank": cells("object_type", "tank"),
    "column track_id: type binary: expected text": cells("track_id", b"\xff\xfe"),
    # 100 MB when written out, refused without that
    "expected up to 64 characters": cells("track_id", "x" * 100_000),
    "column velocity_y: missing": without("velocity_y"),
    "lane_type: RAIL": segment_with(lane_type="RAIL"),
    "lane segment 205119002: id: 7: expected a whole": segment_with(id="7"),
    "lane segment 205119001: id: met twice": segment_with(id=205119001),
    "left_lane_boundary: [{": segment_with(left_lane_boundary=[POINT]),
    "right_lane_boundary: x: nan at point 1": segment_with(
        right_lane_boundary=[POINT, {"x": NAN, "y": 2}]
    ),
}
OPTIONS = [
    *[{"sizes": {"vehicle": size}} for size in ("long", [12.0], None)],
    *[{"lane_types": ["TRAM"]}, {"speed_limit": "fast"}],
]
