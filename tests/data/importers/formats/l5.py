"""Two scenes of an L5 prediction dataset in the public folder layout.

scenes/sample.zarr (zarr 2, blosc-compressed structured arrays of L5Kit's dtypes),
semantic_map/semantic_map.pb and meta.json. The world's origin lies in Palo Alto;
the map's lanes have a local frame of their own, 200 m away.
"""

import dataclasses
import json
import shutil

import numpy as np
import pyproj
import tensorstore

from rcirl_jax.data.readers.zarr2 import StructuredArray
from rcirl_jax.types import Kind
from tests.data.importers.formats import Fixture
from tests.data.importers.formats.drives import samples, seen_by_a_car
from tests.data.importers.formats.proto import classes, written

T = 0.1 * np.arange(100)
# frames come a few milliseconds early or late
STAMPS = T + np.where(T > 0.0, 0.003 * np.sin(np.arange(100)), 0.0)
START_NS = 1572643684801892606  # as in the public sample
SCENE_DTYPE = [
    ("frame_index_interval", np.int64, (2,)),
    ("host", "<U16"),
    ("start_time", np.int64),
    ("end_time", np.int64),
]
FRAME_DTYPE = [
    ("timestamp", np.int64),
    ("agent_index_interval", np.int64, (2,)),
    ("traffic_light_faces_index_interval", np.int64, (2,)),
    ("ego_translation", np.float64, (3,)),
    ("ego_rotation", np.float64, (3, 3)),
]
AGENT_DTYPE = [
    ("centroid", np.float64, (2,)),
    ("extent", np.float32, (3,)),
    ("yaw", np.float32),
    ("velocity", np.float32, (2,)),
    ("track_id", np.uint64),
    ("label_probabilities", np.float32, (17,)),
]
TL_FACE_DTYPE = [
    ("face_id", "<U16"),
    ("traffic_light_id", "<U16"),
    ("traffic_light_face_status", np.float32, (3,)),
]
UNKNOWN, CAR, CYCLIST, PEDESTRIAN = 1, 3, 12, 14  # labels
LABEL = {Kind.VEHICLE: CAR, Kind.CYCLIST: CYCLIST, Kind.PEDESTRIAN: PEDESTRIAN}
RED, GREEN = "rED1", "gRN1"  # faces of the light
LIGHT = "lGT1"
GREEN_FROM = 60  # frame in which the light turns green
CENTRE = np.array([600.0, -900.0])  # m, in the world: where the scene is
LATITUDE, LONGITUDE = 374310000, -1221585000  # 1e-7 degrees, of the map's frame
HALF = np.array([0.0, 1.75])  # m, half a lane to the left
WORLD_TO_ECEF = np.array(
    [
        [8.46617444e-01, 3.23463078e-01, -4.22623402e-01, -2.69876744e06],
        [-5.32201938e-01, 5.14559352e-01, -6.72301845e-01, -4.29315158e06],
        [-3.05311332e-16, 7.94103464e-01, 6.07782600e-01, 3.85516476e06],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


def road_users():
    """Id -> motion; 17 is seen for a part of the scene, 19 with a gap."""
    users = seen_by_a_car(STAMPS, (4.87, 1.85))
    del users["31"]
    for name, user in users.items():
        x, y = user.x + CENTRE[0], user.y + CENTRE[1]
        users[name] = dataclasses.replace(user, x=x, y=y)
    users["17"] = samples(users["17"], slice(30, 80))
    return users


GAP = slice(40, 60)  # frames in which 19 is hidden


# id -> the frames it is seen in
VISIBLE = {name: np.arange(100) for name in road_users() if name != "ego"}
VISIBLE["17"] = np.arange(30, 80)
VISIBLE["19"] = np.delete(np.arange(100), GAP)


def agents(users):
    """All agents, and the interval of each frame."""
    records, frames = [], []
    for name, frame in VISIBLE.items():
        user = users[name]
        at = np.searchsorted(user.t, STAMPS[frame])
        part = np.zeros(frame.size, AGENT_DTYPE)
        part["centroid"] = np.stack([user.x, user.y], axis=1)[at]
        part["extent"] = user.length, user.width, 1.6
        part["yaw"] = user.heading[at]
        part["velocity"] = np.stack(
            [user.speed * np.cos(user.heading), user.speed * np.sin(user.heading)], 1
        )[at]
        part["track_id"] = int(name)
        part["label_probabilities"][:, LABEL[user.kind]] = 1.0
        records.append(part)
        frames.append(frame)
    # a bush: class unknown, jitters
    bush = np.zeros(100, AGENT_DTYPE)
    bush["centroid"] = CENTRE + np.array([20.0, 9.0])
    bush["extent"], bush["track_id"] = (0.9, 0.8, 1.0), 99
    bush["label_probabilities"][:, UNKNOWN] = 1.0
    records.append(bush)
    frames.append(np.arange(100))
    frame = np.concatenate(frames)
    order = np.argsort(frame, kind="stable")
    ends = np.cumsum(np.bincount(frame, minlength=100))
    return np.concatenate(records)[order], np.stack(
        [ends - np.bincount(frame), ends], 1
    )


def faces():
    """Red until GREEN_FROM, both faces in every frame."""
    found = np.zeros(200, TL_FACE_DTYPE)
    found["face_id"] = [RED, GREEN] * 100
    found["traffic_light_id"] = "l1gh"
    green = np.repeat(np.arange(100) >= GREEN_FROM, 2)
    lit = np.where(np.arange(200) % 2 == 1, green, ~green)
    found["traffic_light_face_status"][:, 0] = lit
    found["traffic_light_face_status"][:, 1] = ~lit
    starts = 2 * np.arange(100)
    return found, np.stack([starts, starts + 2], axis=1)


def write_array(folder, records, chunk):
    """A zarr array as zarr-python writes it: .zarray of named fields, blosc."""
    fields = [
        [name, records.dtype[name].base.str, *([list(shape)] if shape else [])]
        for name in records.dtype.names
        for shape in [records.dtype[name].shape]
    ]
    blosc = {"id": "blosc", "cname": "lz4", "clevel": 5, "shuffle": 1, "blocksize": 0}
    metadata = {
        "zarr_format": 2,
        "shape": [records.size],
        "chunks": [chunk],
        "dtype": [["record", "|u1", [records.dtype.itemsize]]],
        "compressor": blosc,
        "filters": None,
        "fill_value": None,
        "order": "C",
    }
    place = {"driver": "file", "path": str(folder)}
    spec = {"driver": "zarr", "kvstore": place, "metadata": metadata}
    store = tensorstore.open(spec, create=True).result()
    shape = (records.size, records.dtype.itemsize)
    raw = np.ascontiguousarray(records).view(np.uint8).reshape(shape)
    store.write(raw).result()
    metadata["dtype"], metadata["fill_value"] = fields, "AAAA"
    (folder / ".zarray").write_text(json.dumps(metadata, indent=4))


def write_zarr(folder, *, scenes=2, start=START_NS, host="host-a013"):
    """Scenes of the same traffic, 30 s apart, at one host."""
    users = road_users()
    seen, intervals = agents(users)
    lights, light_intervals = faces()
    frames = np.zeros(100 * scenes, FRAME_DTYPE)
    ego = users["ego"]
    for scene in range(scenes):
        part = frames[100 * scene : 100 * (scene + 1)]
        later = np.round((STAMPS + 40.0 * scene) * 1e9).astype(np.int64)
        part["timestamp"] = start + later
        part["agent_index_interval"] = intervals + scene * len(seen)
        part["traffic_light_faces_index_interval"] = light_intervals + 200 * scene
        part["ego_translation"] = np.stack([ego.x, ego.y, np.full(100, 288.1)], axis=1)
        part["ego_rotation"] = np.eye(3)
    table = np.zeros(scenes, SCENE_DTYPE)
    for scene in range(scenes):
        begin, end = frames["timestamp"][[100 * scene, 100 * scene + 99]]
        table[scene] = ([100 * scene, 100 * (scene + 1)], host, begin, end)
    folder.mkdir(parents=True)
    (folder / ".zgroup").write_text('{"zarr_format": 2}')
    (folder / ".zattrs").write_text('{"format_version": 2, "labels": []}')
    write_array(folder / "scenes", table, 10)
    write_array(folder / "frames", frames, 64)
    write_array(folder / "agents", np.tile(seen, scenes), 500)
    write_array(folder / "traffic_light_faces", np.tile(lights, scenes), 100)


# --------------------------------------------------------------- semantic map


FACES = ", ".join(f"face_{number} {number} .Nothing" for number in (11, 13))
SCHEMA = f"""
Nothing:
GlobalId: id 1 bytes
Segment: speed_limit 9 float
GeoLocation: lat_e7 1 sfixed32, lng_e7 2 sfixed32
GeoFrame: origin 1 .GeoLocation
Boundary: x 1 sint32*, y 2 sint32*, z 3 sint32*
Lane: parent 1 .GlobalId, frame 2 .GeoFrame, left 3 .Boundary, right 4 .Boundary,\
 ahead 5 .GlobalId*, beside_left 6 .GlobalId, beside_right 7 .GlobalId,\
 controls 8 .GlobalId*
Light: faces 3 .GlobalId*
Control: light 29 .Light, {FACES}
Element: segment 1 .Segment, lane 3 .Lane, control 4 .Control, junction 5 .Nothing
MapElement: id 1 .GlobalId, element 2 .Element
MapFragment: name 1 bytes, elements 2 .MapElement*
"""
MESSAGES = classes({"lyft": SCHEMA})


def ids(names):
    """GlobalIds."""
    return [{"id": name.encode()} for name in names]


def to_local(world):
    """Centimetres [n, 3] in the frame of the map's lanes."""
    points = np.concatenate([world, np.zeros((len(world), 1))], axis=1)
    ecef = points @ WORLD_TO_ECEF[:3, :3].T + WORLD_TO_ECEF[:3, 3]
    place = f"lat_0={LATITUDE * 1e-7} lon_0={LONGITUDE * 1e-7}"
    local = pyproj.Transformer.from_pipeline(f"+proj=topocentric {place} ellps=WGS84")
    return 100.0 * np.stack(local.transform(*ecef.T), axis=1)


def bound(points):
    local = np.round(to_local(np.asarray(points, np.float64))).astype(int)
    steps = np.diff(local, axis=0, prepend=np.zeros((1, 3), int))
    return dict(zip("xyz", steps.T, strict=True))


def lane(name, bounds, *, parent="seg", ahead=(), controls=(), **beside):
    body = {
        "parent": {"id": parent.encode()},
        "frame": {"origin": {"lat_e7": LATITUDE, "lng_e7": LONGITUDE}},
        **{"left": bound(bounds[0]), "right": bound(bounds[1])},
        **{"ahead": ids(ahead), "controls": ids(controls)},
        **{f"beside_{side}": {"id": other.encode()} for side, other in beside.items()},
    }
    return element(name, lane=body)


def element(name, **kind):
    """MapElement with a segment, lane, traffic control or junction."""
    return {"id": {"id": name.encode()}, "element": kind}


def write_map(path, controls=(RED, GREEN), inside=()):
    """A road before a junction; `controls` govern its right lane, `inside` the next."""
    x, y = CENTRE
    grid = np.linspace(-60.0, 60.0, 13)

    def along(offset):
        return np.stack([x + grid, np.full(13, y + offset)], axis=1)

    angle = np.linspace(0.0, 2.2, 16)

    def turn(radius):
        centre = np.array([x + 60.0, y + 25.0])
        return centre + radius * np.stack([np.sin(angle), -np.cos(angle)], axis=1)

    last = np.array([[x + 60.0, y], [x + 160.0, y]])
    linked = {"ahead": ("b1", "c1"), "left": "a2", "controls": controls}
    elements = [
        element("seg", segment={"speed_limit": 11.176}),
        element("jun", junction={}),
        element(RED, control={"face_11": {}}),
        element(GREEN, control={"face_13": {}}),
        element(LIGHT, control={"light": {"faces": ids((RED, GREEN))}}),
        lane("a1", (along(1.75), along(-1.75)), **linked),
        # drawn against the traffic: the left bound lies to the right of the points
        lane("a2", (along(5.25)[::-1], along(1.75)[::-1]), right="a1"),
        lane("b1", (turn(23.25), turn(26.75)), parent="jun"),
        lane("c1", (last + HALF, last - HALF), parent="jun", controls=inside),
        element("stub", lane={"parent": {"id": b"seg"}}),
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(written(MESSAGES.MapFragment, name=b"map", elements=elements))
    return path


def write(folder):
    dataset = folder / "scenes" / "sample.zarr"
    write_zarr(dataset)
    semantic_map = write_map(folder / "semantic_map" / "semantic_map.pb")
    meta = folder / "meta.json"
    meta.write_text(json.dumps({"world_to_ecef": WORLD_TO_ECEF.tolist()}))
    users = road_users()
    gapped = users.pop("19")
    users["19"] = samples(gapped, slice(0, GAP.start))
    users["19#2"] = samples(gapped, slice(GAP.stop, None))
    return Fixture(
        input=folder,
        assumed=(4, 0, 2),  # the ego, in two scenes
        rate_hz=10.0,
        tracks=users,
        num_lanes=4,
        num_signals=1,
        files=(
            *(dataset / name / ".zarray" for name in ("scenes", "agents")),
            *(dataset / name / "0" for name in ("scenes", "agents")),
            *(dataset / "frames" / "1", dataset / "traffic_light_faces" / "0"),
            *(semantic_map, meta),
        ),
        numbers={
            dataset / "scenes" / ".zarray": r'"shape": \[\s*(\d+)',
            dataset / "agents" / ".zarray": r'"shape": \[\s*(\d+)',
            meta: r"(-?\d+\.\d+)",
        },
        is_counted=True,
    )


# ---------------------------------------------------------------------- harms


def change(dataset, name, edit):
    """Rewrite an array of a dataset; `edit` may return other records."""
    array = StructuredArray(dataset / name, {})
    records = array.read(0, array.size).copy()
    edited = edit(records)
    shutil.rmtree(dataset / name)
    write_array(dataset / name, records if edited is None else edited, array.chunk)


def put(array, name, value, row=5):
    """What puts a value into a row of an array."""

    def edit(records):
        records[name][row] = value

    return lambda fixture: change(fixture.files[0].parents[1], array, edit)


def character(point):
    """A text whose first character is a number."""
    return np.array([point, 65], "<u4").view("<U2")[0]


def placed(**fields):
    """What writes a semantic map of one lane of these fields."""
    body = {"parent": {}, "frame": {}, "left": bound([[0, 0]] * 2), **fields}
    body.setdefault("right", bound([[0, 1]] * 2))
    made = written(MESSAGES.MapFragment, elements=[element("x", lane=body)])
    return lambda fixture: fixture.files[-2].write_bytes(made)


def transform(matrix):
    """What writes another meta.json."""
    content = json.dumps({"world_to_ecef": matrix})
    return lambda fixture: fixture.files[-1].write_text(content)


NAN, FRAMES = float("nan"), "frame_index_interval"
# what is done to an array, the map or its transform, and what the line says
HARMS = {
    "centroid: x: nan": put("agents", "centroid", NAN),
    "length: -1 m: expected 0 to": put("agents", "extent", -1.0),
    "speed: 14142": put("agents", "velocity", 1e4, slice(0, 3)),
    "label_probabilities: not finite": put("agents", "label_probabilities", NAN),
    "met twice": put("agents", "track_id", 15, slice(0, 9)),
    "expected a rotation matrix": put("frames", "ego_rotation", 0.0),
    "goes backwards": put("frames", "timestamp", 0),
    "frame 5: [9, 1]: expected an interval": put(
        "frames", "agent_index_interval", [9, 1]
    ),
    "interval within 0 to": put("frames", "agent_index_interval", [0, 10**15]),
    "host: characters that are none": put("scenes", "host", character(0xDCFF), 0),
    "[0, 0]: expected frames": put("scenes", FRAMES, [0, 0], 0),
    "expected a rigid 4 x 4 matrix": transform([[0.0] * 4] * 4),
    "lanes: none: expected a semantic map": placed(),
    "2 x for 0 y: expected as many": placed(left={"x": [1, 1]}),
    "not on Earth": placed(frame={"origin": {"lat_e7": 2 * 10**9}}),
}
OPTIONS = [
    *[{"recording_car": "x"}, {"ego": 3}, {"unknown": "x"}, {"rate_hz": 0}],
    *[{"min_probability": "x"}, {"map": "gone.pb"}],
]
