"""The flag of the trackers of training."""

from absl import flags

from rcirl_jax.train.trackers import TRACKERS

_TRACKERS = flags.DEFINE_list(
    "trackers",
    None,
    f"some of {', '.join(TRACKERS)}, or empty; default: tensorboard, if installed",
)


def trackers() -> tuple[str, ...] | None:
    """Names given, None where none were."""
    return None if _TRACKERS.value is None else tuple(_TRACKERS.value)
