"""Lyft / Woven Planet Level 5 prediction data: `sample.zarr`, `train.zarr`, ...

Layout: "Dataset Formats" of the L5Kit documentation; zarr version 2, format
version 2 (traffic lights may be missing, as in version 1). Four arrays: scenes
point at intervals of frames, frames at intervals of agents and light faces. One
scene of some 25 s is one Recording, read by its intervals only.

Traps: times are ns since 1970; `extent` is length, width, height; ids are unique
inside a scene only; most agents have the class "unknown" (clutter, left out by
default); scenes that follow each other show the same vehicles, so that they
share a group, also over datasets. Colours of lights are in the semantic map alone.

Points of the semantic map are centimetres in a local frame of each lane (east, north,
up at a latitude and longitude); meta.json holds the transform of the dataset's world
to Earth-centred coordinates.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError

from rcirl_jax.data.formats.messages import MAX_GAP_S
from rcirl_jax.data.formats.options import (
    number,
    one_pattern,
    path_option,
    positive,
    recording_car,
)
from rcirl_jax.data.formats.perception import (
    STATES,
    UNKNOWN,
    Boxes,
    ego_boxes,
    fitted_lanes,
    held_states,
    placed,
    signal_of,
    tracks_of,
)
from rcirl_jax.data.formats.projection import earth_centred
from rcirl_jax.data.formats.shapes import (
    Roads,
    check_coordinates,
    facing,
    lane_between,
    limit_of,
    moves,
    origin_notes,
)
from rcirl_jax.data.readers.protobuf import Message, parsers
from rcirl_jax.data.readers.zarr2 import StructuredArray
from rcirl_jax.data.recording import PIECE, accepted
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import read_json
from rcirl_jax.runtime.checked import checked
from rcirl_jax.types import Kind, Lane, Recording, Signal, Track

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
FACE_FIELDS = ", ".join(f"face_{number} {number} Nothing" for number in COLOURS)
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
Control: stop_sign 7 Nothing, light 29 Light, {FACE_FIELDS}
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


NUM_LABELS = 17
# class of each label, in the order of L5Kit's PERCEPTION_LABELS
KIND_OF_LABEL = np.array(
    [UNKNOWN] * 3  # not set, unknown, don't care
    + [Kind.VEHICLE] * 7  # car, van, tram, bus, truck, emergency, other vehicle
    + [Kind.CYCLIST, Kind.VEHICLE] * 2  # bicycle, motorcycle and their riders
    + [Kind.PEDESTRIAN] * 2  # pedestrian, animal
    + [UNKNOWN]  # don't care
)
SCENES = {"frame_index_interval": ("iu", (2,)), "host": ("U", ())}
SCENES |= dict.fromkeys(("start_time", "end_time"), ("iu", ()))
FRAMES = {
    "timestamp": ("iu", ()),
    "agent_index_interval": ("iu", (2,)),
    "ego_translation": ("f", (3,)),
    "ego_rotation": ("f", (3, 3)),
}
AGENTS = {
    "centroid": ("f", (2,)),
    "extent": ("f", (3,)),
    "yaw": ("f", ()),
    "velocity": ("f", (2,)),
    "track_id": ("iu", ()),
    "label_probabilities": ("f", (NUM_LABELS,)),
}
FACES = {
    "face_id": ("U", ()),
    "traffic_light_id": ("U", ()),
    "traffic_light_face_status": ("f", (3,)),  # active, inactive, unknown
}
FACE_INTERVAL = "traffic_light_faces_index_interval"  # of frames
SAME_DRIVE_S = 60.0  # s, a host's scenes closer than this may show the same cars
MAX_SCENES = 1_000_000
PIECE_SCENES = 8  # scenes of a piece; their demonstrations are held at once
MAX_FRAMES = 36_000  # frames of one scene: an hour
MAX_AGENTS = 5_000_000  # agent records of one scene


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """Yields one Recording per scene, of all datasets or of the spec's piece of one."""
    for folder in parts(path, spec):
        dataset, above = _Dataset(folder, spec), folder.absolute()
        home = above.parents[1 if above.parent.name == "scenes" else 0]
        others = [other for other in _datasets(home, spec) if other != above]
        groups = groups_of(dataset.scenes, [*tables_of(others).values()])
        first, last = spec.get(PIECE, (0, len(groups)))
        for index in range(first, last):
            name = f"{folder.stem}-{index:06d}"
            make = functools.partial(dataset.recording, name, dataset.scenes[index])
            made = accepted(make, name, f"{folder}: scene {index}", spec)
            yield dataclasses.replace(
                made, group=groups[index], progress=(index + 1) / len(groups)
            )


