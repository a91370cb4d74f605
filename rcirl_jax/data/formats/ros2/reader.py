"""ROS 2 bags: the ego from its localization, obstacles from perception, lights.

Read: *.mcap and *.db3 of ROS 2 Iron and later; a folder with metadata.yaml is one bag.
Messages are decoded by the definitions in the file, so no ROS installation is needed.
Topics stand in the source TOML by role; the file says of which type they are.

Traps: a pose is that of base_link, which Autoware puts at the rear axle's centre; the
twist of nav_msgs/Odometry is in child_frame_id, so only its length is used; messages
come at irregular times, so everything is put on one clock by the headers' stamps;
quaternions may be unset, headings have no sign, boxes may be polygons; perception may
speak in the ego's own frame; a drive may be the planner's own, not a human's.
"""

import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.files import log_name
from rcirl_jax.data.formats.messages import (
    MAX_GAP_S,
    PIECE_S,
    Drive,
    Rows,
    Windows,
    check_held,
    clock_rate,
    drive_windows,
    is_anybody,
    longest_window,
    no_tracks,
    topics_of,
)
from rcirl_jax.data.formats.options import positive, recording_car, section
from rcirl_jax.data.formats.perception import Boxes, fitted_lanes, placed
from rcirl_jax.data.formats.ros2.bag import (
    Topic,
    bags_of,
    decoder_of,
    files_in,
    open_file,
)
from rcirl_jax.data.formats.ros2.map import (
    given_lanes,
    lanes_near,
    light_places,
    signals_of,
    with_stop_lines,
)
from rcirl_jax.data.formats.ros2.messages import COLUMNS, LEFT_OUT, TYPES, Context
from rcirl_jax.data.formats.shapes import check_coordinates, origin_notes
from rcirl_jax.data.formats.tracks import travel_heading
from rcirl_jax.data.readers.reading import reading
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Recording, Track

LIMIT_MPS = 13.41  # m/s, 30 mph, where nothing better is known
# m; Autoware's sample_vehicle (vehicle_info.param.yaml): overhangs 1.0 and 1.1, wheel
# base 2.79, tread 1.64 and 0.128 on either side
EGO = {"length": 4.89, "width": 1.896, "rear_axle_to_centre": 1.345}
MAX_MESSAGE_BYTES = 16 * 2**20  # bytes; decoded, a message takes many times its bytes
NEEDED = ("ego", "obstacles")
WIDTHS = {role: len(columns) for role, columns in COLUMNS.items()}

parts = bags_of
files_of = files_in


def own_name(bag: Path) -> str:
    """Returns the name of a bag: its folder's, or the file's without its ending."""
    return bag.resolve().name if bag.is_dir() else bag.stem


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """Yields one Recording per bag, or per window of a long one."""
    for bag in bags_of(path, spec):
        reader, found = _Bag(bag, spec), False
        for recording in reader.recordings():
            found = True
            yield validate_recording(recording, reader.path)
        if not found:
            raise no_tracks(reader.path, spec)


# ----------------------------------------------------------- messages to rows


def read_bag(files: list[Path], spec: dict, names: dict[str, int]) -> Iterator[Rows]:
    """Reads all wanted messages of a bag, piece by piece in the order of recording.

    Args:
      files: of the bag.
      spec: source TOML.
      names: numbers of obstacles by their names, added to.
    """
    roles, notes = _roles(files, spec)
    sizes = [file.stat().st_size for file in files]
    before, done = 0.0, 0.0  # bytes
    with reading(files[0], files) as show:
        for file, size in zip(files, sizes, strict=True):
            for rows in _read_file(file, roles, spec, names):
                read = before + rows.progress * size
                show(int(read - done))
                done, rows.progress = read, min(read / max(sum(sizes), 1), 1.0)
                rows.notes, notes = notes, []
                yield rows
            before += size


def _roles(files: list[Path], spec: dict) -> tuple[dict[str, str], list[str]]:
    """Topic -> role: of each role the first topic named that has messages.

    One that nobody can read is noted and passed over, unless it has to be there.

    Raises:
      InputError: a needed role has none, or its type is unknown.
    """
    known: dict[str, Topic] = {}
    for file in files:
        with open_file(file) as opened:
            for name, topic in opened.topics.items():
                if topic.messages != 0:
                    known.setdefault(name, topic)
    roles, notes = {}, []
    for role, names in topics_of(spec, dict.fromkeys(COLUMNS, ())).items():
        types, met = TYPES[role], [name for name in names if name in known]
        read = [n for n in met if known[n].type in types and known[n].is_described]
        if read:
            roles[read[0]] = role
        elif met and role in NEEDED:
            _check_type(files[0], role, met[0], known[met[0]])
            roles[met[0]] = role  # says that it has no definition
        elif role in NEEDED and names:
            fit = [name for name, topic in known.items() if topic.type in types]
            have = ", ".join(fit) or "none of a type that is read"
            raise InputError(
                f"{files[0]}: {role}: no messages on {', '.join(names)}: expected one "
                f"of them; topics.{role} of the source TOML names it (in this bag: "
                f"{have}), or [] for none"
            )
        elif met:
            lost = "; who drove is not known" if role == "driver" else ""
            notes.append(
                f"{met[0]} ({known[met[0]].type}): not read, of another type or "
                f"without a definition{lost}"
            )
    return roles, notes


