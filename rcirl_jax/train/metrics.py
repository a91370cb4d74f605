"""Where training writes what it sees: JSON lines, TensorBoard, a progress bar."""

import json
import math
import time
from pathlib import Path
from types import TracebackType
from typing import Any

import tqdm

from rcirl_jax.whole import write_whole


class MetricsWriter:
    """Appends one JSON object a line to metrics.jsonl, and to TensorBoard.

    TensorBoard files are written when `tensorboardX` is installed (extra
    `report`). On resume, lines at or after the resumed step are dropped first,
    so that a killed run leaves no step twice.
    """

    def __init__(self, folder: Path, resume_step: int = 0) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / "metrics.jsonl"
        kept = []
        if self._path.exists() and resume_step > 0:
            kept = [
                line
                for line in self._path.read_text().splitlines()
                if _step_of(line) <= resume_step
            ]
        write_whole(self._path, "".join(line + "\n" for line in kept))
        self._file = self._path.open("a", buffering=1)
        self._board = _tensorboard(folder / "tensorboard", resume_step)

    def write(self, step: int, values: dict[str, float]) -> None:
        """One line of finite scalars at a step (others are written as null)."""
        clean = {k: (v if math.isfinite(v) else None) for k, v in values.items()}
        self._file.write(json.dumps({"step": step, **clean}) + "\n")
        if self._board is not None:
            for name, number in values.items():
                self._board.add_scalar(name, number, step)

    def close(self) -> None:
        """Flush and close both files."""
        self._file.close()
        if self._board is not None:
            self._board.close()


def _step_of(line: str) -> int:
    try:
        return int(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError):
        return 1 << 62  # a line cut short by a crash is dropped


def _tensorboard(folder: Path, purge_step: int) -> Any:  # noqa: ANN401
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder), purge_step=purge_step or None)


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

    def __enter__(self) -> "Progress":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.close()
