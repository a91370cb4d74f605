"""A Waymo Open Motion scenario, written with a tiny protobuf encoder.

A message is a list of (field number, value); the value's type says how it is
written: bool and int as varints, float as a double, `Single` as a float, str and
bytes with their length, a list as a nested message, `Packed` as packed varints.
Field numbers are those of the public scenario.proto and map.proto.
"""

import struct

import google_crc32c
import numpy as np

from rcirl_jax.types import Kind
from tests.data.importers.formats import Fixture
from tests.data.importers.formats.drives import arc, samples, straight

SCENARIO = "637f20cafde22ff8"
NUM_STEPS = 91
T = np.arange(NUM_STEPS) * 0.1
# real stamps jitter by fractions of a millisecond
STAMPS = T + np.where(T > 0.0, 2e-5 * np.sin(np.arange(NUM_STEPS)), 0.0)
EAST, NORTH = 8240.0, -2690.0  # m, from an arbitrary origin
WIDTH = 3.6  # m, of a lane
MPH = 0.44704  # m/s


class Single(float):
    """A number written as a 4-byte float."""


class Packed(list):
    """Whole numbers written packed."""


def varint(value):
    value &= (1 << 64) - 1
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def field(number, value):
    if isinstance(value, bool | int):
        return varint(number << 3) + varint(int(value))
    if isinstance(value, Single):
        return varint(number << 3 | 5) + struct.pack("<f", value)
    if isinstance(value, float):
        return varint(number << 3 | 1) + struct.pack("<d", value)
    if isinstance(value, Packed):
        data = b"".join(varint(item) for item in value)
    elif isinstance(value, str):
        data = value.encode()
    else:
        data = value if isinstance(value, bytes) else message(value)
    return varint(number << 3 | 2) + varint(len(data)) + data


def message(fields):
    return b"".join(field(number, value) for number, value in fields)


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
    return [
        (2, float(user.x[row])),
        (3, float(user.y[row])),
        (4, -11.5),
        (5, Single(user.length)),
        (6, Single(user.width)),
        (7, Single(1.6)),
        (8, Single(heading)),
        (9, Single(speed * np.cos(heading))),
        (10, Single(speed * np.sin(heading))),
        (11, True),
    ]


def track(key, kind, user, seen):
    states = [
        (3, state(user, row) if row in set(seen) else [(11, False)])
        for row in range(user.t.size)
    ]
    return [(1, key), (2, kind), *states]


def point(x, y):
    return [(1, float(x)), (2, float(y)), (3, -11.5)]


def polyline(number, rows):
    return [(number, point(x, y)) for x, y in rows]


def lane(key, rows, *, limit=25.0, kind=2, entry=(), leave=(), sides=(), neighbours=()):
    """A lane feature; sides and neighbours are (field number, message)."""
    parts = [(1, limit), (2, kind), (3, False), *polyline(8, rows)]
    parts += [(9, Packed(entry))] if entry else []
    parts += [(10, Packed(leave))] if leave else []
    return [(1, key), (3, [*parts, *sides, *neighbours])]


def boundary(number, first, last, key):
    return (number, [(1, first), (2, last), (3, key), (4, 2)])


def neighbour(number, key, first, last):
    spans = [(2, first), (3, last), (4, first), (5, last)]
    return (number, [(1, key), *spans, boundary(6, first, last, 901)])


def line(key, rows, kind=4):
    """A road line (4) or road edge (5)."""
    return [(1, key), (kind, [(1, 2), *polyline(2, rows)])]


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
        "sides": [boundary(13, 0, last, 901), boundary(14, 0, last, 902)],
        "neighbours": [neighbour(11, 102, 0, last)],
    }
    second = {
        "sides": [boundary(14, 0, last, 901)],
        "neighbours": [neighbour(12, 101, 0, last)],
    }
    return [
        lane(101, south, leave=(103,), **first),
        lane(102, north, leave=(104,), **second),
        lane(103, eastward(0.0, 40.0, 120.0), entry=(101,), limit=35.0),
        lane(104, turn, entry=(102,)),
        lane(105, [(EAST + 40.0, NORTH + 9.0)]),  # a lane of one point: left out
        lane(106, eastward(-4.0, -60.0, 40.0), kind=3),  # a bicycle lane
        line(901, eastward(WIDTH / 2, -60.0, 40.0, 5.0)),
        line(902, eastward(-2.0, -80.0, 60.0, 20.0), kind=5),
        [(1, 903), (7, [(1, 104), (2, point(EAST + 39.0, NORTH + 8.0))])],
        [(1, 904), (8, polyline(1, eastward(0.0, 30.0, 34.0)))],  # crosswalk
        [(1, 905), (10, polyline(1, eastward(9.0, 0.0, 4.0)))],  # driveway
    ]


def signal_state(step):
    """Red, unseen for half a second, red, green; seen first at step 3."""
    if step < 3 or 20 <= step < 25:
        return []
    return [(1, 103), (2, 4 if step < 50 else 6), (3, point(EAST + 40.0, NORTH))]


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
    """All fields of a Scenario by number; `changes` replace some: f2=[...]."""
    users = road_users()
    fields = {
        "f1": [float(stamp) for stamp in STAMPS],
        "f2": [track(key, *values) for key, values in users.items()],
        "f7": [[(1, s)] if (s := signal_state(k)) else [] for k in range(NUM_STEPS)],
        "f8": map_features(),
        "f4": [2320, 2325],
        "f5": [SCENARIO],
        "f6": [0],
        "f10": [10],
        "f11": [[(1, 1), (2, 1)]],
    }
    fields.update(changes)
    return message(
        [(int(key[1:]), item) for key, items in fields.items() for item in items]
    )


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
        records = [scenario(f5=[f"scenario-{shard}-{letter}"]) for letter in "ab"]
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
        rate_hz=10.0,
        tracks=expected(),
        num_lanes=4,
        num_signals=1,
        files=(path,),
        checked=(path,),
    )
