"""A Waymo Open Motion scenario, as of the public scenario.proto and map.proto."""

import struct

import google_crc32c
import numpy as np

from rcirl_jax.types import Kind
from tests.data.importers.formats import Fixture
from tests.data.importers.formats.drives import arc, samples, straight
from tests.data.importers.formats.proto import classes, written

# enums are numbers, so that such as are none can be written
SCHEMA = """
ObjectState: center_x 2 double, center_y 3 double, center_z 4 double, length 5 float,\
 width 6 float, height 7 float, heading 8 float, velocity_x 9 float,\
 velocity_y 10 float, valid 11 bool
Track: id 1 int32, object_type 2 int32, states 3 .ObjectState*
MapPoint: x 1 double, y 2 double, z 3 double
LaneState: lane 1 int64, state 2 int32, stop_point 3 .MapPoint
DynamicMapState: lane_states 1 .LaneState*
Boundary: lane_start_index 1 int32, lane_end_index 2 int32,\
 boundary_feature_id 3 int64, boundary_type 4 int32
Neighbor: feature_id 1 int64, self_start_index 2 int32, self_end_index 3 int32,\
 neighbor_start_index 4 int32, neighbor_end_index 5 int32, boundaries 6 .Boundary*
Lane: speed_limit_mph 1 double, type 2 int32, interpolating 3 bool,\
 polyline 8 .MapPoint*, entry_lanes 9 int64*, exit_lanes 10 int64*,\
 left_neighbors 11 .Neighbor*, right_neighbors 12 .Neighbor*,\
 left_boundaries 13 .Boundary*, right_boundaries 14 .Boundary*
Line: type 1 int32, polyline 2 .MapPoint*
Area: polygon 1 .MapPoint*
StopSign: lane 1 int64*, position 2 .MapPoint
MapFeature: id 1 int64, lane 3 .Lane, road_line 4 .Line, road_edge 5 .Line,\
 stop_sign 7 .StopSign, crosswalk 8 .Area, driveway 10 .Area
Prediction: track_index 1 int32, difficulty 2 int32
Scenario: timestamps_seconds 1 double*, tracks 2 .Track*, objects_of_interest 4 int32*,\
 scenario_id 5 string, sdc_track_index 6 int32, dynamic_map_states 7 .DynamicMapState*,\
 map_features 8 .MapFeature*, current_time_index 10 int32,\
 tracks_to_predict 11 .Prediction*, lidar 12 bytes*
"""
MESSAGES = classes({"waymo": SCHEMA})
SCENARIO = "637f20cafde22ff8"
NUM_STEPS = 91
T = np.arange(NUM_STEPS) * 0.1
# real stamps jitter by fractions of a millisecond
STAMPS = T + np.where(T > 0.0, 2e-5 * np.sin(np.arange(NUM_STEPS)), 0.0)
EAST, NORTH = 8240.0, -2690.0  # m, from an arbitrary origin
WIDTH = 3.6  # m, of a lane
MPH = 0.44704  # m/s


def masked_crc(data):
    crc = google_crc32c.value(data)
    return struct.pack("<I", ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF)


def tfrecord(records):
    """Framed records: length, its checksum, data, its checksum."""
    out = b""
    for data in records:
        length = struct.pack("<Q", len(data))
        out += length + masked_crc(length) + data + masked_crc(data)
    return out


# ------------------------------------------------------------------- scenario


def state(user, row):
    """ObjectState with all fields, as the published files have them."""
    heading, speed = float(user.heading[row]), float(user.speed[row])
    return {
        **{"center_x": user.x[row], "center_y": user.y[row], "center_z": -11.5},
        **{"length": user.length, "width": user.width, "height": 1.6},
        **{"heading": heading, "velocity_x": speed * np.cos(heading)},
        **{"velocity_y": speed * np.sin(heading), "valid": True},
    }


def track(key, kind, user, seen, **changes):
    """A track with a state per step; `changes` are made to those that are seen."""
    seen = set(seen)
    states = [
        {**state(user, row), **changes} if row in seen else {"valid": False}
        for row in range(user.t.size)
    ]
    return {"id": key, "object_type": kind, "states": states}


def point(x, y):
    return {"x": x, "y": y, "z": -11.5}


def polyline(rows):
    return [point(x, y) for x, y in rows]