def _check_type(path: Path, role: str, name: str, topic: Topic) -> None:
    if topic.type not in TYPES[role]:
        raise InputError(
            f"{path}: {name}: type {topic.type!a:.80}: expected for topics.{role} one "
            f"of {', '.join(TYPES[role])}"
        )


def _read_file(
    path: Path, roles: dict[str, str], spec: dict, names: dict[str, int]
) -> Iterator[Rows]:
    """Rows of a file; their progress is the share of its time that is over."""
    values = {role: array.array("d") for role in COLUMNS}
    decoders, numbers, began = {}, dict.fromkeys(roles, 0), None
    frames = section(spec, "frames")
    context = Context(
        map_frame=str(frames.get("map", "map")),
        base_frame=str(frames.get("base", "base_link")),
        kinds=section(spec, "kinds"),
        names=names,
    )

    def rows(progress: float = 1.0) -> Rows:
        tables = {
            role: np.array(found).reshape(-1, WIDTHS[role])
            for role, found in values.items()
        }
        values.update({role: array.array("d") for role in COLUMNS})
        return Rows(tables=tables, progress=progress)

    with open_file(path) as opened:
        own, span = opened.topics, opened.span
        for name, logged, data in opened.messages([n for n in roles if n in own]):
            began = logged if began is None else began
            if abs(logged - began) > PIECE_S * 1e9:
                first, last = span or (logged, logged + 1)
                share = (logged - first) / max(last - first, 1)
                yield rows(min(max(share, 0.0), 1.0))
                began = logged
            role, kind = roles[name], own[name].type
            if name not in decoders:
                _check_type(path, role, name, own[name])
                decoders[name] = decoder_of(path, name, own[name])
            context.where = f"{path}: {name}: message {numbers[name]}"
            numbers[name] += 1
            try:
                if len(data) > MAX_MESSAGE_BYTES:
                    size = len(data)
                    raise ValueError(f"{size} bytes of at most {MAX_MESSAGE_BYTES}")
                for row in TYPES[role][kind](decoders[name](data), context):
                    values[role].extend(row)
            except InputError:
                raise
            except AttributeError as error:
                raise InputError(
                    f"{context.where}: {error.name}: missing in the file's definition: "
                    f"expected a {kind} with it"
                ) from error
            except Exception as error:  # bytes that are cut short: struct's and others
                found = f"{type(error).__name__}: {str(error)[:200]}"
                raise InputError(
                    f"{context.where}: {found}: expected a {kind}"
                ) from error
            check_held(f"{path}: {name}", len(values[role]) // WIDTHS[role])
    yield rows()


# ------------------------------------------------------------- rows to tracks


class _Bag:
    """Makes recordings of one bag."""

    def __init__(self, bag: Path, spec: dict) -> None:
        self.files, self.spec = files_in(bag), spec
        self.path = self.files[0]  # named in errors
        self.name = log_name(bag, spec, own_name(bag))
        self.given = given_lanes(self.path, spec)
        self.lights = light_places(spec)
        self.users: dict[str, int] = {}  # names of obstacles, with their numbers
        self.has_ego = False

    def recordings(self) -> Iterator[Recording]:
        """Yields the recordings of the bag's windows."""
        drive = Drive(self.path, WIDTHS, NEEDED)
        windows = Windows(self.name, self.name)
        window = longest_window(self.spec)
        return drive_windows(drive, self._rows(), windows, window, self._recording)

    def _rows(self) -> Iterator[Rows]:
        for rows in read_bag(self.files, self.spec, self.users):
            self.has_ego |= len(rows.tables["ego"]) > 0
            yield rows
        if not self.has_ego and section(self.spec, "topics").get("ego"):
            frames = section(self.spec, "frames")
            raise InputError(
                f"{self.path}: ego: no message says where {frames.get('base')} is in "
                f"{frames.get('map')}: expected such a transform; [frames] of the "
                "source TOML names the frames, topics.ego other topics"
            )

    def _recording(self, drive: Drive, within: tuple[float, float]) -> Recording | None:
        """The tracks of the rows held, with notes on the time within; None: nothing."""
        spec, tables = self.spec, drive.tables
        others, notes = self._others(drive)
        tracks = [*self._ego(drive), *others]
        if not is_anybody(tracks, within):
            return None
        x, y, origin, tracks = placed(tracks)
        if self.given is None:
            lanes, note = fitted_lanes(tracks, spec)
            lane_notes = [f"no map given; {note}"]
        else:
            lanes, lane_notes = lanes_near(self.given[0], x, y, origin), self.given[1]
        near = {name: points - origin for name, points in self.lights.items()}
        lanes, light_notes = with_stop_lines(lanes, near)
        clock = np.unique(np.concatenate([track.t for track in tracks]))
        seen, states = drive.clock("lights"), tables["lights"][:, 1:]
        missing = [] if len(tables["ego"]) else ["no places of the ego; no ego track"]
        if not len(tables["obstacles"]):
            missing.append("no obstacles recorded; the ego is alone")
        return Recording(
            name=self.name,
            source=str(spec.get("source", "ROS 2 bag")),
            licence=str(spec.get("licence", "of the bag's owner")),
            rate_hz=clock_rate(spec),
            tracks=tuple(tracks),
            lanes=lanes,
            signals=signals_of(seen, states, list(self.lights), clock),
            default_speed_limit=positive(spec, "speed_limit", LIMIT_MPS),
            notes=(
                *drive.notes,
                *missing,
                *drive.driver_notes(within, "driven by hand"),
                *notes,
                *origin_notes(origin),
                *lane_notes,
                *light_notes,
            ),
        )

    def _ego(self, drive: Drive) -> list[Track]:
        """The ego's track; without a topic of modes the TOML says who drove."""
        check_coordinates(self.path, "ego", ("x", "y"), drive.tables["ego"][:, 1:3])
        automated = drive.driver_spans()
        if not len(drive.tables["driver"]):
            automated = recording_car({"recording_car": "human", **self.spec})
        velocity = drive.clock("velocity"), drive.tables["velocity"][:, 1]
        poses = drive.tables["ego"][:, 1:]
        return drive.ego_tracks(self.spec, EGO, poses, velocity, automated)

    def _others(self, drive: Drive) -> tuple[list[Track], list[str]]:
        """Tracks of the obstacles, and notes on what was left out."""
        table = drive.tables["obstacles"].copy()
        table[:, 0] = drive.clock("obstacles")
        table = table[
            table[:, 1] != self.users.get(str(self.spec.get("ego_id", "")), -1)
        ]
        flat = table[:, 8] == LEFT_OUT
        table, notes = _on_the_map(drive, table[~flat])
        if flat.any():
            count = np.count_nonzero(flat)
            notes.append(f"{count} states of what is driven over or under left out")
        check_coordinates(self.path, "obstacles", ("x", "y"), table[:, 2:4])
        number_of, ids = np.unique(table[:, 1].astype(np.int64), return_inverse=True)
        names = list(self.users)
        t, _, x, y, heading, speed, length, width, kind, _ = table.T
        heading = heading.copy()
        for user in np.unique(ids[np.isnan(heading)]):  # by the direction of travel
            mine = np.flatnonzero(ids == user)
            mine = mine[np.argsort(t[mine], kind="stable")]
            travel = travel_heading(t[mine], x[mine], y[mine])
            heading[mine] = np.where(np.isnan(heading[mine]), travel, heading[mine])
        labels, kinds = [names[k] for k in number_of.tolist()], kind.astype(np.int64)
        boxes = Boxes(ids, labels, t, x, y, heading, speed, length, width, kinds)
        tracks, left_out = drive.tracks(boxes, self.spec)
        return tracks, [*notes, *left_out]


def _on_the_map(drive: Drive, table: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Obstacles with those in the ego's frame put onto the map, and a note.

    Those seen while no pose of the ego is near in time are left out.
    """
    mine = np.flatnonzero(table[:, 9])
    if not mine.size:
        return table, []
    if not len(drive.tables["ego"]):
        raise InputError(
            f"{drive.path}: obstacles: in the ego's frame: expected its places as well "
            "(topics.ego of the source TOML)"
        )
    clock, first = np.unique(drive.clock("ego"), return_index=True)
    x, y, heading = drive.tables["ego"][first, 1:4].T
    t, (ahead, left, turned) = table[mine, 0], table[mine, 2:5].T
    turn = np.interp(t, clock, np.unwrap(heading))
    after = np.clip(np.searchsorted(clock, t), 0, clock.size - 1)
    before = np.maximum(after - 1, 0)
    near = np.minimum(np.abs(clock[after] - t), np.abs(t - clock[before]))
    cos, sin = np.cos(turn), np.sin(turn)
    table[mine, 2] = np.interp(t, clock, x) + cos * ahead - sin * left
    table[mine, 3] = np.interp(t, clock, y) + sin * ahead + cos * left
    table[mine, 4] = turned + turn
    lost = mine[near > MAX_GAP_S]
    words = f"{lost.size} obstacle states left out, while the ego's place was unknown"
    return np.delete(table, lost, axis=0), [words] if lost.size else []
