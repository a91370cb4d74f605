"""Make a dataset by letting a driver model drive the scenario catalogue.

    python -m experiments.drive_logs --output=DATASET [--cases=30 --catalogue_seed=1000]

For families of road that nobody has recorded. The cases are of another seed
than those of experiments.simulate, so a reward is never tested where it learned.

    python -m experiments.drive_logs --learner=weights.msgpack --output=DATASET

The learner and the driver take turns; what the driver does after a takeover is
kept. Train on both sets: experiments.train --data=FIRST,TAKEOVERS. Commit, versions,
flags and the learner's hash stand in DATASET/made_by.json.
"""

from absl import flags

from experiments.common import made_by_file, run
from rcirl_jax.data.scenes.quality import format_quality
from rcirl_jax.errors import InputError
from rcirl_jax.export.closed_loop import table_rows
from rcirl_jax.simulation.cases import STEP_S
from rcirl_jax.simulation.demonstrations import DriveConfig, drive_catalogue
from rcirl_jax.simulation.suite import suite_refs

_OUTPUT = flags.DEFINE_string("output", None, "dataset to write", required=True)
_SUITE = flags.DEFINE_string("suite", "full", "full, or family names with commas")
_CASES = flags.DEFINE_integer("cases", 30, "cases of each family")
_SEED = flags.DEFINE_integer(
    "catalogue_seed", 1000, "seed of the cases; 0 is the suite's and refused"
)
_STRIDE = flags.DEFINE_float("stride", 3.0, "s between scenes of a drive")
_DURATION = flags.DEFINE_float("duration", 120.0, "s of a drive")
_LEARNER = flags.DEFINE_string("learner", None, "weights with which to take turns")
_OVERWRITE = flags.DEFINE_bool("overwrite", False, "replace a finished dataset")


def main() -> None:
    """Flags -> one dataset."""
    if _SEED.value == 0:
        raise InputError("--catalogue_seed: 0: expected another than the suite's")
    if not 0.5 <= _STRIDE.value <= 60.0:
        raise InputError(f"--stride: {_STRIDE.value}: expected 0.5 to 60 s")
    if not 15.0 <= _DURATION.value <= 120.0:
        raise InputError(f"--duration: {_DURATION.value}: expected 15 to 120 s")
    config = DriveConfig(stride_s=_STRIDE.value, duration_s=_DURATION.value)
    refs = suite_refs(_SUITE.value, _CASES.value, _SEED.value)
    files, learner = [_LEARNER.value] if _LEARNER.value else [], None
    if files:
        row = table_rows(files, (), round(config.period_s / STEP_S))[0]
        learner = row.policy, row.params
    manifest = drive_catalogue(
        refs,
        _OUTPUT.value,
        config,
        learner=learner,
        overwrite=_OVERWRITE.value,
        before_commit=made_by_file(files),
    )
    print(format_quality(manifest.quality))
    print(f"dataset: {_OUTPUT.value}")


if __name__ == "__main__":
    run(main)
