"""How recorded drives are cut out, and why some are not."""

import dataclasses

from rcirl_jax.errors import InputError

REASONS = {
    "too_short": "less than the minimum duration on the mapped lanes",
    "off_map": "the car is never on a lane",
    "standing": "the car gets less far than the minimum progress",
    "not_human": "an automation drives for a time, or nobody knows who does",
    "too_noisy": "accelerations no car can do remain after smoothing",
    "overlapping_boxes": "the human's box overlaps another's in the log",
    "follows_missing_car": "the leader is missing from the file",
    "irregular_light": "a light on the way has no cycle",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordedConfig:
    """How drives are cut out; the drivers are the medians of the IDM population."""

    smoothing_s: float = 4.1  # s, Savitzky-Golay window on positions; 0: none
    min_duration_s: float = 6.0  # s, shorter drives are left out
    max_duration_s: float = 120.0  # s, longer drives are cut
    # steps of the replay tables; None: the longest drive, rounded up to 5 s
    steps: int | None = None
    min_progress_m: float = 10.0  # m, a human who stands shows nothing
    max_cases: int | None = None  # at most so many cases, in the order found
    drop_overlaps: bool = True  # leave out drives that touch another in the log
    turns_reactive: bool = True  # agents may leave the log for the IDM (Replay)
    # 1, desired speed = max(fastest recorded, this share of the speed limit)
    limit_share: float = 0.8
    headway: float = 1.4  # s, T
    standstill: float = 2.0  # m, s0
    acceleration: float = 1.4  # m/s^2, a
    braking: float = 2.0  # m/s^2, b
    delay: float = 0.4  # s, reaction delay

    def __post_init__(self) -> None:
        """Reject what cannot be meant."""
        if not 0.0 < self.min_duration_s <= self.max_duration_s:
            raise InputError(
                f"--min_duration_s: {self.min_duration_s}: expected more than 0 and "
                f"at most {self.max_duration_s}"
            )
        for name in ("steps", "max_cases"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InputError(f"--{name}: {value}: expected at least 1")
