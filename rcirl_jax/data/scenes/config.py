"""How scenes are cut out of recordings."""

import dataclasses

from rcirl_jax.data.scenes.signal_checks import SignalChecks
from rcirl_jax.errors import InputError
from rcirl_jax.units import HORIZON_S

SHORTEST_S = 1.0  # s of mask; derivatives need three points of the time axis


@dataclasses.dataclass(frozen=True, kw_only=True)
class CollectConfig:
    """How scenes are cut out of recordings."""

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
