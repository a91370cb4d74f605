"""Long CSV logs: imported in pieces of a minute, in bounded memory.

The file is read once, a few MiB at a time, and its rows are written to scratch
files by recording and minute. Each minute is then a Recording of its own, with
rows before and after it, so that scenes and filters do not end at the border.
When each road user was first seen, also after gaps, is found for the whole log
first, so that vehicles and their groups are those of a log read at once.

What differs from a file that fits: lanes that are not given are fitted minute by
minute, the given path is known for 28 s beyond the minute only, and a row out of
order is found inside a minute only. Rows may come in any
order of road users; scratch space of about the file's size is needed.

pyarrow reads the text (extra `[logs]`).
"""

import dataclasses
import importlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.data.importers.reading import reading
from rcirl_jax.data.importers.tables import number, read_header
from rcirl_jax.errors import InputError

LONG_BYTES = 256 * 2**20  # bytes; a longer file is read in pieces
READ_BYTES = 8 * 2**20  # bytes of text parsed at a time
BLOCK_S = 60.0  # s of a piece
BEFORE_S = 5.0  # s of rows before it: history and the smoothing window
AFTER_S = 28.0  # s after it: the future of 8 s, smoothing, and the path beyond
MAX_BLOCKS = 200_000  # pieces of one file; more mean a wrong unit of time
BUFFER_BYTES = 64 * 2**20  # bytes of rows held before they go to scratch files


@dataclasses.dataclass(frozen=True, kw_only=True)
class Field:
    """A column of the file as a field in SI units."""

    name: str
    column: str
    factor: float = 1.0
    text: bool = False
    limit: float = np.inf  # in the file's unit; beyond it a number is absurd


@dataclasses.dataclass(frozen=True, kw_only=True)
class Piece:
    """Rows of one minute of one recording, and of its surroundings."""

    recording: str | None  # value of the `recording` field
    number: int  # of the minute, from the recording's first
    values: dict[str, np.ndarray]  # field -> [n], t since the recording's start
    within: tuple[float, float]  # s, the minute itself
    # id -> s, when the whole log first saw it, and when again after each gap
    fragments: dict[str, list[float]]
    progress: float  # share of the file's pieces up to this one


def is_long(path: Path, spec: dict) -> bool:
    """Whether a file is read in pieces; `long_bytes` of the TOML sets from where."""
    limit = number(spec, "long_bytes", LONG_BYTES)
    return path.is_file() and path.stat().st_size > limit


def pieces(path: Path, fields: list[Field], max_gap_s: float) -> Iterator[Piece]:
    """All pieces of a file, recording by recording in the order of time.

    Args:
      path: CSV with a header.
      fields: at least t, id, x, y.
      max_gap_s: a road user unseen for longer is another fragment.

    Raises:
      InputError: unreadable text, a cell that is no finite number, or more
        than MAX_BLOCKS minutes.
    """
    with tempfile.TemporaryDirectory(prefix="rcirl-") as folder:
        spill = _Spill(path, fields, Path(folder))
        with reading(path, [path]) as show:
            for batch in _batches(path, fields):  # one per READ_BYTES of text
                spill.add(batch)
                show(READ_BYTES)
        yield from spill.pieces(max_gap_s)


def _batches(path: Path, fields: list[Field]) -> Iterator[dict[str, np.ndarray]]:
    """Columns of a few MiB of the file; text as (codes, names) pairs."""
    try:
        arrow, csv = (importlib.import_module(n) for n in ("pyarrow", "pyarrow.csv"))
    except ImportError as error:
        raise InputError(
            f"{path}: pyarrow: not installed: expected the extra rcirl-jax[logs]"
        ) from error
    kinds = {f.column: arrow.string() if f.text else arrow.float64() for f in fields}
    names = read_header(path)
    try:
        reader = csv.open_csv(
            path,
            read_options=csv.ReadOptions(
                block_size=READ_BYTES, column_names=names, skip_rows=1
            ),
            convert_options=csv.ConvertOptions(
                column_types=kinds,
                include_columns=list(dict.fromkeys(f.column for f in fields)),
                strings_can_be_null=False,
            ),
        )
        start = 2
        for batch in reader:
            yield {f.name: _column(path, batch, f, start) for f in fields}
            start += batch.num_rows
    except arrow.ArrowException as error:
        raise InputError(
            f"{path}: {str(error)[:200]}: expected rows as the header says"
        ) from error


def _column(path: Path, batch: Any, field: Field, start: int) -> Any:  # noqa: ANN401
    found = batch.column(field.column)
    if field.text:
        coded = found.dictionary_encode()
        return coded.indices.to_numpy(), coded.dictionary.to_pylist()
    values = found.to_numpy(zero_copy_only=False)
    # NaN compares false
    bad = np.flatnonzero(~(np.isfinite(values) & (np.abs(values) <= field.limit)))
    if bad.size:
        raise InputError(
            f"{path}: line {start + bad[0]}: {field.column}: {values[bad[0]]}: "
            f"expected a finite number within {field.limit:g}"
        )
    return values * field.factor


