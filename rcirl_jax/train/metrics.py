"""Output of training: JSON lines, trackers, a progress bar."""

import contextlib
import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jax.typing import ArrayLike

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import named, parse_json, write_whole
from rcirl_jax.runtime.compiling import CompilesFirst
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.train.step import StepMetrics
from rcirl_jax.train.trackers import Writer, settings_of, time_weights, trackers

MAX_STEP = 2**63 - 1  # what 64 bits hold
PLATEAU_STEPS = 100  # fewer do not show whether the loss still falls
PLATEAU = 0.05  # share of the loss's whole fall that its last fifth may be


class MetricsWriter:
    """Appends one JSON object a line to metrics.jsonl, and tells the trackers.

    On resume, lines after the resumed step are dropped first (the file is replaced
    whole), so that a killed run leaves no step twice.
    """

    def __init__(
        self, folder: Path, resume_step: int = 0, trackers: Sequence[Writer] = ()
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / "metrics.jsonl"
        kept = []
        if self._path.exists() and resume_step > 0:
            rows = read_metrics(self._path)
            kept = [json.dumps(row) for row in rows if row["step"] <= resume_step]
        write_whole(self._path, "".join(line + "\n" for line in kept))
        self._file = self._path.open("a", buffering=1)
        self._trackers = trackers

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
        for tracker in self._trackers:
            tracker.scalars(step, values)

    def close(self) -> None:
        """Flush and close the file and the trackers."""
        with contextlib.suppress(OSError):  # said by `write`, if it was not
            self._file.close()
        for tracker in self._trackers:
            tracker.close()


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


def plateau_warning(losses: ArrayLike) -> str:
    """Says that a training ended before a plateau, or too early to tell; else "".

    With a, b and c the mean losses of the first tenth of the steps, of the fourth fifth
    and of the last fifth, and s the standard error of b - c from the spread within the
    two fifths, the loss still falls if

        b - c > PLATEAU (a - c)    and    b - c > 2 s

    A training whose loss decays as exp(-t / tau) is at a plateau after 4 tau.

    Args:
      losses: [n] of every step; one that is not finite does not count.
    """
    loss = np.asarray(losses, float)
    loss = loss[np.isfinite(loss)]
    count, fifth = loss.size, loss.size // 5
    if count < PLATEAU_STEPS:
        return (
            f"training: {count} steps do not show whether the loss still falls: "
            f"expected at least {PLATEAU_STEPS}"
        )
    before, last = loss[-2 * fifth : -fifth], loss[-fifth:]
    whole = float(loss[: count // 10].mean() - last.mean())
    fall = float(before.mean() - last.mean())
    if whole <= 0.0:
        return (
            f"training: the loss did not fall in {count} steps: "
            f"{loss[: count // 10].mean():.4g} at first, {last.mean():.4g} at last"
        )
    error = np.sqrt((before.var(ddof=1) + last.var(ddof=1)) / fifth)
    if fall <= PLATEAU * whole or fall <= 2.0 * error:
        return ""
    return (
        f"training ended before a plateau: {100.0 * fall / whole:.0f} % of the loss's "
        f"whole fall is in the last fifth of {count} steps (a plateau: at most "
        f"{100.0 * PLATEAU:g} %)"
    )


def _is_number(value: Any) -> bool:  # noqa: ANN401
    return value is None or (type(value) in {int, float} and abs(value) < 1e300)


class RunLog:
    """Writes a training's steps: metrics.jsonl, trackers, a bar with queries/s and ETA.

    Attributes:
      queries: pairs compared so far in this process.
    """

    def __init__(
        self,
        folder: Path,
        config: TrainConfig,
        resume_step: int,
        total: int,
        names: Sequence[str] | None,
        *,
        shown: bool,
    ) -> None:
        """Opens the files of a run.

        Args:
          folder: of the run.
          config: of the training, for the trackers.
          resume_step: last step that counts of those written before.
          total: steps of the whole training.
          names: of the trackers.
          shown: False in a process that writes nothing and shows no bar.
        """
        made = trackers(names, folder, resume_step) if shown else []
        for tracker in made:
            tracker.settings(settings_of(config))
        self._trackers = made
        self._writer = MetricsWriter(folder, resume_step, made) if shown else None
        self._bar = CompilesFirst(
            total=total,
            initial=resume_step,
            desc="train",
            unit="step",
            mininterval=0.5,
            disable=not shown,
        )
        self._since = time.perf_counter()
        self.queries = 0.0

    @property
    def seconds(self) -> float:
        """Wall time since the first step began."""
        return time.perf_counter() - self._since

    def step(self, step: int, metrics: StepMetrics) -> np.ndarray:
        """Writes a step; returns its sums: loss, terms, pairs won, pairs."""
        sums = (metrics.loss_sum, metrics.terms, metrics.wins, metrics.pairs)
        loss, terms, wins, pairs = counted = np.array([float(x) for x in sums])
        pairs = max(pairs, 1.0)
        self.queries += pairs
        rate = self.queries / max(self.seconds, 1e-9)
        shown = {"loss": loss / max(terms, 1.0), "pair_accuracy": wins / pairs}
        text = {name: f"{number:.4g}" for name, number in shown.items()}
        self._bar.set_postfix({"queries/s": f"{rate:,.0f}", **text}, refresh=False)
        self._bar.update()
        if self._writer is not None:
            norm = float(metrics.grad_norm)
            more = {"grad_norm": norm, "pairs": pairs, "queries_per_s": rate}
            self._writer.write(step, {**shown, **more})
        return counted

    def draw_time_weights(self, step: int, gamma: ArrayLike) -> None:
        """Gamma over time, for the trackers."""
        if self._trackers and (figure := time_weights(np.asarray(gamma))) is not None:
            for tracker in self._trackers:
                tracker.figure(step, "time weights", figure)

    def close(self) -> None:
        """Closes files and trackers; leaves the bar as it is."""
        if self._writer is not None:
            self._writer.close()
        self._bar.close()
