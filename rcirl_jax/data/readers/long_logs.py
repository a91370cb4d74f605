"""Logs of rows, by recording; long ones in slices of a minute or less.

Rows are sorted into blocks while a log is read, a few MiB at a time. Each recording of
a log that fits into memory is one block, and one slice. A long log has a block per
recording and minute, in scratch files. Each minute is then a Recording of its own, with
rows before and after it, so that scenes and filters do not end at the border. When each
road user was first seen, also after gaps, is found for the whole log first, so that
vehicles and their groups are those of a log read at once.

What differs from a file that fits: lanes that are not given are fitted minute by
minute, the given path is known for 28 s beyond the minute only, and a row out of
order is found inside a minute only. Rows may come in any order of road users; scratch
space of about the file's size is needed. An importer that needs something of the
whole recording finds it in `minutes`.
"""

import contextlib
import dataclasses
import itertools
import shutil
import tempfile
from collections.abc import Container, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.data.readers.reading import reading
from rcirl_jax.data.readers.tables.rows import (
    DAY_S,
    Distance,
    Rows,
    RowStats,
    after_turn,
    drop_duplicates,
    drop_position_outliers,
    is_far,
)
from rcirl_jax.data.readers.tables.table import (
    Batch,
    Field,
    Table,
    batches,
    check_rows,
    number_texts,
)
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import locked
from rcirl_jax.types import Recording

BLOCK_S = 60.0  # s of a slice
BEFORE_S = 5.0  # s of rows before it: history and the smoothing window
AFTER_S = 28.0  # s after it: the future of 8 s, smoothing, and the path beyond
MAX_BLOCKS = 200_000  # minutes of one file; more mean a wrong unit of time
# own rows of a slice, about; of a minute with more, windows of it are slices, so that
# the scenes held (10 kB each) are bounded
MAX_ROWS = 150_000
MAX_WINDOWS = 60  # of a minute
BUFFER_BYTES = 64 * 2**20  # bytes of rows held before they go to scratch files
SCRATCH = "rcirl-scratch-"  # how folders of scratch files begin
LOCK = "lock"  # in such a folder, held while it is in use


@dataclasses.dataclass(frozen=True, kw_only=True)
class TimeSlice:
    """Rows of one minute of one recording, and of its surroundings.

    Of a minute too crowded for memory it is a window, counted by `window`.
    """

    values: Rows  # t since the recording's start
    start: float = 0.0  # s, of it on the log's clock
    number: int = 0  # of the minute, from the recording's first
    window: int | None = None  # of the minute; None: the minute is one slice
    within: tuple[float, float] = (-np.inf, np.inf)  # s, the minute or the window
    # id -> s, when the whole log first saw it, and when again after each gap
    fragments: dict[str, list[float]] = dataclasses.field(default_factory=dict)
    progress: float = 1.0  # share of the file's slices up to this one
    is_whole: bool = False  # the recording is one slice

    @property
    def label(self) -> str:
        """Returns the end of the recording's name."""
        rest = "" if self.window is None else f".{self.window:02d}"
        return "" if self.is_whole else f"-{self.number:05d}{rest}"

    def of_log(self, log: str, made: Recording) -> Recording:
        """Returns a slice's Recording as part of a log, with the log's track names."""
        if self.is_whole:
            return made
        tracks = []
        for track in made.tracks:
            is_known = track.id in self.fragments
            user = track.id if is_known else track.id.rpartition("#")[0]
            starts = self.fragments[user]
            count = int(np.searchsorted(starts, track.t[0] + 1e-6, side="right"))
            name = user if count <= 1 else f"{user}#{count}"
            since = starts[max(count - 1, 0)]
            tracks.append(dataclasses.replace(track, id=name, seen_since=since))
        return dataclasses.replace(
            made,
            tracks=tuple(tracks),
            piece_of=log,
            scenes_within=self.within,
            progress=self.progress,
        )