def pieces(path: Path, spec: dict) -> list[dict]:
    """Specs of a few scenes each: a dataset is the work of many processes."""
    number = len(scenes_of(path))
    return [
        {**spec, PIECE: (first, min(first + PIECE_SCENES, number))}
        for first in range(0, number, PIECE_SCENES)
    ]


def parts(path: Path, spec: dict) -> list[Path]:
    """Returns the dataset itself, or those in a folder or its scenes/."""
    if (path / "scenes" / ".zarray").is_file():
        return [path]
    found = _datasets(path, spec)
    if not found:
        raise InputError(
            f"{path}: no scenes/.zarray and no folder {one_pattern(spec)}: "
            "expected L5 data"
        )
    met: dict[tuple[str, ...], Path] = {}
    for folder, table in tables_of(found).items():
        for index, scene in enumerate(table):
            key = tuple(str(scene[name]) for name in ("host", "start_time", "end_time"))
            if met.setdefault(key, folder) != folder:
                raise InputError(
                    f"{folder}: scene {index}: host {key[0]}, start {key[1]}: met "
                    f"twice, also in {met[key].name}: expected once; name one dataset"
                )
    return found


def _datasets(path: Path, spec: dict) -> list[Path]:
    """Datasets in a folder or its scenes/."""
    pattern = one_pattern(spec)
    return sorted({*path.glob(pattern), *path.glob(f"scenes/{pattern}")})


def tables_of(folders: Sequence[Path]) -> dict[Path, np.ndarray]:
    """Reads the scenes of each dataset; one of no use is refused when it is opened."""
    tables = {}
    for folder in folders:
        with contextlib.suppress(InputError):
            tables[folder] = scenes_of(folder)
    return tables


def scenes_of(folder: Path) -> np.ndarray:
    """Reads all scenes of a dataset."""
    scenes = StructuredArray(folder / "scenes", SCENES)
    if not 0 < scenes.size <= MAX_SCENES:
        raise InputError(
            f"{scenes.path}: shape: {scenes.size} scenes: expected 1 to {MAX_SCENES}"
        )
    return scenes.read(0, scenes.size)


def groups_of(scenes: np.ndarray, others: Sequence[np.ndarray]) -> list[str]:
    """Groups scenes by vehicles: a host's drive without a long pause is one group.

    Named by the host and the drive's start, so that it is the same in every dataset.

    Args:
      scenes: of one dataset.
      others: of those beside it, which may hold earlier scenes of its drives.
    """
    tables = [scenes, *others]
    hosts = np.concatenate([table["host"] for table in tables])
    start, end = (
        np.concatenate([table[name].astype(np.int64) for table in tables])
        for name in ("start_time", "end_time")
    )
    _, host = np.unique(hosts, return_inverse=True)
    order = np.lexsort((start, host))
    pause = start[order][1:] - end[order][:-1]  # ns
    new = np.ones(order.size, bool)
    new[1:] = (np.diff(host[order]) != 0) | (pause > SAME_DRIVE_S * 1e9)
    first = np.empty(order.size, np.int64)
    first[order] = order[np.flatnonzero(new)][np.cumsum(new) - 1]
    return [
        f"{hosts[drive]}-from-{start[drive] // 10**9}"
        for drive in first[: len(scenes)].tolist()
    ]


