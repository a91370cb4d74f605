"""The flags that say which scenes of a dataset are held out."""

from absl import flags

from rcirl_jax.data.joined import Demonstrations
from rcirl_jax.data.resplit import HOLDOUTS, held_out
from rcirl_jax.errors import InputError

_HOLDOUT = flags.DEFINE_enum("holdout", "groups", HOLDOUTS, "what is held out")
_SPLIT = flags.DEFINE_integer("split_seed", 0, "draws the vehicles held out", 0)
_RECORDING = flags.DEFINE_list("recording", ["0"], "numbers of those held out")


def split(dataset: Demonstrations) -> tuple[Demonstrations, str]:
    """The dataset split as the flags say, and that in words."""
    try:
        named = [int(number) for number in _RECORDING.value]
    except ValueError as error:
        raise InputError(f"--recording: {_RECORDING.value}: {error}") from error
    return held_out(dataset, _HOLDOUT.value, seed=_SPLIT.value, recordings=named)