class _Spill:
    """Rows by recording and minute in scratch files of float64."""

    def __init__(self, path: Path, fields: list[Field], folder: Path) -> None:
        self.path, self.folder = path, folder
        self.names = [field.name for field in fields]
        self.texts = {field.name: {} for field in fields if field.text}
        self.blocks: dict[tuple[int, int], None] = {}
        self.buffers: dict[tuple[int, int], list[np.ndarray]] = {}
        self.held = 0  # bytes in the buffers

    def add(self, batch: dict) -> None:
        """Sort a batch's rows into their minutes."""
        columns = [self._numbers(name, batch[name]) for name in self.names]
        rows = np.stack(columns, axis=1)
        t = rows[:, self.names.index("t")]
        recording = np.zeros(len(rows), np.int64)
        if "recording" in self.names:
            recording = rows[:, self.names.index("recording")].astype(np.int64)
        minute = np.floor(t / BLOCK_S).astype(np.int64)
        order = np.lexsort((minute, recording))  # stable: the file's order inside
        keys = np.stack([recording, minute], axis=1)[order]
        changes = np.flatnonzero(np.any(np.diff(keys, axis=0), axis=1)) + 1
        for part in np.split(order, changes):
            key = (int(recording[part[0]]), int(minute[part[0]]))
            self.blocks[key] = None
            self.buffers.setdefault(key, []).append(rows[part])
        if len(self.blocks) > MAX_BLOCKS:
            raise InputError(
                f"{self.path}: t: more than {MAX_BLOCKS} minutes: expected seconds; "
                "wrong unit of time?"
            )
        self.held += rows.nbytes
        if self.held > BUFFER_BYTES:
            self._flush()

    def _numbers(self, name: str, column: Any) -> np.ndarray:  # noqa: ANN401
        """A column as float64; texts as their numbers in order of appearance."""
        if name not in self.texts:
            return column
        codes, texts = column
        known = self.texts[name]
        mine = [known.setdefault(text.strip(), len(known)) for text in texts]
        return np.array(mine, np.float64)[codes]

    def _flush(self) -> None:
        for (recording, minute), rows in self.buffers.items():
            with (self.folder / f"{recording}_{minute}").open("ab") as file:
                for part in rows:
                    file.write(np.ascontiguousarray(part).tobytes())
        self.buffers, self.held = {}, 0

    def _rows(self, recording: int, minute: int) -> np.ndarray:
        if (recording, minute) not in self.blocks:
            return np.zeros((0, len(self.names)))
        raw = np.fromfile(self.folder / f"{recording}_{minute}", np.float64)
        return raw.reshape(-1, len(self.names))

    def _fragments(self, max_gap_s: float) -> dict[tuple[int, int], list[float]]:
        """(recording, id) -> times [s] at which it is first seen, or again."""
        found: dict[tuple[int, int], list[float]] = {}
        last: dict[tuple[int, int], float] = {}
        t, user = self.names.index("t"), self.names.index("id")
        for recording, minute in sorted(self.blocks):
            rows = self._rows(recording, minute)[:, [user, t]]
            rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
            same = np.diff(rows[:, 0]) == 0.0
            later = same & (np.diff(rows[:, 1]) > max_gap_s)
            starts = np.flatnonzero(np.concatenate([[True], ~same | later]))
            ends = np.concatenate([starts[1:] - 1, [len(rows) - 1]])
            for low, high in zip(starts.tolist(), ends.tolist(), strict=True):
                key = (recording, int(rows[low, 0]))
                begin = float(rows[low, 1])
                if begin - last.get(key, -np.inf) > max_gap_s:
                    found.setdefault(key, []).append(begin)
                last[key] = float(rows[high, 1])
        return found

    def pieces(self, max_gap_s: float) -> Iterator[Piece]:
        """Every minute with its surroundings."""
        self._flush()
        names = {key: list(table) for key, table in self.texts.items()}
        t, user = self.names.index("t"), self.names.index("id")
        fragments = self._fragments(max_gap_s)
        begin: dict[int, float] = {}
        for (recording, _), (seen, *_) in fragments.items():
            begin[recording] = min(seen, begin.get(recording, np.inf))
        for done, (recording, minute) in enumerate(sorted(self.blocks), start=1):
            low, high = minute * BLOCK_S, (minute + 1) * BLOCK_S
            near = [self._rows(recording, minute + k) for k in (-1, 0, 1)]
            rows = np.concatenate(near)
            rows = rows[(rows[:, t] >= low - BEFORE_S) & (rows[:, t] < high + AFTER_S)]
            start = begin[recording]
            values: dict[str, np.ndarray] = {}
            for place, name in enumerate(self.names):
                column = rows[:, place]
                if name in names:
                    column = np.array(names[name])[column.astype(np.int64)]
                values[name] = column
            values["t"] = values["t"] - start
            named = values.pop("recording", None)
            yield Piece(
                recording=None if named is None else names["recording"][recording],
                number=minute - int(np.floor(start / BLOCK_S)),
                values=values,
                within=(low - start, high - start),
                fragments={
                    names["id"][u]: [s - start for s in fragments[recording, u]]
                    for u in np.unique(rows[:, user]).astype(int).tolist()
                },
                progress=done / len(self.blocks),
            )
