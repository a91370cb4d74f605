"""ROS 2 bags: the ego from its localization, obstacles from perception, lights.

Read: *.mcap and *.db3 of ROS 2 Iron and later; a folder with metadata.yaml is one bag.
Topics stand in the source TOML by role; the file says of which type they are.

Traps: a pose is that of base_link, which Autoware puts at the rear axle's centre; the
twist of nav_msgs/Odometry is in child_frame_id, so only its length is used; messages
come at irregular times, so everything is put on one clock by the headers' stamps;
quaternions may be unset, headings have no sign, boxes may be polygons; perception may
speak in the ego's own frame; a drive may be the planner's own, not a human's.

A bag holds no map. Lanes come from a Lanelet2 map or a table of lines that the source
TOML names, else from the paths that were driven. Lights stop the lanes nearest to them.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.data.formats.files import log_name
from rcirl_jax.data.formats.lanelet2 import read_lanelet2
from rcirl_jax.data.formats.lanes import lane_file_of, lanes_of_toml
from rcirl_jax.data.formats.messages import MAX_GAP_S, Drive, Row, Window, topics_of
from rcirl_jax.data.formats.options import path_option, section
from rcirl_jax.data.formats.perception import held_states, signal_of
from rcirl_jax.data.formats.projection import utm, utm_zone
from rcirl_jax.data.formats.ros2.bag import (
    Topic,
    as_sent,
    bags_of,
    damaged,
    decoder_of,
    files_in,
    open_file,
)
from rcirl_jax.data.formats.ros2.messages import LEFT_OUT, TYPES, WIDTHS, Context
from rcirl_jax.data.formats.shapes import Roads, distance_to_line, line_across
from rcirl_jax.data.readers.reading import reading
from rcirl_jax.errors import InputError
from rcirl_jax.types import Lane, Recording, Signal

SQUARE_M = 1e5  # m, of MGRS, to whose corner Autoware's maps are relative
MARGIN_M = 200.0  # m around the tracks in which lanes are kept
HOLD_S = 1.0  # s, a light unseen keeps its state this long
STAMP_S = 1e-6  # s, to which stamps are exact
NEAR_M = 3.0  # m from a lane's centre line to a place on its stop line


def given_lanes(path: Path, spec: dict) -> tuple[Sequence[Lane], list[str]] | None:
    """Reads the lanes of the option `map` or of [lanes] in the TOML, with notes.

    Args:
      path: file of the bag; a table of lines lies beside it, or beside its folder.
      spec: source TOML.

    Returns:
      Lanes in the frame of the bag's map; None where the TOML has neither.
    """
    place = path_option(spec, "map")
    if place and lane_file_of(spec):
        raise InputError(f"source TOML: map: {place}: and lanes.file: expected one")
    if place:
        if not Path(place).is_file():
            raise InputError(
                f"source TOML: map: {place}: missing: expected a Lanelet2 map"
            )
        return read_lanelet2(Path(place), _on_square)
    if not spec.get("lanes"):
        return None
    return lanes_of_toml(path, spec), []


def _on_square(latitude: np.ndarray, longitude: np.ndarray) -> np.ndarray:
    """[n, 2] m from the corner of the map's 100 km square of MGRS.

    Autoware's frame `map` begins there; maps with tags local_x, local_y say so.
    """
    zone = utm_zone(float(np.median(longitude)))
    places = utm(latitude, longitude, zone, south=bool(np.median(latitude) < 0.0))
    return places - np.floor(np.median(places, axis=0) / SQUARE_M) * SQUARE_M


def lanes_near(
    lanes: Sequence[Lane], x: np.ndarray, y: np.ndarray, origin: np.ndarray
) -> tuple[Lane, ...]:
    """Returns the lanes around positions [n] m of the bag, less the origin [2] m.

    Raises:
      InputError: there are none.
    """
    roads = Roads([lane.centre for lane in lanes], lanes.__getitem__)
    near = roads.around(x, y, origin, MARGIN_M)
    if not near:
        raise InputError(
            f"source TOML: map: no lane within {MARGIN_M:g} m of the tracks around "
            f"x = {np.median(x):.0f} m, y = {np.median(y):.0f} m: expected a map in "
            "the bag's own frame"
        )
    return near


def light_places(spec: Mapping) -> dict[str, np.ndarray]:
    """Reads [lights] of the source TOML: group -> places [n, 2] m on its stop lines."""
    places = {}
    for name, given in section(spec, "lights").items():
        try:
            found = np.array(given, np.float64)
        except (TypeError, ValueError):
            found = np.zeros(0)
        is_number = name.removeprefix("-").isdecimal() and len(name) < 20
        shaped = found.ndim == 2 and found.shape[1:] == (2,) and len(found) > 0
        if not (is_number and shaped and np.isfinite(found).all()):
            raise InputError(
                f"source TOML: lights.{name}: {str(given)[:80]}: expected the number "
                "of a group with places [[x, y], ...] in m, one for each lane"
            )
        places[name] = found
    return places


def signals_of(
    t: np.ndarray, table: np.ndarray, names: Sequence[str], clock: np.ndarray
) -> tuple[Signal, ...]:
    """Makes one Signal for each group that was seen.

    Args:
      t: [n] s, whenever a group was seen.
      table: [n, 2] its number and state (of `perception.STATES`).
      names: of the groups that are wanted.
      clock: [m > 0] s, of the recording.
    """
    found = []
    for name in names:
        mine = np.flatnonzero(table[:, 0] == float(name))
        if mine.size:
            mine = mine[np.argsort(t[mine], kind="stable")]
            hold, states = HOLD_S + 2.0 * STAMP_S, table[mine, 1].astype(np.int64)
            shown = held_states(clock + STAMP_S, t[mine], states, hold)
            found.append(signal_of(name, clock, shown))
    return tuple(found)


def with_stop_lines(
    lanes: Sequence[Lane], places: Mapping[str, np.ndarray]
) -> tuple[tuple[Lane, ...], list[str]]:
    """Stops the lanes nearest to a light's places by it, with notes.

    Args:
      lanes: of one recording.
      places: group -> [n, 2] m in the recording's frame.
    """
    changed, notes = list(lanes), []
    for name, points in places.items():
        for point in points:
            gaps = [float(distance_to_line(point[None], n.centre)[0]) for n in changed]
            nearest = int(np.argmin(gaps)) if gaps else -1
            if nearest < 0 or gaps[nearest] > NEAR_M:
                notes.append(f"light {name}: no lane within {NEAR_M:g} m of its place")
                continue
            lane = changed[nearest]
            line = line_across(lane.centre, lane.left_width, lane.right_width, point)
            ids = tuple(dict.fromkeys((*lane.signal_ids, name)))
            changed[nearest] = dataclasses.replace(lane, stop_line=line, signal_ids=ids)
    return tuple(changed), notes


NEEDED = ("ego", "obstacles")

parts = bags_of
files_of = files_in


def own_name(bag: Path) -> str:
    """Returns the name of a bag: its folder's, or the file's without its ending."""
    return bag.resolve().name if bag.is_dir() else bag.stem


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """Yields one Recording per bag, or per window of a long one."""
    for bag in bags_of(path, spec):
        yield from BagDrive(bag, spec).recordings()


class BagDrive(Drive):
    """Rows of a bag, by the headers' stamps."""

    widths = WIDTHS

    def __init__(self, bag: Path, spec: dict) -> None:
        self.files = files_in(bag)
        super().__init__(self.files[0], spec, log_name(bag, spec, own_name(bag)))
        self.given = given_lanes(self.path, spec)
        self.lights = light_places(spec)
        frames = section(spec, "frames")
        self.context = Context(
            map_frame=frames["map"],
            base_frame=frames["base"],
            kinds=section(spec, "kinds"),
        )

    # ------------------------------------------------------------ messages to rows

    def rows(self) -> Iterator[tuple[str, float, float, Row]]:
        """Yields the rows of all wanted messages in the order of recording."""
        roles, has_ego = self._roles(), False
        sizes = [file.stat().st_size for file in self.files]
        before, done = 0.0, 0.0  # bytes
        with reading(self.path, self.files) as show:
            for file, size in zip(self.files, sizes, strict=True):
                for role, logged, share, row in self._rows_of(file, roles):
                    read = before + share * size
                    show(int(read - done))
                    done, has_ego = read, has_ego or role == "ego"
                    yield role, logged, min(read / max(sum(sizes), 1), 1.0), row
                before += size
        if not has_ego and section(self.spec, "topics").get("ego"):
            base, on = self.context.base_frame, self.context.map_frame
            raise InputError(
                f"{self.path}: ego: no message says where {base} is in {on}: expected "
                "such a transform; [frames] of the source TOML names the frames, "
                "topics.ego other topics"
            )

    def _roles(self) -> dict[str, str]:
        """Topic -> role: of each role the first topic named that has messages.

        One that nobody can read is noted and passed over, unless it has to be there.
        """
        known: dict[str, Topic] = {}
        for file in self.files:
            with open_file(file) as opened:
                for name, topic in opened.topics.items():
                    if not topic.is_silent:
                        known.setdefault(name, topic)
        roles = {}
        for role, names in topics_of(self.spec, TYPES).items():
            types, met = TYPES[role], [name for name in names if name in known]
            read = [n for n in met if known[n].type in types and known[n].is_described]
            if read:
                roles[read[0]] = role
            elif met and role in NEEDED:
                roles[met[0]] = role  # reading it says what is wrong
            elif role in NEEDED and names:
                fit = [name for name, topic in known.items() if topic.type in types]
                have = ", ".join(fit) or "none of a type that is read"
                raise InputError(
                    f"{self.path}: {role}: no messages on {', '.join(names)}: expected "
                    f"one of them; topics.{role} of the source TOML names it (in this "
                    f"bag: {have}), or [] for none"
                )
            elif met:
                lost = "; who drove is not known" if role == "driver" else ""
                self.notes.append(
                    f"{met[0]} ({known[met[0]].type}): not read, of another type or "
                    f"without a definition{lost}"
                )
        return roles

    def _rows_of(
        self, path: Path, roles: dict[str, str]
    ) -> Iterator[tuple[str, float, float, Row]]:
        """Rows of a file; the share is that of its time."""
        decoders, numbers = {}, dict.fromkeys(roles, 0)
        with open_file(path) as opened:
            own, span = opened.topics, opened.span
            for name, logged, data in opened.messages([n for n in roles if n in own]):
                first, last = span or (logged, logged + 1)
                share = min(max((logged - first) / max(last - first, 1), 0.0), 1.0)
                role, kind = roles[name], own[name].type
                if kind not in TYPES[role]:
                    raise InputError(
                        f"{path}: {name}: type {kind!a:.80}: expected for "
                        f"topics.{role} one of {', '.join(TYPES[role])}"
                    )
                if name not in decoders:
                    decoders[name] = decoder_of(path, name, own[name])
                self.context.where = f"{path}: {name}: message {numbers[name]}"
                numbers[name] += 1
                with damaged(self.context.where, f"a {kind}"):
                    message = decoders[name](as_sent(data))
                    try:
                        found = [*TYPES[role][kind](message, self.context)]
                    except AttributeError as error:
                        raise InputError(
                            f"{self.context.where}: {error.name}: missing in the "
                            f"file's definition: expected a {kind} with it"
                        ) from error
                for row in found:
                    yield role, logged * 1e-9, share, row

    # ------------------------------------------------------------- rows to tracks

    def name_of(self, number: int) -> str:
        """Returns the name under which messages hold an obstacle."""
        return [*self.context.names][number]

    def selected(self, table: np.ndarray) -> tuple[np.ndarray, list[str]]:
        """Drops the ego among the obstacles, and what is driven over or under."""
        own = self.context.names.get(self.spec["ego_id"], -1)
        table = table[table[:, 1] != own]
        flat = table[:, 8] == LEFT_OUT
        table, notes = self._on_the_map(table[~flat])
        if flat.any():
            count = np.count_nonzero(flat)
            notes.append(f"{count} states of what is driven over or under left out")
        return table, notes

    def _on_the_map(self, table: np.ndarray) -> tuple[np.ndarray, list[str]]:
        """Obstacles with those in the ego's frame put onto the map, and a note.

        Those seen while no pose of the ego is near in time are left out.
        """
        mine = np.flatnonzero(table[:, 9])
        if not mine.size:
            return table, []
        if not len(self.tables["ego"]):
            raise InputError(
                f"{self.path}: obstacles: in the ego's frame: expected its places as "
                "well (topics.ego of the source TOML)"
            )
        clock, first = np.unique(self.clock("ego"), return_index=True)
        x, y, heading = self.tables["ego"][first, 1:4].T
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
        words = (
            f"{lost.size} obstacle states left out, while the ego's place was unknown"
        )
        return np.delete(table, lost, axis=0), [words] if lost.size else []

    def surroundings(self, window: Window) -> tuple[dict[str, Any], list[str]]:
        """Takes lanes of the given map, else of the paths, and places the lights."""
        if self.given is None:
            fields, notes = super().surroundings(window)
            lanes = fields["lanes"]
        else:
            lanes, notes = lanes_near(self.given[0], *window.places), self.given[1]
        near = {name: points - window.places[2] for name, points in self.lights.items()}
        lanes, light_notes = with_stop_lines(lanes, near)
        clock = np.unique(np.concatenate([track.t for track in window.tracks]))
        seen, states = self.clock("lights"), self.tables["lights"][:, 1:]
        signals = signals_of(seen, states, list(self.lights), clock)
        return {"lanes": lanes, "signals": signals}, [*notes, *light_notes]
