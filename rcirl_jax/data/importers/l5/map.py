"""Semantic map of the L5 data: lanes, speed limits, stop signs, light faces.

Layout: l5kit/data/proto/road_network.proto (package pb.lyft.maps); the field
numbers below are those of its messages. Points are centimetres in a local frame
of each lane (east, north, up at a latitude and longitude); meta.json holds the
transform of the dataset's world to Earth-centred coordinates.
"""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rcirl_jax.data.importers.options import path_option
from rcirl_jax.data.importers.projection import earth_centred
from rcirl_jax.data.importers.shapes import between_bounds, check_coordinates, moves
from rcirl_jax.data.readers.wire import (
    Value,
    WireError,
    fields,
    nested,
    packed_sint32,
    text,
)
from rcirl_jax.data.readers.zarr2 import read_json
from rcirl_jax.errors import InputError
from rcirl_jax.types import Lane, Signal

MAX_MAP_BYTES = 1024**3  # bytes; the public map has some 10 MB
MAX_META_BYTES = 16 * 1024**2  # bytes of meta.json
MARGIN_M = 150.0  # m of map around the tracks
HOLD_S = 1.0  # s, a light unseen keeps its state this long
MAX_LIMIT_MPS = 60.0  # m/s; faster "limits" are none
SEGMENT, LANE, CONTROL = 1, 3, 4  # fields of MapElement.Element
ONLY_BIKE = 4  # AccessRestriction.Type
BACKWARD = 3  # RoadNetworkSegment.TravelDirection
STOP_SIGN, TRAFFIC_LIGHT = 7, 29  # fields of TrafficControlElement
# its fields that are faces of one colour: round, arrows, U-turn, flashing
COLOURS = {
    **dict.fromkeys((11, 30, 32, 38, 41, 44, 10), "red"),
    **dict.fromkeys((12, 36, 37, 39, 42, 45, 9), "yellow"),
    **dict.fromkeys((13, 31, 33, 40, 43, 46), "green"),
}
NOTHING = memoryview(b"")
STATES = ("red", "yellow", "green")  # ties of a vote go to the first


@dataclasses.dataclass(frozen=True, kw_only=True)
class LightFaces:
    """Faces of traffic lights as seen in the frames of a scene."""

    t: np.ndarray  # [frames] s
    frame: np.ndarray  # [n] number of the frame, ascending
    face: np.ndarray  # [n] id, text
    is_active: np.ndarray  # [n] bool, lit


@dataclasses.dataclass(frozen=True, kw_only=True)
class _RawLane:
    id: str
    left: np.ndarray  # [m, 2] m, in the world
    right: np.ndarray  # [k, 2] m
    parent: str
    backward: bool
    ahead: tuple[str, ...]
    beside: tuple[str | None, str | None]  # left, right
    controls: tuple[str, ...]


