"""Semantic map of the L5 data: lanes, speed limits, stop signs, light faces.

Points are centimetres in a local frame of each lane (east, north, up at a latitude
and longitude); meta.json holds the transform of the dataset's world to Earth-centred
coordinates.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError

from rcirl_jax.data.formats.options import path_option
from rcirl_jax.data.formats.perception import STATES, held_states, signal_of
from rcirl_jax.data.formats.projection import earth_centred
from rcirl_jax.data.formats.shapes import (
    Roads,
    check_coordinates,
    facing,
    lane_between,
    limit_of,
    moves,
)
from rcirl_jax.data.readers.protobuf import Message, parsers
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import read_json
from rcirl_jax.runtime.checked import checked
from rcirl_jax.types import Lane, Signal

MAX_MAP_BYTES = 32 * 1024**2  # bytes; the public map has some 10 MB
MAX_META_BYTES = 16 * 1024**2  # bytes of meta.json
HOLD_S = 1.0  # s, a light unseen keeps its state this long
ONLY_BIKE = 4  # AccessRestriction.Type
BACKWARD = 3  # RoadNetworkSegment.TravelDirection
# traffic controls that are faces of one colour: round, arrows, U-turn, flashing
COLOURS = {
    **dict.fromkeys((11, 30, 32, 38, 41, 44, 10), "red"),
    **dict.fromkeys((12, 36, 37, 39, 42, 45, 9), "yellow"),
    **dict.fromkeys((13, 31, 33, 40, 43, 46), "green"),
}
FACES = ", ".join(f"face_{number} {number} Nothing" for number in COLOURS)
# the fields that are read of L5Kit's road_network.proto (package pb.lyft.maps)
SCHEMA = f"""
MapFragment: elements 2 MapElement*
MapElement: id 1 GlobalId, element 2 Element
GlobalId: id 1 string
Element: segment 1 Segment, lane 3 Lane, control 4 Control
Segment: limit 9 float, limit_backward 10 float
Lane: parent 1 GlobalId, frame 2 GeoFrame, left 3 Bound, right 4 Bound,\
 ahead 5 GlobalId*, beside_left 6 GlobalId, beside_right 7 GlobalId,\
 controls 8 GlobalId*, access 11 Access, direction 12 int64
