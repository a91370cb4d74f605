r"""Imports recorded driving into a dataset of scenes.

    python -m experiments.import_logs --input=LOGS --output=DATASET \
        --flagfile=experiments/flagfiles/paper_import.flags

The same as `rcirl import`, which also writes the TOML of a table (`--suggest`) and has
the flags for large releases.
"""

from pathlib import Path

from absl import flags

import rcirl_jax
from rcirl_jax.cli.running import run
from rcirl_jax.data.formats import IMPORTERS
from rcirl_jax.data.quality import format_quality, format_splits
from rcirl_jax.runtime.executors import make_executor

_INPUT = flags.DEFINE_string("input", None, "file or folder of logs", required=True)
_OUTPUT = flags.DEFINE_string("output", None, "dataset to write", required=True)
_FORMAT = flags.DEFINE_enum(
    "format", None, sorted(IMPORTERS), "of the logs, where it is not recognised"
)
_SOURCE = flags.DEFINE_string("source", None, "TOML that maps columns and units")
_STRIDE = flags.DEFINE_float("stride", 0.5, "s between two scenes of a driver")
_OBSTACLES = flags.DEFINE_bool("require_obstacles", True, "drop scenes without any")
_SPEED_CHANGE = flags.DEFINE_bool(
    "require_speed_change", True, "drop scenes without a change of speed"
)
_TEST = flags.DEFINE_float("test_fraction", 0.25, "share of scenes held out")
_OVERWRITE = flags.DEFINE_bool("overwrite", False, "replace a finished dataset")
_WORKERS = flags.DEFINE_integer("workers", 1, "processes at once")


def main() -> None:
    """Imports, and prints what was kept and dropped."""
    dataset = rcirl_jax.import_logs(
        Path(_INPUT.value),
        _OUTPUT.value,
        format=_FORMAT.value,
        source=_SOURCE.value,
        test_fraction=_TEST.value,
        overwrite=_OVERWRITE.value,
        executor=make_executor("local", workers=_WORKERS.value),
        stride_s=_STRIDE.value,
        require_obstacles=_OBSTACLES.value,
        require_speed_change=_SPEED_CHANGE.value,
    )
    print(format_quality(dataset.manifest.quality))
    print(format_splits(dataset))
    print(f"dataset: {_OUTPUT.value}")


if __name__ == "__main__":
    run(main)