def lane(key, rows, *, speed_limit_mph=25.0, kind=2, **more):
    """A lane feature with more fields of it."""
    body = {"speed_limit_mph": speed_limit_mph, "type": kind, "interpolating": False}
    return {"id": key, "lane": {**body, "polyline": polyline(rows), **more}}


def boundary(first, last, key):
    ends = {"lane_start_index": first, "lane_end_index": last}
    return {**ends, "boundary_feature_id": key, "boundary_type": 2}


def neighbour(key, first, last):
    own = {"feature_id": key, "self_start_index": first, "self_end_index": last}
    other = {"neighbor_start_index": first, "neighbor_end_index": last}
    return {**own, **other, "boundaries": [boundary(first, last, 901)]}


def line(key, rows, kind="road_line"):
    """A road line or road edge."""
    return {"id": key, kind: {"type": 2, "polyline": polyline(rows)}}


def eastward(y, first, last, step=0.5):
    """Points half a metre apart, as published."""
    x = np.arange(first, last + 0.5 * step, step)
    return [(EAST + value, NORTH + y) for value in x]


def map_features():
    """Two lanes east to a signal, the way across, a turn with a stop sign."""
    south, north = eastward(0.0, -60.0, 40.0), eastward(WIDTH, -60.0, 40.0)
    last = len(south) - 1
    angle = np.linspace(0.0, np.pi / 2, 40)
    turn = [
        (EAST + 40.0 + 15.0 * np.sin(a), NORTH + WIDTH + 15.0 * (1.0 - np.cos(a)))
        for a in angle
    ]
    first = {
        "left_boundaries": [boundary(0, last, 901)],
        "right_boundaries": [boundary(0, last, 902)],
        "left_neighbors": [neighbour(102, 0, last)],
    }
    second = {
        "right_boundaries": [boundary(0, last, 901)],
        "right_neighbors": [neighbour(101, 0, last)],
    }
    sign = {"lane": [104], "position": point(EAST + 39.0, NORTH + 8.0)}
    return [
        lane(101, south, exit_lanes=[103], **first),
        lane(102, north, exit_lanes=[104], **second),
        lane(103, eastward(0.0, 40.0, 120.0), entry_lanes=[101], speed_limit_mph=35.0),
        lane(104, turn, entry_lanes=[102]),
        lane(105, [(EAST + 40.0, NORTH + 9.0)]),  # a lane of one point: left out
        lane(106, eastward(-4.0, -60.0, 40.0), kind=3),  # a bicycle lane
        line(901, eastward(WIDTH / 2, -60.0, 40.0, 5.0)),
        line(902, eastward(-2.0, -80.0, 60.0, 20.0), "road_edge"),
        {"id": 903, "stop_sign": sign},
        {"id": 904, "crosswalk": {"polygon": polyline(eastward(0.0, 30.0, 34.0))}},
        {"id": 905, "driveway": {"polygon": polyline(eastward(9.0, 0.0, 4.0))}},
    ]


def shown(*states, **more):
    """A DynamicMapState of lane 103."""
    return {"lane_states": [{"lane": 103, "state": state, **more} for state in states]}


def signal_states(step):
    """Red, unseen for half a second, red, green; seen first at step 3."""
    if step < 3 or 20 <= step < 25:
        return {}
    return shown(4 if step < 50 else 6, stop_point=point(EAST + 40.0, NORTH))


def road_users():
    """Track id -> (object type, road user, steps where it is valid)."""
    every = range(NUM_STEPS)
    walker = {"kind": Kind.PEDESTRIAN, "size": (0.8, 0.75)}
    cyclist = {"kind": Kind.CYCLIST, "size": (1.7, 0.7)}

    def east(x, y, speed, **more):
        return straight(T, (EAST + x, NORTH + y), 0.0, speed, **more)

    return {
        2314: (1, east(-50.0, 0.0, 8.0, wave=3.0), every),
        2320: (1, arc(T, (EAST + 40.0, NORTH + WIDTH), 0.0, 6.0, 15.0), every),
        2325: (1, east(-80.0, 0.0, 10.0), range(12, 60)),
        # three invalid steps are bridged, thirty end the track
        2331: (
            *(1, east(-40.0, WIDTH, 7.0)),
            [*range(0, 20), *range(23, 40), *range(70, NUM_STEPS)],
        ),
        2340: (2, straight(T, (EAST + 20, NORTH - 6), 1.5, 1.3, **walker), every),
        2341: (3, east(-30.0, -4.0, 4.5, **cyclist), range(0, 80)),
    }


