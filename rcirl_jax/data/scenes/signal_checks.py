"""What drivers, over many files, say of written traffic lights.

One short file cannot confirm a cycle; `signal_phases` pools the crossings and stands
of all files of a place, and an import then uses the lights of the lines that they bear
out.
"""

import dataclasses
from collections.abc import Iterable, Mapping

from rcirl_jax.types import Recording

TOGETHER = "all together"  # the check of all signals as one
CONFIRMED, REJECTED = "confirmed", "rejected"
OPEN = ("not contradicted", "too few crossings")  # alone; the others may speak for it


@dataclasses.dataclass(frozen=True, kw_only=True)
class SignalChecks:
    """Names of lines (`line_name`) whose written lights the drivers judged."""

    used: tuple[str, ...]
    unused: tuple[str, ...]

    def of_signals(self, recording: Recording) -> dict[str, bool]:
        """Whether to use each signal that a judged line of the recording has.

        Of two lines with one light the one that confirms it counts.
        """
        known = {signal.id for signal in recording.signals}
        found: dict[str, bool] = {}
        for lane in recording.lanes:
            names = [name for name in lane.signal_ids if name in known]
            line = line_name(recording.name, names)
            if line in (*self.used, *self.unused):
                for name in names:
                    found[name] = line in self.used or found.get(name, False)
        return found


def place_of(recording: str) -> str:
    """USA_Lanker-2_26_T-1 -> USA_Lanker-2; other names as they are."""
    parts = recording.split("_")
    return "_".join(parts[:2]) if len(parts) >= 4 else recording


def line_name(recording: str, signal_ids: Iterable[str]) -> str:
    """One name of a stop line in all files of a place: PLACE/ID or PLACE/ID+ID."""
    return f"{place_of(recording)}/{'+'.join(sorted(signal_ids))}"


def signal_checks(verdicts: Mapping[str, str]) -> SignalChecks:
    """Which lines' lights to use, by the verdicts on lines and on all together.

    Used are the confirmed lines and, where all files together are confirmed, those
    that nothing speaks against. A rejected line is never used.
    """
    lines = {name: word for name, word in verdicts.items() if name != TOGETHER}
    together = verdicts.get(TOGETHER) == CONFIRMED
    good = (CONFIRMED, *OPEN) if together else (CONFIRMED,)
    return SignalChecks(
        used=tuple(sorted(name for name, word in lines.items() if word in good)),
        unused=tuple(sorted(name for name, word in lines.items() if word == REJECTED)),
    )
