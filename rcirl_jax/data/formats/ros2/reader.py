"""ROS 2 bags: the ego from its localization, obstacles from perception, lights.

Read: *.mcap (https://mcap.dev/spec) by the libraries `mcap` and `mcap-ros2-support`,
and *.db3 of ROS 2 Iron and later; a folder with metadata.yaml is one bag. Messages are
decoded by the definitions in the file, so no ROS installation is needed. Topics stand
in the source TOML; the file says of which type they are.

Traps: a pose is that of base_link, which Autoware puts at the rear axle's centre; the
twist of nav_msgs/Odometry is in child_frame_id, so only its length is used; messages
come at irregular times, so everything is put on one clock by the headers' stamps;
quaternions may be unset, headings have no sign, boxes may be polygons; perception may
speak in the ego's own frame; a drive may be the planner's own, not a human's.
"""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.clock import on_clock
from rcirl_jax.data.formats.files import log_name
from rcirl_jax.data.formats.messages import (
    MAX_GAP_S,
    automatic_notes,
    automatic_spans,
    clock_rate,
    drive_windows,
    is_anybody,
    no_tracks,
    speed_at,
)
from rcirl_jax.data.formats.options import positive, recording_car, section
from rcirl_jax.data.formats.perception import (
    Boxes,
    Windows,
    ego_boxes,
    longest_window,
    placed,
    tracks_of,
)
from rcirl_jax.data.formats.ros2.bags import bags_of, files_in, name_of
from rcirl_jax.data.formats.ros2.held import Held
from rcirl_jax.data.formats.ros2.lanes import (
    LIMIT_MPS,
    Given,
    given_lanes,
    lanes_for,
)
from rcirl_jax.data.formats.ros2.lights import (
    light_places,
    signals_of,
    with_stop_lines,
)
from rcirl_jax.data.formats.ros2.messages import Rows, read_bag
from rcirl_jax.data.formats.ros2.objects import LEFT_OUT
from rcirl_jax.data.formats.ros2.poses import from_the_ego
from rcirl_jax.data.formats.shapes import check_coordinates, origin_notes
from rcirl_jax.data.formats.tracks import travel_heading
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Recording, Track

# m; Autoware's sample_vehicle (vehicle_info.param.yaml): overhangs 1.0 and 1.1, wheel
# base 2.79, tread 1.64 and 0.128 on either side
EGO = {"length": 4.89, "width": 1.896, "rear_axle_to_centre": 1.345}


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Bag:
    """What the recordings of one bag share."""

    path: Path  # of its first file, named in errors
    name: str
    spec: dict
    lanes: Given | None
    lights: dict[str, np.ndarray]  # group -> places [n, 2] m on its stop lines


def parts(path: Path, spec: dict) -> list[Path]:
    """The bags: folders with metadata.yaml, files outside of such folders."""
    return bags_of(path, spec)


def files_of(bag: Path) -> list[Path]:
    """The files of a bag."""
    return files_in(bag)


def own_name(bag: Path) -> str:
    """Name of a bag, as long as no other folder has one called alike."""
    return name_of(bag)


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """One Recording per bag, or per window of a long one."""
    for bag in bags_of(path, spec):
        first = files_in(bag)[0]
        given = given_lanes(first, spec)
        name = log_name(bag, spec, name_of(bag))
        shared = _Bag(
            path=first, name=name, spec=spec, lanes=given, lights=light_places(spec)
        )
        held, found = Held(first), False
        for recording in _windows(held, files_in(bag), shared):
            found = True
            yield validate_recording(recording, first)
        if not found:
            raise no_tracks(first, spec)


def _windows(held: Held, files: list[Path], bag: _Bag) -> Iterator[Recording]:
    """Recordings of a bag."""

    def rows() -> Iterator[Rows]:
        yield from read_bag(files, bag.spec)
        _check_ego(held, bag)

    return drive_windows(
        held,
        rows(),
        Windows(bag.name, bag.name, MAX_GAP_S),
        longest_window(bag.spec),
        lambda view, within: _recording(view, within, bag),
    )


def _check_ego(held: Held, bag: _Bag) -> None:
    """Messages of the ego say where it is, or there is no topic of it."""
    if held.has_ego or not section(bag.spec, "topics").get("ego"):
        return
    frames = section(bag.spec, "frames")
    raise InputError(
        f"{bag.path}: ego: no message says where {frames.get('base')} is in "
        f"{frames.get('map')}: expected such a transform; [frames] of the source TOML "
        "names the frames, topics.ego other topics"
    )


def _recording(held: Held, within: tuple[float, float], bag: _Bag) -> Recording | None:
    """The tracks of the rows held, with notes on the time within; None: nothing."""
    spec, rate = bag.spec, clock_rate(bag.spec)
    obstacles, notes = _obstacles(held, spec, rate)
    tracks = [*_ego(held, spec, rate), *obstacles]
    if not is_anybody(tracks, within):
        return None
    x, y, origin, tracks = placed(tracks)
    lanes, lane_notes = lanes_for(bag.lanes, tracks, (x, y, origin), spec)
    near = {name: points - origin for name, points in bag.lights.items()}
    lanes, light_notes = with_stop_lines(lanes, near)
    return Recording(
        name=bag.name,
        source=str(spec.get("source", "ROS 2 bag")),
        licence=str(spec.get("licence", "of the bag's owner")),
        rate_hz=rate,
        tracks=tuple(tracks),
        lanes=lanes,
        signals=signals_of(held.tables["lights"], list(bag.lights), _clock(tracks)),
        default_speed_limit=positive(spec, "speed_limit", LIMIT_MPS),
        notes=(
            *held.notes,
            *_what_is_missing(held, within),
            *notes,
            *origin_notes(origin),
            *lane_notes,
            *light_notes,
        ),
    )


