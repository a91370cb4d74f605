"""Which scenes of a dataset are held out."""

from absl import flags

from rcirl_jax.cli.flags.common import alone
from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.data.store.resplit import HOLDOUTS, folds_by_recording, held_out
from rcirl_jax.errors import InputError

_HOLDOUT = flags.DEFINE_enum(
    "holdout", "groups", HOLDOUTS, "what is held out, see above"
)
_FOLDS = flags.DEFINE_integer(
    "folds",
    0,
    "instead: the recordings in so many parts, each held out once; 0: not",
    0,
)
_SPLIT = flags.DEFINE_integer(
    "split_seed", 0, "draws the vehicles of --holdout=vehicles or validation", 0
)
_RECORDING = flags.DEFINE_list(
    "recording", ["0"], "numbers of those of --holdout=recording, from 0"
)

# what each of the other flags is read by
_READ_BY = {"recording": ("recording",), "split_seed": ("vehicles", "validation")}


def splits(dataset: Demonstrations) -> tuple[list[Demonstrations], str]:
    """The dataset split as the flags say, once or by --folds, and that in words."""
    if _FOLDS.value:
        alone("folds", "holdout", "recording", "split_seed")
        words = f"{_FOLDS.value} parts of the recordings, each held out once"
        return list(folds_by_recording(dataset, _FOLDS.value)), words
    how = _HOLDOUT.value
    for name, holdouts in _READ_BY.items():
        if (flag := flags.FLAGS[name]).present and how not in holdouts:
            raise InputError(
                f"--{name}: {flag.value}: expected with --holdout="
                f"{' or '.join(holdouts)}, not {how}"
            )
    try:
        named = [int(number) for number in _RECORDING.value]
    except ValueError as error:
        raise InputError(f"--recording: {_RECORDING.value}: {error}") from error
    one, words = held_out(dataset, how, seed=_SPLIT.value, recordings=named)
    return [one], words
