"""Importing: which scenes are kept of the logs, and how they are held out."""

import dataclasses
from collections.abc import Callable

from absl import flags

from rcirl_jax.cli.flags.help import AS_SAID
from rcirl_jax.data.importing import ImportConfig
from rcirl_jax.errors import InputError

NUMBERS = (
    (
        "stride",
        "stride_s",
        "s between scenes of a driver, above 0; longer: fewer and less alike",
    ),
    ("min_future", "min_future_s", "s of recording a scene needs"),
    ("min_history", "min_history_s", "s of recording before a planning frame"),
    (
        "min_surroundings",
        "min_surroundings_s",
        "s until someone whom the human reacts to leaves the record, at least",
    ),
    ("min_life", "min_life_s", "s, shorter tracks do not become obstacles"),
    ("min_size", "min_size_m", "m, nor do bodies whose longer side is below it"),
    (
        "join_gap",
        "join_gap_s",
        "s between fragments of one standing body that are joined, at most",
    ),
    ("smoothing", "smoothing_s", "s, window of the position filter"),
)
FILTERS = (
    ("keep_steady", "require_speed_change", "speed change"),
    ("keep_free_road", "require_obstacles", "obstacles"),
)


def import_flags() -> Callable[[ImportConfig], ImportConfig]:
    """Define the flags; returns what applies those given to a config."""
    numbers = {
        field: flags.DEFINE_float(name, None, help_ + AS_SAID)
        for name, field, help_ in NUMBERS
    }
    filters = {
        field: flags.DEFINE_bool(
            name, None, f"keep scenes without {what} (the paper drops them){AS_SAID}"
        )
        for name, field, what in FILTERS
    }
    fraction = flags.DEFINE_float(
        "test_fraction",
        0.25,
        "share of scenes held out to judge by, of other vehicles, 0 to below 1; 0: to "
        "train only",
    )
    seed = flags.DEFINE_integer("split_seed", 0, "order in which groups are dealt")
    leave_out = flags.DEFINE_string(
        "leave_out",
        "0",
        "recordings that may be refused, for large releases: a count such as 3, or 5%",
    )

    def applied(config: ImportConfig) -> ImportConfig:
        given = {n: f.value for n, f in numbers.items() if f.value is not None}
        given |= {n: not f.value for n, f in filters.items() if f.value is not None}
        count, share = left_out(leave_out.value)
        return dataclasses.replace(
            config,
            collect=dataclasses.replace(config.collect, **given),
            test_fraction=fraction.value,
            split_seed=seed.value,
            leave_out=count,
            leave_out_share=share,
        )

    return applied


def left_out(text: str) -> tuple[int, float]:
    """A count, or a share of all recordings, of --leave_out.

    Raises:
      InputError: neither "3" nor "5%".
    """
    number = text.strip().removesuffix("%")
    try:
        if number == text.strip():
            count = int(number)
            if count >= 0:
                return count, 0.0
        elif 0.0 <= (share := float(number) / 100.0) < 1.0:
            return 0, share
    except ValueError:
        pass
    raise InputError(f"--leave_out: {text}: expected a count such as 3, or 5%")