def find_map(folder: Path, spec: dict) -> Path | None:
    """semantic_map.pb as named in the TOML, or beside or above a dataset."""
    name = path_option(spec, "map")
    above = folder.resolve().parents
    if name:
        places = [place / name for place in (Path(), folder, *above[:3])]
        found = next((place for place in places if place.is_file()), None)
        if found is None:
            raise InputError(f"source TOML: map: {name}: expected a semantic map")
        return found
    places = [
        place / inner / "semantic_map.pb"
        for place in (folder, *above[:2])
        for inner in ("", "semantic_map")
    ]
    return next((place for place in places if place.is_file()), None)


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
            raw = list(self._elements(memoryview(file.read_bytes())))
        except WireError as error:
            raise InputError(f"{file}: {error}: expected a semantic map") from error
        lanes = {lane.id: lane for lane in map(self._lane, raw) if lane is not None}
        if not lanes:
            raise InputError(f"{file}: lanes: none: expected a semantic map")
        self._lanes = list(lanes.values())
        self._boxes = np.array(
            [[lane.centre.min(axis=0), lane.centre.max(axis=0)] for lane in self._lanes]
        ).reshape(-1, 2, 2)

    def lanes(self, x: np.ndarray, y: np.ndarray, origin: np.ndarray) -> tuple:
        """Lanes around positions [m], less the origin."""
        low = np.array([x.min(), y.min()]) - MARGIN_M
        high = np.array([x.max(), y.max()]) + MARGIN_M
        near = (self._boxes[:, 1] >= low).all(1) & (self._boxes[:, 0] <= high).all(1)
        return tuple(
            dataclasses.replace(
                lane,
                centre=lane.centre - origin,
                stop_line=None if lane.stop_line is None else lane.stop_line - origin,
            )
            for lane in (self._lanes[index] for index in np.flatnonzero(near))
        )

    def signals(self, lanes: tuple[Lane, ...], seen: LightFaces) -> tuple:
        """One signal per set of faces that governs a lane and was seen.

        The state of a frame is the colour that most lit faces of the set show;
        a set unseen for a second is off.
        """
        names = dict.fromkeys(name for lane in lanes for name in lane.signal_ids)
        found = (self._signal(name, seen) for name in names)
        return tuple(signal for signal in found if signal is not None)

    def _signal(self, name: str, seen: LightFaces) -> Signal | None:
        members = name.split("|")
        colours = np.array([STATES.index(self._faces[face]) for face in members])
        rows = np.flatnonzero(np.isin(seen.face, members))
        if rows.size == 0:
            return None
        order = np.argsort(members)
        place = order[np.searchsorted(np.array(members)[order], seen.face[rows])]
        votes = np.zeros((seen.t.size, len(STATES)), np.int64)
        np.add.at(votes, (seen.frame[rows], colours[place]), seen.is_active[rows])
        state = np.where(votes.any(axis=1), votes.argmax(axis=1), -1)
        was_seen = np.zeros(seen.t.size, bool)
        was_seen[seen.frame[rows]] = True
        last = np.maximum.accumulate(np.where(was_seen, np.arange(seen.t.size), -1))
        fresh = (last >= 0) & (seen.t - seen.t[last] <= HOLD_S)
        state = np.where(fresh, state[last], -1)
        change = np.flatnonzero(np.diff(state, prepend=-2) != 0)
        return Signal(
            id=name,
            start=seen.t[change],
            state=tuple(STATES[k] if k >= 0 else "off" for k in state[change]),
        )

    def _elements(self, buffer: memoryview) -> Iterator[_RawLane]:
        """Lanes of a MapFragment; limits and controls are kept on the way."""
        for number, _, element in fields(buffer):
            if number != 2:
                continue
            entry = {key: nested(v) for key, _, v in fields(nested(element)) if key < 3}
            name = _id(entry.get(1, NOTHING))
            for kind, _, value in fields(entry.get(2, NOTHING)):
                if kind == SEGMENT:
                    self._limits[name] = _limits(nested(value))
                elif kind == CONTROL:
                    self._add_control(name, nested(value))
                elif kind == LANE:
                    lane = self._raw_lane(name, nested(value))
                    yield from () if lane is None else (lane,)

    def _add_control(self, name: str, buffer: memoryview) -> None:
        for number, _, value in fields(buffer):
            if number == STOP_SIGN:
                self._stop_signs.add(name)
            elif number in COLOURS:
                self._faces[name] = COLOURS[number]
            elif number == TRAFFIC_LIGHT:
                parts = fields(nested(value))
                self._lights[name] = tuple(
                    _id(nested(v)) for n, _, v in parts if n == 3
                )

    def _raw_lane(self, name: str, buffer: memoryview) -> _RawLane | None:
        """Lane message; None for stubs without bounds and for bicycle lanes."""
        one: dict[int, memoryview] = {}
        many: dict[int, list[str]] = {5: [], 8: []}
        backward = False
        for number, _, value in fields(buffer):
            if number in many:
                many[number].append(_id(nested(value)))
            elif number == 12:
                backward = value == BACKWARD
            elif isinstance(value, memoryview):
                one[number] = value
        access = {n: v for n, _, v in fields(one.get(11, NOTHING))}
        if not {2, 3, 4} <= one.keys() or access.get(1) == ONLY_BIKE:
            return None
        frame = _frame(one[2])
        left, right = (self._bound(name, one[side], frame) for side in (3, 4))
        if min(len(left), len(right)) < 2:
            return None
        sides = [_id(one[key]) if key in one else "" for key in (6, 7)]
        return _RawLane(
            id=name,
            left=left,
            right=right,
            parent=_id(one[1]) if 1 in one else "",
            backward=backward,
            ahead=tuple(many[5]),
            beside=(sides[0] or None, sides[1] or None),
            controls=tuple(many[8]),
        )

    def _bound(self, name: str, buffer: memoryview, frame: np.ndarray) -> np.ndarray:
        """A lane bound [m, 2] m in the world; points that repeat are dropped."""
        found = {number: value for number, _, value in fields(buffer)}
        steps = [packed_sint32(nested(found.get(axis, NOTHING))) for axis in (1, 2)]
        up = packed_sint32(nested(found.get(3, NOTHING)))
        if steps[0].size != steps[1].size:
            raise WireError(f"lane {name}: {steps[0].size} x for {steps[1].size} y")
        up = up if up.size == steps[0].size else np.zeros(steps[0].size, np.int64)
        local = 0.01 * np.cumsum(np.stack([*steps, up]), axis=1)  # cm to m
        ones = np.ones((1, local.shape[1]))
        world = (self._to_world @ frame @ np.concatenate([local, ones]))[:2].T
        check_coordinates(self.file, f"lane {name}", ("x", "y"), world)
        return world[moves(world)] if len(world) else world

    def _faces_of(self, controls: tuple[str, ...]) -> list[str]:
        """Faces that govern a lane: those it names; a light's, where it names none.

        A light has faces for other lanes too, say an arrow to the left.
        """
        named, found = set(controls), []
        for name in controls:
            faces = self._lights.get(name, (name,))
            found += faces if faces == (name,) or named.isdisjoint(faces) else ()
        return found

    def _lane(self, raw: _RawLane) -> Lane | None:
        left, right = raw.left, raw.right
        centre, half = between_bounds(left, right)
        if len(centre) < 2:
            return None
        # bounds may run against the traffic: then the left one lies to the right
        along, across = centre[1] - centre[0], left[0] - right[0]
        if along[0] * across[1] - along[1] * across[0] < 0.0:
            left, right = left[::-1], right[::-1]
            centre, half = centre[::-1], half[::-1]
        forward, back = self._limits.get(raw.parent, (0.0, 0.0))
        limit = back if raw.backward and back > 0.0 else forward
        faces = self._faces_of(raw.controls)
        governing = sorted({face for face in faces if face in self._faces})
        stop_sign = any(name in self._stop_signs for name in raw.controls)
        stops = bool(governing) or stop_sign
        # who is inside a junction was held at its edge: a parent that is no segment
        at = 0 if raw.parent and raw.parent not in self._limits else -1
        return Lane(
            id=raw.id,
            centre=centre,
            left_width=half,
            right_width=half,
            speed_limit=limit if 0.0 < limit <= MAX_LIMIT_MPS else None,
            successors=raw.ahead,
            left=raw.beside[0],
            right=raw.beside[1],
            stop_line=np.stack([left[at], right[at]]) if stops else None,
            signal_ids=("|".join(governing),) if governing else (),
            stop_sign=stop_sign,
        )