@contextlib.contextmanager
def rows_of(
    table: Table,
    fields: Sequence[Field],
    stats: RowStats,
    *,
    is_long: bool,
    turn_s: float = DAY_S,
    **tidying: Any,  # noqa: ANN401
) -> Iterator["RowStore"]:
    """Gives the rows of a table, each road user once in a frame.

    Args:
      table: of `open_table`.
      fields: what is read, at least t [s] and id.
      stats: of the file.
      is_long: the rows go to scratch files, which are removed afterwards; a bar
        shows the reading.
      turn_s: s after which a clock without a date begins anew, as at midnight.
      **tidying: places, may_differ, distance of `RowStore`.

    Raises:
      InputError: no rows, more bad ones than are allowed, or more than MAX_BLOCKS
        minutes.
    """
    with scratch() if is_long else contextlib.nullcontext() as folder:
        made = RowStore(stats=stats, folder=folder, **tidying)
        with reading(table.path, [table.path]) as show:
            show = show if is_long else None
            for batch in batches(table, fields, stats, show):
                made.add(batch)
                if not is_long:
                    check_rows(table, stats.read)
        stats.check()
        made.finish(turn_s)
        yield made


@dataclasses.dataclass(kw_only=True)
class RowStore:
    """Rows by recording and minute: [n, columns] float64 in memory or scratch files.

    Texts are numbers in order of appearance.
    """

    stats: RowStats
    folder: Path | None  # of scratch files; None: in memory, a recording is one block
    # columns that say where a road user is
    places: tuple[str, str] = ("x", "y")
    # columns in which rows may differ that repeat each other
    may_differ: Container[str] = ()
    # of differences in x and y; places that cannot be reached are then dropped, and an
    # id that goes on elsewhere is seen anew there; None: neither
    distance: Distance | None = None

    def __post_init__(self) -> None:
        """Begins without rows."""
        self._names: list[str] = []  # of the columns
        self._texts: dict[str, dict[str, int]] = {}  # field -> text -> its number
        # number of a recording -> minute -> rows that are in memory
        self._blocks: dict[int, dict[int, list[np.ndarray]]] = {}
        self._held = 0  # bytes of them
        self._given = 0.0  # minutes given as slices
        self._tidied: set[int] = set()
        self._seconds: set[float] = set()  # in which there are rows
        self._arrays: dict[str, np.ndarray] = {}  # field -> all its texts

    def add(self, batch: Batch) -> None:
        """Sorts a batch's rows into their blocks."""
        columns = number_texts(batch, self._texts)
        self._names = list(columns)
        self._seconds.update(np.unique(np.floor(columns["t"])).tolist())
        rows = np.stack(list(columns.values()), axis=1)
        recording = minute = np.zeros(len(rows), np.int64)
        if "recording" in columns:
            recording = columns["recording"].astype(np.int64)
        if self.folder is not None:
            minute = np.floor(columns["t"] / BLOCK_S).astype(np.int64)
        order = np.lexsort((minute, recording))  # stable: the file's order inside
        keys = np.stack([recording, minute], axis=1)[order]
        changes = np.flatnonzero(np.any(np.diff(keys, axis=0), axis=1)) + 1
        for part in np.split(order, changes) if order.size else []:
            blocks = self._blocks.setdefault(int(recording[part[0]]), {})
            blocks.setdefault(int(minute[part[0]]), []).append(rows[part])
        if sum(map(len, self._blocks.values())) > MAX_BLOCKS:
            raise InputError(
                f"{self.stats.path}: t: more than {MAX_BLOCKS} minutes: expected "
                "seconds; wrong unit of time?"
            )
        self._held += rows.nbytes
        if self.folder is not None and self._held > BUFFER_BYTES:
            self._flush()

    def finish(self, turn_s: float) -> None:
        """Ends the adding; times of day after midnight become those of the next."""
        if self.folder is not None:
            self._flush()
        t, later_by = self._names.index("t"), round(turn_s / BLOCK_S)
        is_dated = min(self._seconds, default=0.0) >= turn_s
        for code, minutes in () if is_dated else self._blocks.items():
            if self.folder is None:
                rows = self._rows(code, 0)
                rows[:, t] = after_turn(rows[:, t], turn_s)
                self._put(code, 0, rows)
                continue
            found = np.array(sorted(minutes), float)
            later = after_turn(found * BLOCK_S, turn_s) > found * BLOCK_S
            for minute in found[later].astype(int).tolist():
                rows = self._rows(code, minute)
                rows[:, t] += turn_s
                self._file(code, minute).unlink()
                del minutes[minute]
                self._put(code, minute + later_by, rows)

    def _file(self, code: int, minute: int) -> Path:
        assert self.folder is not None
        return self.folder / f"{code}_{minute}"

    def _flush(self) -> None:
        """Writes what is held to the scratch files."""
        for code, minutes in self._blocks.items():
            for minute, parts in minutes.items():
                if parts:
                    with self._file(code, minute).open("ab") as file:
                        for part in parts:
                            file.write(np.ascontiguousarray(part).tobytes())
                    parts.clear()
        self._held = 0

    def _put(self, code: int, minute: int, rows: np.ndarray) -> None:
        """Replaces a block."""
        self._blocks[code][minute] = [rows] if self.folder is None else []
        if self.folder is not None:
            rows.tofile(self._file(code, minute))

    def _rows(self, code: int, minute: int) -> np.ndarray:
        parts = self._blocks[code].get(minute)
        if parts is None:
            return np.zeros((0, len(self._names)))
        if self.folder is None:
            return np.concatenate(parts)
        raw = np.fromfile(self._file(code, minute), np.float64)
        return raw.reshape(-1, len(self._names))

    def recordings(self) -> list[str | None]:
        """Returns the values of `recording`; [None] without the field."""
        if "recording" not in self._names:
            return [None]
        every = self._texts["recording"].items()
        found = [text for text, code in every if code in self._blocks]
        return [*(found if self.folder else sorted(found))]

    def texts_of(self, field: str) -> list[str]:
        """Returns all that a field of texts holds."""
        return list(self._texts.get(field, ()))

    def seconds(self) -> np.ndarray:
        """Returns the whole seconds [n] in which there are rows, rising, as written."""
        return np.array(sorted(self._seconds))

    def _values(self, rows: np.ndarray) -> Rows:
        """Field -> [n], texts as texts."""
        values = dict(zip(self._names, np.ascontiguousarray(rows.T), strict=True))
        values.pop("recording", None)
        for name in self._texts.keys() & values.keys():
            if name not in self._arrays:
                self._arrays[name] = np.array(self.texts_of(name), object)
            codes = values[name].astype(np.int64)
            values[name] = self._arrays[name][codes].astype(str)
        return values

    def _minutes(self, recording: str | None) -> tuple[int, list[int]]:
        """A recording's number, and its minutes in the order of time, tidied once."""
        code = 0 if recording is None else self._texts["recording"][recording]
        minutes = sorted(self._blocks.get(code, ()))
        for minute in minutes if code not in self._tidied else ():
            rows = self._rows(code, minute)
            kept = self._tidy(dict(zip(self._names, rows.T, strict=True)))
            if kept["t"].size < len(rows):
                self._put(code, minute, np.stack(list(kept.values()), axis=1))
        self._tidied.add(code)
        return code, minutes

    def _tidy(self, rows: Rows) -> Rows:
        """Returns rows of which each road user is met once in a frame, and near."""
        users = self.texts_of("id")

        def name_of(user: float) -> str:
            return users[int(user)] if users else f"{user:g}"

        kept = drop_duplicates(
            rows,
            self.stats,
            places=self.places,
            may_differ=self.may_differ,
            name_of=name_of,
        )
        if self.distance is None:
            return kept
        return drop_position_outliers(kept, self.stats, self.distance, name_of)

    def minutes(self, recording: str | None) -> Iterator[Rows]:
        """Yields the rows of each block of a recording alone, t as in the file."""
        code, minutes = self._minutes(recording)
        for minute in minutes:
            yield self._values(self._rows(code, minute))

    def _fragments(
        self, code: int, minutes: list[int], max_gap_s: float
    ) -> Mapping[int, list[float]]:
        """Number of id -> times [s] at which it is first seen, or again."""
        found: dict[int, list[float]] = {}
        names = ("id", "t", *(self.places if self.distance else ()))
        columns = [self._names.index(name) for name in names]
        last = np.zeros((0, len(columns)))  # row of each road user so far
        for minute in minutes:
            rows = np.concatenate([last, self._rows(code, minute)[:, columns]])
            rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
            steps = np.diff(rows, axis=0)
            same, is_again = steps[:, 0] == 0.0, steps[:, 1] > max_gap_s
            if self.distance is not None:
                is_again |= is_far(steps[:, 1], self.distance(*steps[:, 2:].T))
            for user, begin in rows[np.concatenate([[True], ~same]), :2].tolist():
                found.setdefault(int(user), [begin])
            for user, begin in rows[1:][same & is_again, :2].tolist():
                found[int(user)].append(begin)
            last = rows[np.concatenate([~same, [True]])]
        return found

    def slices(self, recording: str | None, max_gap_s: float) -> Iterator[TimeSlice]:
        """Yields every minute with its surroundings, in the order of time.

        Args:
          recording: one of `recordings()`.
          max_gap_s: a road user unseen for longer is another fragment.
        """
        if self.folder is None:
            for values in self.minutes(recording):
                start = float(values["t"].min())
                values = {**values, "t": values["t"] - start}
                yield TimeSlice(values=values, start=start, is_whole=True)
            return
        code, minutes = self._minutes(recording)
        users = self.texts_of("id")
        t, user = self._names.index("t"), self._names.index("id")
        fragments = self._fragments(code, minutes, max_gap_s)
        start = min(seen for seen, *_ in fragments.values()) if fragments else 0.0
        total = sum(map(len, self._blocks.values()))

        def between(rows: np.ndarray, begin: float, end: float) -> np.ndarray:
            return rows[(rows[:, t] >= begin) & (rows[:, t] < end)]

        for minute in minutes:
            begin, end = minute * BLOCK_S, (minute + 1) * BLOCK_S
            near = np.concatenate([self._rows(code, minute + k) for k in (-1, 0, 1)])
            near = between(near, begin - BEFORE_S, end + AFTER_S)
            own = between(near, begin, end)[:, t]
            count = min(-(-own.size // MAX_ROWS), MAX_WINDOWS)
            edges = np.linspace(begin, end, count + 1).tolist()
            for window, (low, high) in enumerate(itertools.pairwise(edges)):
                self._given += 1 / count
                if not np.any((own >= low) & (own < high)):
                    continue
                rows = between(near, low - BEFORE_S, high + AFTER_S)
                values = self._values(rows)
                values["t"] = values["t"] - start
                yield TimeSlice(
                    number=minute - int(np.floor(start / BLOCK_S)),
                    values=values,
                    start=start,
                    within=(low - start, high - start),
                    fragments={
                        users[u] if users else str(u): [s - start for s in fragments[u]]
                        for u in np.unique(rows[:, user]).astype(int).tolist()
                    },
                    progress=self._given / total,
                    window=window if count > 1 else None,
                )


@contextlib.contextmanager
def scratch() -> Iterator[Path]:
    """Makes a locked folder for scratch files; removes those of killed imports."""
    for left in Path(tempfile.gettempdir()).glob(f"{SCRATCH}*/{LOCK}"):
        with contextlib.suppress(OSError), locked(left, wait=False):  # not while in use
            shutil.rmtree(left.parent, ignore_errors=True)
    made = tempfile.TemporaryDirectory(prefix=SCRATCH)
    with made as name, locked(Path(name) / LOCK):
        yield Path(name)