GeoFrame: origin 1 GeoPoint, bearing 2 float
GeoPoint: latitude 1 sfixed32, longitude 2 sfixed32
Bound: x 1 sint32*, y 2 sint32*, z 3 sint32*
Access: type 1 int64
Control: stop_sign 7 Nothing, light 29 Light, {FACES}
Light: faces 3 GlobalId*
Nothing:
"""

read_message = parsers(SCHEMA)["MapFragment"]


def find_map(folder: Path, spec: dict) -> Path | None:
    """Finds semantic_map.pb as named in the TOML, or beside or above a dataset."""
    name = path_option(spec, "map")
    above = folder.resolve().parents
    inner = ("semantic_map.pb", "semantic_map/semantic_map.pb")
    places = [place / file for place in (folder, *above[:2]) for file in inner]
    if name:
        places = [place / name for place in (Path(), folder, *above[:3])]
    found = next((place for place in places if place.is_file()), None)
    if name and found is None:
        raise InputError(f"source TOML: map: {name}: expected a semantic map")
    return found


class SemanticMap:
    """All lanes of a map in the dataset's world, and the lights' faces."""

    def __init__(self, file: Path, to_ecef: np.ndarray) -> None:
        """Reads the whole map once.

        Args:
          file: semantic_map.pb.
          to_ecef: of `world_to_ecef`.

        Raises:
          InputError: no protocol buffer, coordinates off the Earth.
        """
        self.file = file
        self._to_world = np.linalg.inv(to_ecef)
        self._limits: dict[str, tuple[float, float]] = {}  # forward, backward
        self._faces: dict[str, str] = {}  # id -> colour
        self._lights: dict[str, tuple[str, ...]] = {}  # id -> ids of its faces
        self._stop_signs: set[str] = set()
        if file.stat().st_size > MAX_MAP_BYTES:
            raise InputError(
                f"{file}: size: {file.stat().st_size} bytes: "
                f"expected at most {MAX_MAP_BYTES}"
            )
        try:
            raw = dict(self._elements(read_message(file.read_bytes())))
            found = (self._lane(name, lane) for name, lane in raw.items())
            lanes = {lane.id: lane for lane in found if lane is not None}
        except DecodeError as error:
            raise InputError(f"{file}: {error}: expected a semantic map") from error
        if not lanes:
            raise InputError(f"{file}: lanes: none: expected a semantic map")
        every = list(lanes.values())
        self.roads = Roads([lane.centre for lane in every], every.__getitem__)

    def signals(
        self,
        lanes: Sequence[Lane],
        t: np.ndarray,
        frame: np.ndarray,
        face: np.ndarray,
        is_active: np.ndarray,
    ) -> tuple[Signal, ...]:
        """Makes one signal per set of faces that governs a lane and was seen.

        The state of a frame is the colour that most lit faces of the set show;
        a set unseen for a second is off.

        Args:
          lanes: of the scene.
          t: [frames] s.
          frame: [n] number of the frame in which a face was seen, ascending.
          face: [n] its id, text.
          is_active: [n] whether it was lit.
        """
        found = []
        for name in dict.fromkeys(name for lane in lanes for name in lane.signal_ids):
            members = np.array(name.split("|"))
            colours = np.array([STATES.index(self._faces[one]) for one in members])
            rows = np.flatnonzero(np.isin(face, members))
            if rows.size == 0:
                continue
            order = np.argsort(members)
            place = order[np.searchsorted(members[order], face[rows])]
            votes = np.zeros((t.size, len(STATES)), np.int64)
            np.add.at(votes, (frame[rows], colours[place]), is_active[rows])
            frames = np.unique(frame[rows])
            # without a vote it is off; ties go to the first
            states = held_states(t, t[frames], votes[frames].argmax(axis=1), HOLD_S)
            found.append(signal_of(name, t, states))
        return tuple(found)

    def _elements(self, fragment: Message) -> Iterator[tuple[str, Message]]:
        """Lanes of a MapFragment by id; limits and controls are kept on the way.

        Stubs without bounds and bicycle lanes are left out.
        """
        for entry in fragment.elements:
            name, element = entry.id.id, entry.element
            if element.HasField("segment"):
                segment = element.segment
                self._limits[name] = segment.limit, segment.limit_backward
            control = element.control
            if control.HasField("stop_sign"):
                self._stop_signs.add(name)
            if control.HasField("light"):
                self._lights[name] = tuple(face.id for face in control.light.faces)
            for field, _ in control.ListFields():
                if field.number in COLOURS:
                    self._faces[name] = COLOURS[field.number]
            if element.HasField("lane"):
                lane = element.lane
                is_whole = all(map(lane.HasField, ("frame", "left", "right")))
                if is_whole and lane.access.type != ONLY_BIKE:
                    yield name, lane

    def _bound(self, name: str, bound: Message, frame: np.ndarray) -> np.ndarray:
        """A lane bound [m, 2] m in the world; points that repeat are dropped."""
        x, y, up = (np.array(steps, np.int64) for steps in (bound.x, bound.y, bound.z))
        if x.size != y.size:
            raise InputError(
                f"{self.file}: lane {name}: {x.size} x for {y.size} y: expected as many"
            )
        up = up if up.size == x.size else np.zeros(x.size, np.int64)
        local = 0.01 * np.cumsum(np.stack([x, y, up]), axis=1)  # cm to m
        ones = np.ones((1, local.shape[1]))
        world = (self._to_world @ frame @ np.concatenate([local, ones]))[:2].T
        check_coordinates(self.file, f"lane {name}", ("x", "y"), world)
        return world[moves(world)] if len(world) else world

    def _lane(self, name: str, lane: Message) -> Lane | None:
        frame = _frame(lane.frame)
        left, right = (self._bound(name, b, frame) for b in (lane.left, lane.right))
        if min(len(left), len(right)) < 2:
            return None
        bounds = facing(left, right)
        if len(bounds[0]) < 2:
            return None
        # bounds may run against the traffic: then the left one lies to the right
        (x, y), across = np.diff(bounds[0] + bounds[1], axis=0)[0], left[0] - right[0]
        if x * across[1] - y * across[0] < 0.0:
            left, right = left[::-1], right[::-1]
            bounds = bounds[0][::-1], bounds[1][::-1]
        parent = lane.parent.id
        forward, back = self._limits.get(parent, (0.0, 0.0))
        limit = back if lane.direction == BACKWARD and back > 0.0 else forward
        controls = tuple(control.id for control in lane.controls)
        faces = []
        for control in controls:
            # a light has faces for other lanes too, say an arrow to the left: those
            # that the lane names count, all of them where it names none
            own = self._lights.get(control, (control,))
            faces += own if own == (control,) or set(own).isdisjoint(controls) else ()
        governing = sorted({face for face in faces if face in self._faces})
        stop_sign = any(control in self._stop_signs for control in controls)
        # who is inside a junction was held at its edge: a parent that is no segment
        at = 0 if parent and parent not in self._limits else -1
        stops = np.stack([left[at], right[at]]) if governing or stop_sign else None
        return lane_between(
            name,
            bounds,
            speed_limit=limit_of(limit),
            successors=tuple(other.id for other in lane.ahead),
            left=lane.beside_left.id or None,
            right=lane.beside_right.id or None,
            stop_line=stops,
            signal_ids=("|".join(governing),) if governing else (),
            stop_sign=stop_sign,
        )


def _frame(geo: Message) -> np.ndarray:
    """GeoFrame -> [4, 4] transform of local metres to Earth-centred ones.

    Origin in 1e-7 degrees on the WGS84 ellipsoid; bearing in degrees clockwise from
    north to the local y axis.
    """
    degrees = 1e-7 * geo.origin.latitude, 1e-7 * geo.origin.longitude
    if abs(degrees[0]) > 90.0 or abs(degrees[1]) > 180.0:
        raise DecodeError(f"frame at latitude, longitude {degrees}: not on Earth")
    latitude, longitude = np.deg2rad(degrees)
    turn = np.deg2rad(geo.bearing)
    flat = np.array([np.cos(longitude), np.sin(longitude), 0.0])
    east = np.array([-flat[1], flat[0], 0.0])
    up = np.cos(latitude) * flat + np.array([0.0, 0.0, np.sin(latitude)])
    north = np.cross(up, east)
    frame = np.eye(4)
    frame[:3, 0] = np.cos(turn) * east - np.sin(turn) * north
    frame[:3, 1] = np.sin(turn) * east + np.cos(turn) * north
    frame[:3, 2] = up
    frame[:3, 3] = earth_centred(*degrees)
    return frame


def world_to_ecef(file: Path, spec: dict) -> np.ndarray:
    """Reads the rigid transform [4, 4] in m of meta.json beside or above, or the TOML.

    Args:
      file: semantic_map.pb.
      spec: of the source; `world_to_ecef` counts where meta.json has none.

    Raises:
      InputError: no rigid transform.
    """
    where, found = "source TOML", spec.get("world_to_ecef")
    places = [folder / "meta.json" for folder in file.resolve().parents[:2]]
    for meta in [place for place in places if place.is_file()][:1]:
        content = checked(read_json(meta, "an object", MAX_META_BYTES), dict, meta)
        known = content.get("world_to_ecef", content.get("pose_to_ecef"))
        where, found = (where, found) if known is None else (str(meta), known)
    try:
        matrix = np.array(found, np.float64)
    except (ValueError, TypeError, OverflowError):
        matrix = np.zeros(0)
    rigid = (
        matrix.shape == (4, 4)
        and np.isfinite(matrix).all()
        and np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-3)
        and np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0])
    )
    if not rigid:
        raise InputError(
            f"{where}: world_to_ecef: {str(found)[:60]}: expected a rigid 4 x 4 matrix"
        )
    return matrix
