"""Recorded drives as cases: the ego follows a human's path among the logged others.

Every suitable vehicle track of a `Recording` becomes one `Case` with a replay.
Positions are smoothed as for training data (`data.scenes.smoothing`), projected into
the frame of the lanes that the driver follows (`data.scenes.lanes`) and read on the
simulator's 0.1 s clock, linearly between samples. Station 0 is the ego's centre
at its first time on a lane. What is not suitable is counted by reason.
"""

import collections
from collections.abc import Iterable, Iterator

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.simulation.cases import (
    STEP_S,
    Case,
)
from rcirl_jax.simulation.recorded.config import RecordedConfig
from rcirl_jax.simulation.recorded.drive import Cutter, Drive
from rcirl_jax.types import Kind, Recording

ROUND_STEPS = 50  # steps; tables end at whole 5 s, so that plan_every divides


def recorded_cases(
    recordings: Iterable[Recording],
    config: RecordedConfig,
    dropped: collections.Counter[str] | None = None,
) -> tuple[Case, tuple[str, ...]]:
    """Every suitable recorded drive as a case.

    Args:
      recordings: from `data.importers.read_recordings`.
      config: how drives are cut.
      dropped: counts what was left out, by `REASONS`.

    Returns:
      (cases, ids): leaves with a leading [B]; ids "RECORDING:TRACK".

    Raises:
      InputError: no drive is suitable.
    """
    count = collections.Counter() if dropped is None else dropped
    found: list[Drive] = []
    for recording in recordings:
        for drive in drives(recording, config, count):
            found.append(drive)
            if len(found) == config.max_cases:
                break
        if len(found) == config.max_cases:
            break
    if not found:
        raise InputError(
            f"recordings: suitable drives: 0, left out {dict(count)}: "
            "expected at least one"
        )
    longest = max(int(drive.case.steps) for drive in found)
    steps = config.steps or -(-longest // ROUND_STEPS) * ROUND_STEPS
    cases = [_padded(drive.case, steps) for drive in found]
    stacked = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *cases)
    return stacked, tuple(drive.id for drive in found)


def drives(
    recording: Recording,
    config: RecordedConfig,
    dropped: collections.Counter[str] | None = None,
) -> Iterator[Drive]:
    """The suitable drives of one recording, one per human-driven vehicle."""
    cutter = Cutter(recording, config)
    for number, track in enumerate(recording.tracks):
        if track.kind != Kind.VEHICLE:
            continue
        drive = cutter.drive(number)
        if not isinstance(drive, str):
            yield drive
        elif dropped is not None:
            dropped[drive] += 1


def _padded(case: Case, steps: int) -> Case:
    """Replay tables of length `steps + 1`; nobody is present in the padding.

    There the human goes on at the last speed and offset: no step holds a jump.
    """
    assert case.replay is not None
    last = min(int(case.steps), steps)
    index = np.arange(steps + 1)
    beyond = np.maximum(index - last, 0) * STEP_S
    cut = lambda x: np.asarray(x)[..., np.minimum(index, last)] if np.ndim(x) else x  # noqa: E731
    replay = jax.tree.map(cut, case.replay)
    replay = replay.replace(
        present=replay.present & (beyond == 0.0),
        ego_s=(replay.ego_s + replay.ego_v * beyond).astype(np.float32),
    )
    return case.replace(replay=replay, steps=np.int32(last))
