"""Settings: how scenes are cut out of recordings, which written lights are used."""

import dataclasses
from collections.abc import Iterable, Mapping

from rcirl_jax.errors import InputError
from rcirl_jax.types import Recording
from rcirl_jax.units import HORIZON_S

SHORTEST_S = 1.0  # s of mask; derivatives need three points of the time axis
TOGETHER = "all together"  # the check of all signals as one
CONFIRMED, REJECTED = "confirmed", "rejected"
OPEN = ("not contradicted", "too few crossings")  # alone; the others may speak for it


@dataclasses.dataclass(frozen=True, kw_only=True)
class SignalChecks:
    """Names of lines (`line_name`) whose written lights the drivers judged.

    One short file cannot confirm a cycle; `signal_phases` pools the crossings and
    stands of all files of a place, and an import then uses the lights of the lines that
    they bear out.
    """

    used: tuple[str, ...]
    unused: tuple[str, ...]

    def of_signals(self, recording: Recording) -> dict[str, bool]:
        """Return whether to use each signal that a judged line of the recording has.

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
    """Return which lines' lights to use, by the verdicts on lines and on all together.

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


@dataclasses.dataclass(frozen=True, kw_only=True)
class CollectConfig:
    """The settings by which scenes are cut out of recordings."""

    # s, window of the Savitzky-Golay filter on positions
    smoothing_s: float = 4.1
    # s between planning frames of one driver
    stride_s: float = 0.5
    # s of recording before a planning frame
    min_history_s: float = 0.5
    # s of recording after it (5 s and one more point of the time axis)
    min_future_s: float = 5.2
    # s, at least, until someone whom the human reacts to leaves the record: a scene
    # that is shorter then is dropped, others end there
    min_surroundings_s: float = 3.0
    # s, shorter tracks are no obstacles: perception that flickers
    min_life_s: float = 1.0
    # m, nor are bodies whose longer side is below it
    min_size_m: float = 0.2
    # s between two fragments of one standing body that are joined
    join_gap_s: float = 5.0
    # the paper's two filters
    require_obstacles: bool = True
    require_speed_change: bool = True
    # lines whose lights many files bear out, or refute; before all other rules
    signal_checks: SignalChecks | None = None

    def __post_init__(self) -> None:
        """Reject what cannot be meant."""
        if not 0.0 < self.min_future_s <= HORIZON_S:
            raise InputError(f"min_future_s: {self.min_future_s}: expected (0, 8]")
        if not SHORTEST_S <= self.min_surroundings_s <= HORIZON_S:
            raise InputError(
                f"min_surroundings_s: {self.min_surroundings_s}: expected [1, 8]"
            )
        for name in ("min_life_s", "min_size_m", "join_gap_s"):
            if not getattr(self, name) >= 0.0:
                raise InputError(f"{name}: {getattr(self, name)}: expected >= 0")
        if self.stride_s <= 0.0:
            raise InputError(f"stride_s: {self.stride_s}: expected > 0")