def _id(buffer: memoryview) -> str:
    """GlobalId: id 1."""
    return next((text(value) for number, _, value in fields(buffer) if number == 1), "")


def _limits(buffer: memoryview) -> tuple[float, float]:
    """Speed limits [m/s] of a RoadNetworkSegment: 9, backward 10; 0 if unknown."""
    found = {number: value for number, _, value in fields(buffer)}
    return _fixed32(found.get(9), "<f4"), _fixed32(found.get(10), "<f4")


def _fixed32(value: Value | None, kind: str) -> float:
    """A number of four bytes; 0 where the field is not set."""
    if value is None:
        return 0.0
    if len(nested(value)) != 4:
        raise WireError(f"{len(nested(value))} bytes: expected a number of four")
    return float(np.frombuffer(nested(value), kind)[0])


def _frame(buffer: memoryview) -> np.ndarray:
    """GeoFrame -> [4, 4] transform of local metres to Earth-centred ones.

    Origin (1) in 1e-7 degrees on the WGS84 ellipsoid; bearing (2) in degrees
    clockwise from north to the local y axis.
    """
    found = {number: value for number, _, value in fields(buffer)}
    place = {n: v for n, _, v in fields(nested(found.get(1, NOTHING)))}
    degrees = [1e-7 * _fixed32(place.get(key), "<i4") for key in (1, 2)]
    latitude, longitude = np.deg2rad(degrees)
    turn = np.deg2rad(_fixed32(found.get(2), "<f4"))
    if abs(degrees[0]) > 90.0 or abs(degrees[1]) > 180.0:
        raise WireError(f"frame at latitude, longitude {degrees}: not on Earth")
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    up = np.array(
        [
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude),
        ]
    )
    north = np.cross(up, east)
    frame = np.eye(4)
    frame[:3, 0] = np.cos(turn) * east - np.sin(turn) * north
    frame[:3, 1] = np.sin(turn) * east + np.cos(turn) * north
    frame[:3, 2] = up
    frame[:3, 3] = earth_centred(*degrees)
    return frame


def world_to_ecef(file: Path, spec: dict) -> np.ndarray:
    """Rigid transform [4, 4] in m: of meta.json beside or above, or of the TOML.

    Args:
      file: semantic_map.pb.
      spec: of the source; `world_to_ecef` counts where meta.json has none.

    Raises:
      InputError: no rigid transform.
    """
    places = [folder / "meta.json" for folder in file.resolve().parents[:2]]
    meta = next((place for place in places if place.is_file()), None)
    where, found = "source TOML", spec.get("world_to_ecef")
    if meta is not None:
        content = read_json(meta, MAX_META_BYTES)
        known = content.get("world_to_ecef", content.get("pose_to_ecef"))
        if known is not None:
            where, found = str(meta), known
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
