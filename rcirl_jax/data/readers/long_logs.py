"""Logs of rows, by recording; long ones in pieces of a minute or less.

A log that fits is held, and each of its recordings is one piece. A long one is read
once, a few MiB at a time, and its rows are written to scratch files by recording and
minute. Each minute is then a Recording of its own, with rows before and after it, so
that scenes and filters do not end at the border. When each road user was first seen,
also after gaps, is found for the whole log first, so that vehicles and their groups
are those of a log read at once.

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
from collections.abc import Container, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.data.readers.held_logs import Held, Piece
from rcirl_jax.data.readers.reading import reading
from rcirl_jax.data.readers.tables.clock import DAY_S, after_midnight
from rcirl_jax.data.readers.tables.ledger import Ledger
from rcirl_jax.data.readers.tables.repair import (
    Distance,
    is_far,
    reachable_rows,
    single_rows,
)
from rcirl_jax.data.readers.tables.table import Field, Table, batches, read
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import locked
from rcirl_jax.types import Recording, Track

BLOCK_S = 60.0  # s of a piece
BEFORE_S = 5.0  # s of rows before it: history and the smoothing window
AFTER_S = 28.0  # s after it: the future of 8 s, smoothing, and the path beyond
MAX_BLOCKS = 200_000  # pieces of one file; more mean a wrong unit of time
# own rows of a piece, about; of a minute with more, windows of it are pieces, so that
# the scenes held (10 kB each) are bounded
MAX_ROWS = 150_000
MAX_WINDOWS = 60  # of a minute
BUFFER_BYTES = 64 * 2**20  # bytes of rows held before they go to scratch files
SCRATCH = "rcirl-scratch-"  # how folders of scratch files begin
LOCK = "lock"  # in such a folder, held while it is in use


@contextlib.contextmanager
def rows_of(
    table: Table,
    fields: Sequence[Field],
    ledger: Ledger,
    *,
    is_long: bool,
    apart: Container[str] = (),
    places: tuple[str, str] = ("x", "y"),
    distance: Distance | None = None,
    is_clock: bool = False,
) -> Iterator["Held | Spill"]:
    """The rows of a table, each road user once in a frame.

    Args:
      table: of `open_table`.
      fields: what is read, at least t [s] and id.
      ledger: of the file.
      is_long: the rows go to scratch files, which are removed afterwards; a bar
        shows the reading.
      apart: columns in which rows may differ that repeat each other.
      places: columns that say where a road user is.
      distance: of differences in x and y; places that cannot be reached are then
        dropped, and an id that goes on elsewhere is seen anew there. None: neither.
      is_clock: t is a time of day, which may go over midnight.

    Raises:
      InputError: no rows, more bad ones than the ledger allows, or more than
        MAX_BLOCKS minutes.
    """
    if not is_long:
        rows = read(table, fields, ledger)
        yield Held(rows, ledger, apart, places, distance, is_clock)
        return
    with scratch() as folder:
        spill = Spill(table.path, folder, ledger, apart, places, distance)
        with reading(table.path, [table.path]) as show:
            for batch in batches(table, fields, ledger, show):
                spill.add(batch)
        ledger.check()
        spill.flush()
        if is_clock:
            spill.pass_midnight()
        yield spill


def piece_of(log: str, made: Recording, piece: Piece) -> Recording:
    """A piece's Recording as a part of the log: its tracks named as in the whole."""
    if piece.is_whole:
        return made
    return dataclasses.replace(
        made,
        tracks=tuple(_of_log(track, piece.fragments) for track in made.tracks),
        piece_of=log,
        scenes_within=piece.within,
        progress=piece.progress,
    )


def _of_log(track: Track, fragments: dict[str, list[float]]) -> Track:
    """A track of a piece under the name that it has in the whole log."""
    user = track.id if track.id in fragments else track.id.rpartition("#")[0]
    starts = fragments[user]
    number = int(np.searchsorted(starts, track.t[0] + 1e-6, side="right"))
    return dataclasses.replace(
        track,
        id=user if number <= 1 else f"{user}#{number}",
        seen_since=starts[max(number - 1, 0)],
    )


@contextlib.contextmanager
def scratch() -> Iterator[Path]:
    """A locked folder for scratch files; removes those that killed imports left."""
    for left in Path(tempfile.gettempdir()).glob(f"{SCRATCH}*/{LOCK}"):
        with contextlib.suppress(OSError), locked(left, wait=False):  # not while in use
            shutil.rmtree(left.parent, ignore_errors=True)
    made = tempfile.TemporaryDirectory(prefix=SCRATCH)
    with made as name, locked(Path(name) / LOCK):
        yield Path(name)


