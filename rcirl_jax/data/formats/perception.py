"""What logs of a car's own perception share: boxes, gaps, outliers, windows.

L5, nuPlan and Apollo logs hold what one car saw while it drove: boxes with an
id, a class that may be unknown, and gaps where the view was blocked. An importer
gathers them as `Boxes`; this module makes tracks of them. Long drives are read in
windows that overlap.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.options import STATED, number, positive, section, stated
from rcirl_jax.data.formats.paths import path_lanes
from rcirl_jax.data.formats.shapes import local_origin
from rcirl_jax.data.formats.tracks import once_each, split_tracks
from rcirl_jax.data.readers import long_logs
from rcirl_jax.data.recording import LENGTH_RANGE_M, MAX_SPEED_MPS, WIDTH_RANGE_M
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Lane, Recording, Track

UNKNOWN = -1  # kind of a box whose class the log does not know
UNKNOWN_CHOICES = ("auto", "drop", "static", "vehicle")
STANDING_M = 1.0  # m, an unknown object that moves less than this is static
MAX_OUTLIERS = 0.1  # share of tracks dropped as outliers; more is an error
ONE_OF = 5  # tracks of which one may always be an outlier
WINDOW_S = 300.0  # s, longest window of a drive
MIN_WINDOW_S = 1.0  # s that it may be; each window costs as much as its surroundings
LANE_WIDTH_M = 3.5  # m, of lanes fitted to paths
# m, [length, width] of road users of which none is known; others: 1 m
SIZES_M = {
    Kind.VEHICLE: (4.5, 1.8),
    Kind.CYCLIST: (1.8, 0.6),
    Kind.PEDESTRIAN: (0.5, 0.5),
}
OTHER_SIZE_M = (1.0, 1.0)  # m
MAX_SIZE_M = 200.0  # m, of a box; beyond it the file is wrong, not the tracker
ARRAYS = ("ids", "t", "x", "y", "heading", "speed", "length", "width", "kind")
FIELDS = ("t", "x", "y", "heading", "length", "width")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Boxes:
    """Boxes of all road users of one recording, in any order."""

    ids: np.ndarray  # [n] int, the same for all boxes of one road user
    names: Sequence[str]  # name of each id: `names[ids]`
    t: np.ndarray  # [n] s
    x: np.ndarray  # [n] m, of the box centre
    y: np.ndarray  # [n] m
    heading: np.ndarray  # [n] rad
    speed: np.ndarray  # [n] m/s; NaN: from the positions
    length: np.ndarray  # [n] m; NaN: not known
    width: np.ndarray  # [n] m; NaN: not known
    kind: np.ndarray  # [n] int, `Kind` or UNKNOWN
    size_assumed: bool = False  # no log says the sizes


def ego_boxes(
    spec: Mapping,
    usual: Mapping[str, float],
    t: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    heading: np.ndarray,
    speed: np.ndarray,
) -> Boxes:
    """Boxes of the recording car, id "ego", by its poses [n].

    Args:
      spec: source TOML; the table `ego` has the car's measures.
      usual: where it has not: length, width, and how far ahead of a pose's place the
        box's centre lies, m.
      t: s.
      x: m.
      y: m.
      heading: rad.
      speed: m/s; NaN: from the positions.
    """
    own = section(spec, "ego")
    length, width, ahead = (number(own, name, m) for name, m in usual.items())
    return Boxes(
        ids=np.zeros(t.size, np.int64),
        names=("ego",),
        t=t,
        x=x + ahead * np.cos(heading),
        y=y + ahead * np.sin(heading),
        heading=heading,
        speed=speed,
        length=np.full(t.size, length),
        width=np.full(t.size, width),
        kind=np.full(t.size, int(Kind.VEHICLE)),
        size_assumed="ego" not in spec.get(STATED, ()),
    )


def tracks_of(
    path: Path,
    boxes: Boxes,
    max_gap_s: float,
    unknown: str = "auto",
    automated: tuple[tuple[float, float], ...] = (),
) -> tuple[list[Track], list[str]]:
    """Tracks of the boxes, in the order of their ids, and notes on what was left out.

    A gap longer than `max_gap_s` starts another track, "id#2". Size and class
    are the median and the most frequent of a track; where no size is known it is that
    of its class. Trackers lose objects now
    and then: tracks with an impossible size or speed are left out, unless they
    are more than a tenth, which points at a wrong file. A box that is met twice at one
    time counts once, likewise.

    Args:
      path: named in errors.
      boxes: at least none.
      max_gap_s: s without a box inside one track.
      unknown: what objects of unknown class become: "drop", "static",
        "vehicle", or by whether they moved ("auto").
      automated: of all tracks.

    Raises:
      InputError: a number that is not finite, an absurd size, or many times met
        twice by one id.
    """
    if unknown not in UNKNOWN_CHOICES:
        raise InputError(
            f"source TOML: unknown: {unknown}: expected one of {UNKNOWN_CHOICES}"
        )
    if boxes.t.size == 0:
        return [], []
    _check(path, boxes)
    kept, doubled = once_each(boxes.ids, boxes.t)
    if doubled:
        rows = {name: getattr(boxes, name)[kept] for name in ARRAYS}
        boxes = dataclasses.replace(boxes, **rows)
    tracks, dropped, seen = [], 0, {}
    for _, rows in split_tracks(path, boxes.ids, boxes.t, max_gap_s):
        name = boxes.names[int(boxes.ids[rows[0]])]
        seen[name] = seen.get(name, 0) + 1
        label = name if seen[name] == 1 else f"{name}#{seen[name]}"
        track = _track(label, boxes, rows, unknown, automated)
        dropped += track is None
        tracks += [] if track is None else [track]
    tracks, notes = without_outliers(tracks)
    if dropped:
        notes.append(f"{dropped} tracks of unknown class left out")
    return tracks, [*doubled, *notes]


def _check(path: Path, boxes: Boxes) -> None:
    """Everything is finite, and no box is absurdly large."""
    for field in FIELDS:
        values = getattr(boxes, field)
        wrong, expected = ~np.isfinite(values), ": expected a finite number"
        if field in ("length", "width"):
            wrong = (values < 0.0) | (values > MAX_SIZE_M)  # NaN is not known
            expected = f" m: expected 0 to {MAX_SIZE_M:g} m"
        if wrong.any():
            row = np.flatnonzero(wrong)[0]
            name = boxes.names[int(boxes.ids[row])]
            raise InputError(f"{path}: id {name}: {field}: {values[row]:g}{expected}")


def _track(
    name: str,
    boxes: Boxes,
    rows: np.ndarray,
    unknown: str,
    automated: tuple[tuple[float, float], ...],
) -> Track | None:
    """One track, or None where its class is unknown and such are dropped."""
    t, x, y = boxes.t[rows], boxes.x[rows], boxes.y[rows]
    # most frequent class; the shift makes UNKNOWN a count of its own
    kind = int(np.argmax(np.bincount(boxes.kind[rows] - UNKNOWN))) + UNKNOWN
    usual = SIZES_M.get(Kind(max(kind, 0)), OTHER_SIZE_M)
    length, width = (
        _median(sizes[rows], default)
        for sizes, default in zip((boxes.length, boxes.width), usual, strict=True)
    )
    if kind == UNKNOWN:
        if unknown == "drop":
            return None
        moved = np.hypot(np.ptp(x), np.ptp(y)) > STANDING_M
        choice = ("vehicle" if moved else "static") if unknown == "auto" else unknown
        kind = int(Kind[choice.upper()])
    speed = boxes.speed[rows]
    lost = ~np.isfinite(speed)
    if lost.any():
        speed = np.where(lost, speed_of(t, x, y), speed)
    return Track(
        id=name,
        kind=Kind(kind),
        length=max(length[0], LENGTH_RANGE_M[0]),
        width=max(width[0], WIDTH_RANGE_M[0]),
        size_assumed=boxes.size_assumed or length[1] or width[1],
        t=t,
        x=x,
        y=y,
        heading=boxes.heading[rows],
        speed=speed,
        automated=automated,
    )


def _median(sizes: np.ndarray, default: float) -> tuple[float, bool]:
    """The median [m] of the known sizes, or the default; whether it is this one."""
    known = sizes[np.isfinite(sizes)]
    return (float(np.median(known)), False) if known.size else (default, True)


def speed_of(t: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Speed [n] m/s from positions: central differences."""
    if t.size < 2:
        return np.zeros(t.shape)
    return np.hypot(np.gradient(x, t), np.gradient(y, t))


