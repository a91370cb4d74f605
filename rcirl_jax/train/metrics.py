"""Where training writes what it sees: JSON lines, TensorBoard, a progress bar."""

import contextlib
import json
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import tqdm

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import named, parse_json, write_whole

MAX_STEP = 2**63 - 1  # what 64 bits hold


class MetricsWriter:
    """Appends one JSON object a line to metrics.jsonl, and to TensorBoard.

    TensorBoard files are written when `tensorboardX` is installed (extra
    `report`). On resume, lines after the resumed step are dropped first (the file
    is replaced whole), so that a killed run leaves no step twice.
    """

    def __init__(self, folder: Path, resume_step: int = 0) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / "metrics.jsonl"
        kept = []
        if self._path.exists() and resume_step > 0:
            rows = read_metrics(self._path)
            kept = [json.dumps(row) for row in rows if row["step"] <= resume_step]
        write_whole(self._path, "".join(line + "\n" for line in kept))
        self._file = self._path.open("a", buffering=1)
        self._board = _tensorboard(folder / "tensorboard", resume_step)

    def write(self, step: int, values: dict[str, float]) -> None:
        """One line of finite scalars at a step (others are written as null).

        Raises:
          OSError: one of the files cannot be written; names it.
        """
        clean = {k: (v if math.isfinite(v) else None) for k, v in values.items()}
        try:
            self._file.write(json.dumps({"step": step, **clean}) + "\n")
        except OSError as error:
            raise named(error, self._path) from error
        if self._board is not None:
            self._board.write(step, values)

    def close(self) -> None:
        """Flush and close both files."""
        with contextlib.suppress(OSError):  # said by `write`, if it was not
            self._file.close()
        if self._board is not None:
            self._board.close()


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """The whole lines of a metrics.jsonl, none where there is no file.

    A line that a crash or a full disk cut short is left out, and so is one without a
    step; values that are neither numbers nor null are left out of theirs.
    """
    rows = []
    if not path.is_file():
        return rows
    with path.open(errors="replace") as file:
        for line in file:
            with contextlib.suppress(ValueError):
                found = parse_json(line)
                step = found.get("step") if isinstance(found, dict) else None
                if type(step) is int and abs(step) <= MAX_STEP:
                    rows.append({k: v for k, v in found.items() if _is_number(v)})
    return rows


def pairs_won(path: Path, steps: int) -> float:
    """Share of the pairs that the positive won over the last `steps` steps, 0 to 1.

    Raises:
      InputError: fewer whole lines with both numbers.
    """
    rows = [(row.get("pair_accuracy"), row.get("pairs")) for row in read_metrics(path)]
    whole = [(a, n) for a, n in rows[-steps:] if a is not None and n is not None]
    if len(whole) != steps:
        raise InputError(
            f"{path}: {len(whole)} whole lines at its end: expected {steps}, the last "
            "epoch; remove the folder to train again"
        )
    won = sum(share * pairs for share, pairs in whole)
    return won / max(sum(pairs for _, pairs in whole), 1.0)


def _is_number(value: Any) -> bool:  # noqa: ANN401
    return value is None or (type(value) in {int, float} and abs(value) < 1e300)


def _tensorboard(folder: Path, purge_step: int) -> "_Board | None":
    try:
        return _Board(folder, purge_step)
    except ImportError:
        return None


class _Board:
    """A TensorBoard file, written by the caller's own thread.

    tensorboardX' own writer hands events to a thread: on a full disk that thread
    dies, and the training waits for it for ever.
    """

    FLUSH_S = 10.0  # s between two flushes

    def __init__(self, folder: Path, purge_step: int) -> None:
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto import event_pb2
        from tensorboardX.summary import scalar

        self._made: Any = event_pb2  # its classes are made as it is loaded
        self._folder, self._scalar = folder, scalar
        folder.mkdir(parents=True, exist_ok=True)
        # its name has seconds only: two runs in one of them must not share a file
        own = f".{os.getpid()}.{len(list(folder.iterdir()))}"
        self._file = EventsWriter(str(folder / "events"), own)
        self._flushed = time.monotonic()
        if purge_step:
            start = self._made.SessionLog(status=self._made.SessionLog.START)
            self._add(self._made.Event(step=purge_step, session_log=start))

    def write(self, step: int, values: dict[str, float]) -> None:
        for name, number in values.items():
            made = {"step": step, "summary": self._scalar(name, number)}
            self._add(self._made.Event(wall_time=time.time(), **made))
        if time.monotonic() - self._flushed > self.FLUSH_S:
            self._flushed = time.monotonic()
            self._do(self._file.flush)

    def _add(self, event: object) -> None:
        self._do(lambda: self._file.write_event(event))

    def _do(self, write: Callable[[], object]) -> None:
        try:
            write()
        except OSError as error:
            raise named(error, self._folder) from error

    def close(self) -> None:
        with contextlib.suppress(OSError):  # of pictures only
            self._file.close()
        with contextlib.suppress(OSError):  # which the first leaves open if it fails
            self._file._py_recordio_writer.close()


class Progress:
    """A progress bar with queries/s and ETA on stderr."""

    def __init__(
        self, total: int, start: int, label: str, *, shown: bool = True
    ) -> None:
        self._bar = tqdm.tqdm(
            total=total,
            initial=start,
            desc=label,
            unit="step",
            mininterval=0.5,
            disable=not shown,
        )
        self._since = time.perf_counter()
        self._queries = 0.0

    def advance(self, queries: float, **shown: float) -> None:
        """One step with so many pairs compared; `shown` values are printed."""
        self._queries += queries
        elapsed = max(time.perf_counter() - self._since, 1e-9)
        rate = self._queries / elapsed
        text = {name: f"{number:.4g}" for name, number in shown.items()}
        self._bar.set_postfix({"queries/s": f"{rate:,.0f}", **text}, refresh=False)
        self._bar.update()

    @property
    def queries(self) -> float:
        """Pairs compared so far in this process."""
        return self._queries

    @property
    def seconds(self) -> float:
        """Wall time since the bar was made."""
        return time.perf_counter() - self._since

    def close(self) -> None:
        """Leave the bar as it is."""
        self._bar.close()