def _within(rows: np.ndarray, t: int, begin: float, end: float) -> np.ndarray:
    """Rows whose column t lies in [begin, end) s."""
    return rows[(rows[:, t] >= begin) & (rows[:, t] < end)]


class Spill:
    """Rows by recording and minute in scratch files of float64."""

    def __init__(
        self,
        path: Path,
        folder: Path,
        ledger: Ledger,
        apart: Container[str],
        places: tuple[str, str],
        distance: Distance | None = None,
    ) -> None:
        self.path, self.folder, self.ledger = path, folder, ledger
        self.apart, self.places, self.distance = apart, places, distance
        self.names: list[str] = []  # of the columns, as in the first batch
        self.texts: dict[str, dict[str, int]] = {}  # field -> text -> its number
        self.blocks: dict[int, set[int]] = {}  # number of a recording -> minutes
        self.buffers: dict[tuple[int, int], list[np.ndarray]] = {}
        self.held = 0  # bytes in the buffers
        self.given = 0.0  # minutes given as pieces
        self._tables: dict[str, np.ndarray] = {}
        self._tidied: set[int] = set()

    def add(self, batch: dict) -> None:
        """Sort a batch's rows into their minutes."""
        if not self.names:
            self.names = list(batch)
            self.texts = {n: {} for n in batch if isinstance(batch[n], tuple)}
        columns = [self._numbers(name, batch[name]) for name in self.names]
        rows = np.stack(columns, axis=1)
        recording = np.zeros(len(rows), np.int64)
        if "recording" in self.names:
            recording = rows[:, self.names.index("recording")].astype(np.int64)
        minute = np.floor(rows[:, self.names.index("t")] / BLOCK_S).astype(np.int64)
        order = np.lexsort((minute, recording))  # stable: the file's order inside
        keys = np.stack([recording, minute], axis=1)[order]
        changes = np.flatnonzero(np.any(np.diff(keys, axis=0), axis=1)) + 1
        for part in np.split(order, changes) if order.size else []:
            key = (int(recording[part[0]]), int(minute[part[0]]))
            self.blocks.setdefault(key[0], set()).add(key[1])
            self.buffers.setdefault(key, []).append(rows[part])
        if sum(map(len, self.blocks.values())) > MAX_BLOCKS:
            raise InputError(
                f"{self.path}: t: more than {MAX_BLOCKS} minutes: expected seconds; "
                "wrong unit of time?"
            )
        self.held += rows.nbytes
        if self.held > BUFFER_BYTES:
            self.flush()

    def _numbers(self, name: str, column: Any) -> np.ndarray:  # noqa: ANN401
        """A column as float64; texts as their numbers in order of appearance."""
        if name not in self.texts:
            return column
        codes, texts = column
        known = self.texts[name]
        mine = [known.setdefault(text, len(known)) for text in texts]
        return np.array(mine, np.float64)[codes]

    def flush(self) -> None:
        """Write what is held to the scratch files."""
        for (recording, minute), rows in self.buffers.items():
            with (self.folder / f"{recording}_{minute}").open("ab") as file:
                for part in rows:
                    file.write(np.ascontiguousarray(part).tobytes())
        self.buffers, self.held = {}, 0

    def pass_midnight(self) -> None:
        """Minutes after midnight become those of the next day."""
        days = round(DAY_S / BLOCK_S)
        for code, minutes in self.blocks.items():
            found = np.array(sorted(minutes), float)
            later = after_midnight(found * BLOCK_S) > found * BLOCK_S
            for minute in found[later].astype(int).tolist():
                rows = self._rows(code, minute)
                rows[:, self.names.index("t")] += DAY_S
                (self.folder / f"{code}_{minute}").unlink()
                rows.tofile(self.folder / f"{code}_{minute + days}")
                minutes.remove(minute)
                minutes.add(minute + days)

    def recordings(self) -> list[str | None]:
        """Values of `recording`; [None] without the field."""
        known = self.texts.get("recording", {})
        return [text for text, number in known.items() if number in self.blocks] or [
            None
        ]

    def texts_of(self, field: str) -> list[str]:
        """All that a field of texts holds."""
        return list(self.texts.get(field, ()))

    def _minutes(self, recording: str | None) -> tuple[int, list[int]]:
        """A recording's number, and its minutes in the order of time."""
        code = 0 if recording is None else self.texts["recording"][recording]
        return code, sorted(self.blocks.get(code, ()))

    def _rows(self, code: int, minute: int) -> np.ndarray:
        if minute not in self.blocks[code]:
            return np.zeros((0, len(self.names)))
        raw = np.fromfile(self.folder / f"{code}_{minute}", np.float64)
        return raw.reshape(-1, len(self.names))

    def _tidy(self, code: int, minutes: list[int]) -> None:
        """Leave each road user of a recording one row a frame, once."""
        if code in self._tidied:
            return
        self._tidied.add(code)
        for minute in minutes:
            rows = self._rows(code, minute)
            values = {name: rows[:, place] for place, name in enumerate(self.names)}
            kept = single_rows(
                values,
                values["t"],
                values["id"],
                self.ledger,
                self.places,
                self.apart,
                self._named,
            )
            if self.distance is not None:
                once = {name: column[kept] for name, column in values.items()}
                kept[kept] = reachable_rows(
                    once, self.ledger, self.distance, self._named
                )
            if not kept.all():
                rows[kept].tofile(self.folder / f"{code}_{minute}")

    def _named(self, user: float) -> str:
        """An id as it stands in the file."""
        return str(self._table("id")[int(user)]) if "id" in self.texts else f"{user:g}"

    def minutes(self, recording: str | None) -> Iterator[dict[str, np.ndarray]]:
        """Field -> [n] of each minute alone, t as in the file."""
        code, minutes = self._minutes(recording)
        self._tidy(code, minutes)
        for minute in minutes:
            yield self._values(self._rows(code, minute))

    def _values(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        values = {name: rows[:, place] for place, name in enumerate(self.names)}
        values.pop("recording", None)
        for name in self.texts:
            if name in values:
                codes = values[name].astype(np.int64)
                values[name] = self._table(name)[codes].astype(str)
        return values

    def _table(self, name: str) -> np.ndarray:
        """Texts of a field by number; all of them are known once the file is read."""
        if name not in self._tables:
            self._tables[name] = np.array(list(self.texts[name]), object)
        return self._tables[name]

    def _fragments(
        self, code: int, minutes: list[int], max_gap_s: float
    ) -> dict[int, list[float]]:
        """Number of id -> times [s] at which it is first seen, or again."""
        found: dict[int, list[float]] = {}
        names = ("id", "t", *(self.places if self.distance else ()))
        columns = [self.names.index(name) for name in names]
        last = np.zeros((0, len(columns)))  # row of each road user so far
        for minute in minutes:
            rows = np.concatenate([last, self._rows(code, minute)[:, columns]])
            rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
            steps = np.diff(rows, axis=0)
            same = steps[:, 0] == 0.0
            for user, begin in rows[np.concatenate([[True], ~same]), :2].tolist():
                found.setdefault(int(user), [begin])
            again = np.flatnonzero(same & self._is_again(steps, max_gap_s)) + 1
            for user, begin in rows[again, :2].tolist():
                found[int(user)].append(begin)
            last = rows[np.concatenate([~same, [True]])]
        return found

    def _is_again(self, steps: np.ndarray, max_gap_s: float) -> np.ndarray:
        """Whether steps [n] in id, t, x, y lead to another track of an id."""
        again = steps[:, 1] > max_gap_s
        if self.distance is None:
            return again
        return again | is_far(steps[:, 1], self.distance(*steps[:, 2:].T))

    def pieces(self, recording: str | None, max_gap_s: float) -> Iterator[Piece]:
        """Every minute of a recording with its surroundings, in the order of time.

        Args:
          recording: one of `recordings()`.
          max_gap_s: a road user unseen for longer is another fragment.
        """
        code, minutes = self._minutes(recording)
        self._tidy(code, minutes)
        users: list[str] = list(self.texts.get("id", {}))
        t, user = self.names.index("t"), self.names.index("id")
        fragments = self._fragments(code, minutes, max_gap_s)
        start = min(seen for seen, *_ in fragments.values()) if fragments else 0.0
        total = sum(map(len, self.blocks.values()))
        for minute in minutes:
            begin, end = minute * BLOCK_S, (minute + 1) * BLOCK_S
            near = np.concatenate([self._rows(code, minute + k) for k in (-1, 0, 1)])
            near = _within(near, t, begin - BEFORE_S, end + AFTER_S)
            own = _within(near, t, begin, end)[:, t]
            count = min(-(-own.size // MAX_ROWS), MAX_WINDOWS)
            edges = np.linspace(begin, end, count + 1).tolist()
            for window, (low, high) in enumerate(itertools.pairwise(edges)):
                self.given += 1 / count
                if not np.any((own >= low) & (own < high)):
                    continue
                rows = _within(near, t, low - BEFORE_S, high + AFTER_S)
                values = self._values(rows)
                values["t"] = values["t"] - start
                yield Piece(
                    recording=recording,
                    number=minute - int(np.floor(start / BLOCK_S)),
                    values=values,
                    within=(low - start, high - start),
                    fragments={
                        users[u] if users else str(u): [s - start for s in fragments[u]]
                        for u in np.unique(rows[:, user]).astype(int).tolist()
                    },
                    progress=self.given / total,
                    window=window if count > 1 else None,
                )
