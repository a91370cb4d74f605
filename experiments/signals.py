"""The flag that says which written traffic lights an import uses."""

from collections.abc import Sequence
from pathlib import Path

from absl import flags

from rcirl_jax.data.parts import Part
from rcirl_jax.data.scenes.signal_checks import (
    SignalChecks,
    read_signal_checks,
    signal_checks,
)
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.labels.logs import check_written
from rcirl_jax.evaluation.labels.signals import format_phases
from rcirl_jax.runtime.executors import Executor
from rcirl_jax.runtime.pipeline import file_sha256

POOLED = "pooled"
_SIGNALS = flags.DEFINE_string(
    "signals",
    None,
    f"verdicts over all files on their written lights: {POOLED} (the drivers of "
    "--input are asked first), or the labels.json of label_check --input",
)


def signals_asked() -> str:
    """What the flag asks for, to tell one import from another; "" for nothing."""
    asked = _SIGNALS.value or ""
    if asked in ("", POOLED):
        return asked
    try:
        return file_sha256(Path(asked))
    except OSError as error:
        raise InputError(f"--signals: {asked}: {error.strerror}") from error


def checked_signals(parts: Sequence[Part], executor: Executor) -> SignalChecks | None:
    """The verdicts that the flag asks for; None: each file judges its own lights."""
    if _SIGNALS.value is None:
        return None
    if _SIGNALS.value != POOLED:
        return read_signal_checks(_SIGNALS.value)
    phases = check_written(parts, executor=executor)
    print(format_phases(phases))
    return signal_checks({check.name: check.verdict for check in phases})