def without_outliers(
    tracks: list[Track], is_possible: Callable[[Track], bool] | None = None
) -> tuple[list[Track], list[str]]:
    """Tracks without the impossible ones, and a note of their number.

    All tracks, for validation to refuse, if more than MAX_OUTLIERS are impossible, and
    more than one of ONE_OF or more.

    Args:
      tracks: of one recording.
      is_possible: default: by size and speed.
    """
    good = [track for track in tracks if (is_possible or _is_possible)(track)]
    lost = len(tracks) - len(good)
    allowed = max(MAX_OUTLIERS * len(tracks), float(len(tracks) >= ONE_OF))
    if lost == 0 or lost > allowed:
        return tracks, []
    return good, [f"{lost} tracks with an impossible size or speed left out"]


def has_possible_speed(track: Track) -> bool:
    """Whether no sample is faster than any road user."""
    return not np.max(np.abs(track.speed)) > MAX_SPEED_MPS


def _is_possible(track: Track) -> bool:
    if not has_possible_speed(track):
        return False
    if track.kind == Kind.STATIC:
        return True
    sizes = ((track.length, LENGTH_RANGE_M), (track.width, WIDTH_RANGE_M))
    return all(low <= size <= high for size, (low, high) in sizes)


def longest_window(spec: Mapping) -> float:
    """The option `window_s` of a source TOML, s."""
    window = number(spec, "window_s", WINDOW_S)
    if window < MIN_WINDOW_S:
        raise InputError(
            f"source TOML: window_s: {window:g}: expected at least {MIN_WINDOW_S:g} s"
        )
    return window


