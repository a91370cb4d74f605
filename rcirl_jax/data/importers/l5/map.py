"""Semantic map of the L5 data: lanes, speed limits, stop signs, light faces.

Points are centimetres in a local frame of each lane (east, north, up at a latitude
and longitude); meta.json holds the transform of the dataset's world to Earth-centred
coordinates.
"""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError

from rcirl_jax.data.importers.l5.messages import COLOURS, read_message
from rcirl_jax.data.importers.options import path_option
from rcirl_jax.data.importers.projection import earth_centred
from rcirl_jax.data.importers.shapes import between_bounds, check_coordinates, moves
from rcirl_jax.data.readers.protobuf import Message
from rcirl_jax.data.readers.zarr2 import read_json
from rcirl_jax.errors import InputError
from rcirl_jax.types import Lane, Signal

MAX_MAP_BYTES = 32 * 1024**2  # bytes; the public map has some 10 MB
MAX_META_BYTES = 16 * 1024**2  # bytes of meta.json
MARGIN_M = 150.0  # m of map around the tracks
HOLD_S = 1.0  # s, a light unseen keeps its state this long
MAX_LIMIT_MPS = 60.0  # m/s; faster "limits" are none
ONLY_BIKE = 4  # AccessRestriction.Type
BACKWARD = 3  # RoadNetworkSegment.TravelDirection
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
            raw = list(self._elements(read_message(file.read_bytes())))
        except DecodeError as error:
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

    def _elements(self, fragment: Message) -> Iterator[_RawLane]:
        """Lanes of a MapFragment; limits and controls are kept on the way."""
        for entry in fragment.elements:
            name, element = entry.id.id, entry.element
            if element.HasField("segment"):
                segment = element.segment
                self._limits[name] = segment.limit, segment.limit_backward
            if element.HasField("control"):
                self._add_control(name, element.control)
            if element.HasField("lane"):
                lane = self._raw_lane(name, element.lane)
                yield from () if lane is None else (lane,)

    def _add_control(self, name: str, control: Message) -> None:
        if control.HasField("stop_sign"):
            self._stop_signs.add(name)
        if control.HasField("light"):
            self._lights[name] = tuple(face.id for face in control.light.faces)
        for field, _ in control.ListFields():
            if field.number in COLOURS:
                self._faces[name] = COLOURS[field.number]

    def _raw_lane(self, name: str, lane: Message) -> _RawLane | None:
        """A lane; None for stubs without bounds and for bicycle lanes."""
        is_whole = all(map(lane.HasField, ("frame", "left", "right")))
        if not is_whole or lane.access.type == ONLY_BIKE:
            return None
        frame = _frame(lane.frame)
        left, right = (self._bound(name, b, frame) for b in (lane.left, lane.right))
        if min(len(left), len(right)) < 2:
            return None
        return _RawLane(
            id=name,
            left=left,
            right=right,
            parent=lane.parent.id,
            backward=lane.direction == BACKWARD,
            ahead=tuple(other.id for other in lane.ahead),
            beside=(lane.beside_left.id or None, lane.beside_right.id or None),
            controls=tuple(control.id for control in lane.controls),
        )

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


def _frame(geo: Message) -> np.ndarray:
    """GeoFrame -> [4, 4] transform of local metres to Earth-centred ones.

    Origin in 1e-7 degrees on the WGS84 ellipsoid; bearing in degrees clockwise from
    north to the local y axis.
    """
    degrees = [1e-7 * geo.origin.latitude, 1e-7 * geo.origin.longitude]
    if abs(degrees[0]) > 90.0 or abs(degrees[1]) > 180.0:
        raise DecodeError(f"frame at latitude, longitude {degrees}: not on Earth")
    latitude, longitude = np.deg2rad(degrees)
    turn = np.deg2rad(geo.bearing)
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