def _clock(tracks: list[Track]) -> np.ndarray:
    """Times [s] of a recording, of any road user."""
    return np.unique(np.concatenate([track.t for track in tracks]))


def _what_is_missing(held: Held, within: tuple[float, float]) -> list[str]:
    """Notes on roles without messages, and on driving that is no human's."""
    tables = held.tables
    notes = [] if len(tables["ego"]) else ["no places of the ego; no ego track"]
    if not len(tables["obstacles"]):
        notes.append("no obstacles recorded; the ego is alone")
    clock, by_hand = tables["driver"].T
    return notes + automatic_notes(clock, by_hand, within, "driven by hand")


def _ego(held: Held, spec: dict, rate: float) -> list[Track]:
    """The recording car's box, moved from its base_link to its centre."""
    t, x, y, heading, speed = held.tables["ego"].T
    check_coordinates(held.path, "ego", ("x", "y"), held.tables["ego"][:, 1:3])
    if np.isnan(speed).any():
        clock, velocity = held.tables["velocity"].T
        measured = speed_at(t, clock, velocity)
        speed = np.where(np.isnan(speed), measured, speed)
    boxes = ego_boxes(spec, EGO, t, x, y, heading, speed)
    boxes = on_clock(boxes, rate, MAX_GAP_S)
    automated = _automated(held, spec)
    return tracks_of(held.path, boxes, MAX_GAP_S, automated=automated)[0]


def _automated(held: Held, spec: dict) -> tuple[tuple[float, float], ...]:
    """When the control mode was not manual, or silent.

    The first mode was in force before; without that topic `recording_car` of the TOML
    says who drove.
    """
    if not len(held.tables["driver"]):
        return recording_car({"recording_car": "human", **spec})
    clock, by_hand = held.tables["driver"].T
    return automatic_spans(clock, by_hand)


def _obstacles(held: Held, spec: dict, rate: float) -> tuple[list[Track], list[str]]:
    """Tracks of the obstacles, and notes on what was left out."""
    table = held.tables["obstacles"]
    own = list(held.names).index(car) if (car := _ego_id(spec)) in held.names else -1
    table = table[table[:, 1] != own]
    flat = table[:, 8] == LEFT_OUT
    table, notes = _on_the_map(held, table[~flat])
    if flat.any():
        count = np.count_nonzero(flat)
        notes.append(f"{count} states of what is driven over or under left out")
    check_coordinates(held.path, "obstacles", ("x", "y"), table[:, 2:4])
    number_of, ids = np.unique(table[:, 1].astype(np.int64), return_inverse=True)
    names = list(held.names)
    t, _, x, y, heading, speed, length, width, kind, _ = table.T
    boxes = Boxes(
        ids=ids,
        names=[names[k] for k in number_of.tolist()],
        t=t,
        x=x,
        y=y,
        heading=_headings(ids, t, x, y, heading),
        speed=speed,
        length=length,
        width=width,
        kind=kind.astype(np.int64),
    )
    boxes = on_clock(boxes, rate, MAX_GAP_S)
    unknown = str(spec.get("unknown", "auto"))
    tracks, left_out = tracks_of(held.path, boxes, MAX_GAP_S, unknown)
    return tracks, [*notes, *left_out]


def _ego_id(spec: dict) -> str:
    return str(spec.get("ego_id", ""))


def _on_the_map(held: Held, table: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Obstacles with those in the ego's frame put onto the map, and a note."""
    mine = np.flatnonzero(table[:, 9])
    if not mine.size:
        return table, []
    ego = held.tables["ego"]
    if not len(ego):
        raise InputError(
            f"{held.path}: obstacles: in the ego's frame: expected its places as well "
            "(topics.ego of the source TOML)"
        )
    ego = ego[np.unique(ego[:, 0], return_index=True)[1]]
    x, y, heading, known = from_the_ego(
        tuple(ego[:, :4].T), table[mine, 0], tuple(table[mine, 2:5].T), MAX_GAP_S
    )
    table = table.copy()
    table[mine, 2:5] = np.stack([x, y, heading], axis=1)
    lost = int(np.count_nonzero(~known))
    note = f"{lost} obstacle states left out, while the ego's place was unknown"
    return np.delete(table, mine[~known], axis=0), [note] if lost else []


def _headings(
    ids: np.ndarray, t: np.ndarray, x: np.ndarray, y: np.ndarray, heading: np.ndarray
) -> np.ndarray:
    """Headings [n] rad; those that were not measured are directions of travel."""
    filled = heading.copy()
    for user in np.unique(ids[np.isnan(heading)]):
        mine = np.flatnonzero(ids == user)
        mine = mine[np.argsort(t[mine], kind="stable")]
        travel = travel_heading(t[mine], x[mine], y[mine])
        filled[mine] = np.where(np.isnan(heading[mine]), travel, heading[mine])
    return filled