def _map_of(folder: Path, spec: dict) -> SemanticMap | None:
    file = find_map(folder, spec)
    if file is None:
        return None
    about, to_ecef = file.stat(), world_to_ecef(file, spec)
    return _map(file, (about.st_mtime_ns, about.st_size), tuple(to_ecef.flat))


@functools.lru_cache(maxsize=1)
def _map(file: Path, as_of: tuple[int, int], to_ecef: tuple) -> SemanticMap:
    """The map of a file as it was; all pieces of a dataset share it."""
    del as_of  # tells files of one name apart
    return SemanticMap(file, np.array(to_ecef).reshape(4, 4))


def _interval(where: str, bounds: np.ndarray, size: int, most: int) -> tuple[int, int]:
    start, stop = int(bounds[0]), int(bounds[1])
    if not 0 <= start <= stop <= size or stop - start > most:
        raise InputError(
            f"{where}: [{start}, {stop}]: expected an interval within 0 to {size}, "
            f"at most {most} long"
        )
    return start, stop


class _Dataset:
    """The arrays of a dataset, and its map; scenes become recordings one by one."""

    def __init__(self, folder: Path, spec: dict) -> None:
        self.folder, self.spec, self.scenes = folder, spec, scenes_of(folder)
        self.frames = StructuredArray(folder / "frames", FRAMES)
        self.agents = StructuredArray(folder / "agents", AGENTS)
        lights = folder / "traffic_light_faces"  # missing in format version 1
        has_lights = lights.is_dir() and FACE_INTERVAL in (
            self.frames.dtype.names or ()
        )
        self.faces = StructuredArray(lights, FACES) if has_lights else None
        self.map = _map_of(folder, spec)

    def recording(self, name: str, scene: np.void) -> Recording:
        """Returns one scene."""
        spec, where = self.spec, f"{self.folder}: {name}"
        field, bounds = "frame_index_interval", scene["frame_index_interval"]
        size = self.frames.size
        start, stop = _interval(f"{where}: {field}", bounds, size, MAX_FRAMES)
        if start == stop:
            raise InputError(f"{where}: {field}: [{start}, {stop}]: expected frames")
        frames = self.frames.read(start, stop)
        t = (frames["timestamp"] - frames["timestamp"][0]).astype(np.float64) * 1e-9
        rate = positive(spec, "rate_hz")
        step = float(np.median(np.diff(t))) if t.size > 1 else 1.0 / rate
        if not 0.5 < step * rate < 2.0:
            raise InputError(
                f"{where}: timestamp: median step {step:g} s: expected {1.0 / rate:g} "
                "s, in ns"
            )
        others, notes = self._others(Path(where), frames, t)
        x, y, origin, tracks = placed([*self._ego(Path(where), frames, t), *others])
        lanes, signals, map_notes = (), (), []
        if self.map is not None:
            lanes = self.map.roads.around(x, y, origin)
            signals, map_notes = self._signals(where, frames, t, lanes)
        if not lanes:
            lanes, note = fitted_lanes(tracks, spec)
            map_notes = [f"no map here; {note}"]
        return Recording(
            name=name,
            source=spec["source"],
            licence=spec["licence"],
            rate_hz=rate,
            start_s=float(frames["timestamp"][0]) * 1e-9,
            origin=(float(origin[0]), float(origin[1])),
            tracks=tuple(tracks),
            lanes=lanes,
            signals=signals,
            default_speed_limit=positive(spec, "speed_limit"),
            notes=(*notes, *origin_notes(origin), *map_notes),
        )

    def _ego(self, path: Path, frames: np.ndarray, t: np.ndarray) -> list[Track]:
        """The recording car; its speed comes from its positions."""
        x, y, _ = frames["ego_translation"].astype(np.float64).T
        check_coordinates(path, "ego_translation", ("x", "y"), np.stack([x, y], axis=1))
        ahead = frames["ego_rotation"][:, :2, 0].astype(np.float64)  # [n, 2] unit
        bad = np.flatnonzero(~(np.abs(np.hypot(*ahead.T) - 1.0) < 0.5))
        if bad.size:
            raise InputError(
                f"{path}: frame {bad[0]}: ego_rotation: {ahead[bad[0]]}: "
                "expected a rotation matrix"
            )
        heading, speed = np.arctan2(ahead[:, 1], ahead[:, 0]), np.full(t.size, np.nan)
        boxes = ego_boxes(self.spec, t, x, y, heading, speed)
        car = recording_car(self.spec)
        return tracks_of(path, boxes, MAX_GAP_S, automated=car)[0]

    def _others(
        self, path: Path, frames: np.ndarray, t: np.ndarray
    ) -> tuple[list[Track], list[str]]:
        field = "agent_index_interval"
        agents, frame = _records(f"{path}: {field}", self.agents, frames[field])
        labels = agents["label_probabilities"]
        if not np.isfinite(labels).all():
            row = int(np.argmin(np.isfinite(labels).all(axis=1)))
            raise InputError(
                f"{path}: agent {row}: label_probabilities: not finite: "
                "expected probabilities"
            )
        least = number(self.spec, "min_probability")
        best = labels.argmax(axis=1) if agents.size else np.zeros(0, np.int64)
        likely = labels.max(axis=1, initial=0.0) >= least
        kinds = np.where(likely, KIND_OF_LABEL[best], UNKNOWN)
        centre = agents["centroid"].astype(np.float64)
        check_coordinates(path, "centroid", ("x", "y"), centre)
        track_ids, ids = np.unique(agents["track_id"], return_inverse=True)
        names = [*map(str, track_ids.tolist())]
        heading, (x, y) = agents["yaw"].astype(np.float64), centre.T
        speed = np.hypot(*agents["velocity"].astype(np.float64).T)
        length, width, _ = agents["extent"].astype(np.float64).T
        boxes = Boxes(ids, names, t[frame], x, y, heading, speed, length, width, kinds)
        return tracks_of(path, boxes, MAX_GAP_S, self.spec["unknown"])

    def _signals(
        self, where: str, frames: np.ndarray, t: np.ndarray, lanes: tuple[Lane, ...]
    ) -> tuple[tuple[Signal, ...], list[str]]:
        """Lights of the lanes, from the faces seen in each frame."""
        if self.map is None or self.faces is None:
            return (), ["no traffic lights recorded"]
        intervals = frames[FACE_INTERVAL]
        faces, frame = _records(f"{where}: {FACE_INTERVAL}", self.faces, intervals)
        status = faces["traffic_light_face_status"]
        lit = status.argmax(axis=1) == 0 if faces.size else np.zeros(0, bool)
        return self.map.signals(lanes, t, frame, faces["face_id"], lit), []


def _records(
    where: str, array: StructuredArray, intervals: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Records of all frames' intervals, and the frame of each.

    The intervals of a scene's frames follow each other in the public data;
    others (subsets of frames) are read in one piece and picked.
    """
    counts = (intervals[:, 1] - intervals[:, 0]).astype(np.int64)
    bad = np.flatnonzero((counts < 0) | (counts > MAX_AGENTS))
    if bad.size:
        frame = f"{where}: frame {bad[0]}"
        _interval(frame, intervals[bad[0]], array.size, MAX_AGENTS)
    hull = np.array([intervals[:, 0].min(), intervals[:, 1].max()])
    first, last = _interval(where, hull, array.size, MAX_AGENTS)
    if counts.sum() > MAX_AGENTS:
        raise InputError(
            f"{where}: {counts.sum()} records: expected at most {MAX_AGENTS}"
        )
    frame = np.repeat(np.arange(counts.size), counts)
    inside = np.arange(frame.size) - np.repeat(np.cumsum(counts) - counts, counts)
    pick = intervals[:, 0].astype(np.int64)[frame] - first + inside
    return array.read(first, last)[pick], frame
