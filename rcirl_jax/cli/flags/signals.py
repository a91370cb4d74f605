"""Traffic lights: which written ones an import uses."""

from collections.abc import Sequence

from absl import flags

from rcirl_jax.data.parts import Part
from rcirl_jax.data.scenes.signal_checks import SignalChecks, signal_checks
from rcirl_jax.data.scenes.signal_phases import check_written, format_phases
from rcirl_jax.runtime.executors import Executor

POOLED = "pooled"
_SIGNALS = flags.DEFINE_enum(
    "signals", None, [POOLED], "ask the drivers of all files about the written lights"
)


def signals_asked() -> str:
    """What the flag asks for, to tell one import from another; "" for nothing."""
    return _SIGNALS.value or ""


def checked_signals(parts: Sequence[Part], executor: Executor) -> SignalChecks | None:
    """The verdicts that the flag asks for; None: each file judges its own lights."""
    if _SIGNALS.value is None:
        return None
    phases = check_written(parts, executor=executor)
    print(format_phases(phases))
    return signal_checks({check.name: check.verdict for check in phases})