def around(within: tuple[float, float]) -> tuple[float, float]:
    """Times [s] that a window's scenes need: with their history and future."""
    low, high = within
    return low - long_logs.BEFORE_S, high + long_logs.AFTER_S


class Windows:
    """Windows of one long drive: each road user has one name in all of them.

    Args:
      drive: its name.
      group: vehicle-disjoint group of all its windows.
      max_gap_s: a road user unseen for longer is another track.
    """

    def __init__(self, drive: str, group: str, max_gap_s: float) -> None:
        self.drive, self.group, self.max_gap_s = drive, group, max_gap_s
        self._starts: dict[str, list[float]] = {}  # s, first seen, and after gaps
        self._last: dict[str, float] = {}  # s

    def recording(
        self, made: Recording, number: int, within: tuple[float, float], progress: float
    ) -> Recording:
        """A window as a part of the drive; windows come in the order of time.

        Args:
          made: with `around(within)`, in seconds of the drive.
          number: of the window.
          within: s, when its scenes begin.
          progress: share of the input read with it.
        """
        for track in made.tracks:
            user, first = track.id.partition("#")[0], float(track.t[0])
            last = self._last.get(user, -np.inf)
            if first - last > self.max_gap_s:
                self._starts.setdefault(user, []).append(first)
            self._last[user] = max(last, float(track.t[-1]))
        piece = long_logs.Piece(
            recording=None,
            number=number,
            values={},
            within=within,
            fragments=self._starts,
            progress=progress,
        )
        name = f"{self.drive}-{number:03d}"
        made = dataclasses.replace(made, name=name, group=self.group)
        return long_logs.piece_of(self.drive, made, piece)


def placed(
    tracks: Sequence[Track],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Track]]:
    """(x, y [n] m of all samples, local origin [2] m, tracks around it)."""
    x = np.concatenate([track.x for track in tracks])
    y = np.concatenate([track.y for track in tracks])
    origin = local_origin(x, y)
    moved = [
        dataclasses.replace(track, x=track.x - origin[0], y=track.y - origin[1])
        for track in tracks
    ]
    return x, y, origin, moved


def fitted_lanes(
    tracks: Sequence[Track], spec: Mapping
) -> tuple[tuple[Lane, ...], str]:
    """Lanes along the paths that were driven, and a note of their number.

    Their limit is what the user's own TOML states, if it does.
    """
    width = positive(spec, "lane_width_m", LANE_WIDTH_M)
    lanes = path_lanes(tracks, width, stated(spec, "speed_limit"))
    return lanes, f"{len(lanes)} lanes fitted to the longest paths"