def scenario(**changes):
    """Bytes of a Scenario; `changes` replace some of its fields."""
    fields = {
        "timestamps_seconds": STAMPS,
        "tracks": [track(key, *values) for key, values in road_users().items()],
        "dynamic_map_states": [signal_states(step) for step in range(NUM_STEPS)],
        "map_features": map_features(),
        "objects_of_interest": [2320, 2325],
        "scenario_id": SCENARIO,
        "sdc_track_index": 0,
        "current_time_index": 10,
        "tracks_to_predict": [{"track_index": 1, "difficulty": 1}],
    }
    return written(MESSAGES.Scenario, **{**fields, **changes})


def expected():
    """Tracks by the ids that the importer gives; x and y in local metres."""
    tracks = {}
    for key, (_, user, seen) in road_users().items():
        seen = np.array(list(seen))
        cuts = np.flatnonzero(np.diff(seen) > 10) + 1
        for part, rows in enumerate(np.split(seen, cuts), start=1):
            name = str(key) if part == 1 else f"{key}#{part}"
            tracks[name] = samples(user, rows)
    return tracks


def write_shards(folder, shards=4):
    """Files of two scenarios each, in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for shard in range(shards):
        records = [
            scenario(scenario_id=f"scenario-{shard}-{letter}") for letter in "ab"
        ]
        name = f"training_20s.tfrecord-{shard:05d}-of-01000"
        (folder / name).write_bytes(tfrecord(records))


def write(folder):
    """A folder of shards, as published, with one scenario."""
    place = folder / "scenario" / "training"
    place.mkdir(parents=True)
    path = place / "training.tfrecord-00000-of-01000"
    path.write_bytes(tfrecord([scenario()]))
    return Fixture(
        input=place,
        assumed=(0, 3, 0),  # lanes that no line bounds on one side
        rate_hz=10.0,
        tracks=expected(),
        num_lanes=4,
        num_signals=1,
        files=(path,),
        checked=(path,),
    )


# ---------------------------------------------------------------------- harms


def with_fields(**changes):
    """What writes a scenario with other fields."""

    def harm(fixture):
        fixture.files[0].write_bytes(tfrecord([scenario(**changes)]))

    return harm


def stamped(values):
    return with_fields(timestamps_seconds=values)


def cars(*, key=1, kind=1, count=1, rows=range(NUM_STEPS), **changes):
    user = road_users()[2314][1]
    return with_fields(tracks=[track(key, kind, user, rows, **changes)] * count)


def road(*features):
    return with_fields(map_features=list(features))


NAN, SHORT = float("nan"), eastward(0, 0, 9)
# what is done to the scenario, and what the line says
HARMS = {
    "timestamps_seconds: [] (0): expected increasing times": stamped([]),
    "timestamps_seconds: 9.00002e+06 s": stamped(STAMPS * 1e6),
    "per second: expected 10 (unit s)": stamped(STAMPS * 10),
    "track 2314: 91 states: expected 50": stamped(STAMPS[:50]),
    "tracks: none: expected Scenario": with_fields(tracks=[]),
    "track id: 1: met twice": cars(count=3),
    "track 1: object_type: 9: expected one of vehicle": cars(kind=9),
    "center_x: nan": cars(center_x=NAN),
    "speed: 500": cars(velocity_x=500.0),
    "width: -2 m": cars(width=-2.0),
    "dynamic_map_states: 90: expected 91": with_fields(dynamic_map_states=[{}] * 90),
    "lane 103: signal state 77": with_fields(dynamic_map_states=[shown(77)] * 91),
    "speed_limit_mph: nan": road(lane(1, SHORT, speed_limit_mph=NAN)),
    "map points: x: nan": road(lane(1, [(0.0, 0.0), (NAN, 1.0)])),
    "map feature 1: met twice": road(*[lane(1, SHORT)] * 2),
}
OPTIONS = [
    {"kinds": {"vehicle": "boat", "pedestrian": "pedestrian", "cyclist": "cyclist"}},
    *[{"lane_types": bad} for bad in (["tram"], 3)],
    {"pattern": [3, "/"]},
]
