"""Import recorded driving into a dataset.

    python -m experiments.import_logs --format=commonroad --input=DIR --output=DATASET

Prints the data-quality report and writes it into DATASET/manifest.json; commit,
versions, flags and the oracle floor stand in DATASET/made_by.json. An interrupted
import resumes (SIGTERM ends with exit status 143, SIGINT with 130, a full disk with 2:
finished shards stay); bad input leaves nothing behind. Of large releases a few odd
recordings may be left out (--leave_out), counted and named in the report.
"""

from pathlib import Path

from absl import flags

from experiments.flags.common import cutting, made_by_file, run
from experiments.flags.executor import executor
from experiments.flags.signals import checked_signals
from rcirl_jax.data.importers import IMPORTERS
from rcirl_jax.data.importing import ImportConfig, import_parts
from rcirl_jax.data.parts import leaving_out, parts_of
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.scenes.quality import format_quality, format_splits
from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.evaluation.ranking.evaluate import RankingSetup, oracle_floor
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.sampling.config import MODES

_FORMAT = flags.DEFINE_enum(
    "format", "synthetic", sorted(IMPORTERS), "log format to read"
)
_INPUT = flags.DEFINE_string(
    "input", None, "file or folder (synthetic: a TOML of recordings)"
)
_SOURCE = flags.DEFINE_string(
    "source", None, "TOML that maps columns and units (default: data_specs/sources)"
)
_OUTPUT = flags.DEFINE_string("output", None, "dataset to write", required=True)
_OVERWRITE = flags.DEFINE_bool("overwrite", False, "replace a finished dataset")
_CUT = cutting(CollectConfig())
_MIN_FUTURE = flags.DEFINE_float("min_future", 5.2, "s of recording a scene needs")
_MIN_HISTORY = flags.DEFINE_float(
    "min_history", 0.5, "s of recording before a planning frame"
)
_MIN_SURROUNDINGS = flags.DEFINE_float(
    "min_surroundings",
    3.0,
    "s until someone whom the human reacts to leaves the record, at least",
)
_SMOOTHING = flags.DEFINE_float("smoothing", 4.1, "s, window of the position filter")
_TEST_FRACTION = flags.DEFINE_float(
    "test_fraction", 0.25, "share of scenes held out, by vehicle-disjoint group"
)
_LEAVE_OUT = flags.DEFINE_integer(
    "leave_out", 0, "recordings that may be refused and are left out, counted", 0
)
_FLOOR = flags.DEFINE_float("horizon", 5.0, "s at which the oracle floor is taken")
_SPLIT_SEED = flags.DEFINE_integer("split_seed", 0, "order in which groups are dealt")


def main() -> None:
    """Flags -> one import."""
    places = executor()
    parts = parts_of(
        _FORMAT.value,
        Path(_INPUT.value) if _INPUT.value else None,
        Path(_SOURCE.value) if _SOURCE.value else None,
    )
    config = ImportConfig(
        format=_FORMAT.value,
        collect=_CUT(
            CollectConfig(
                smoothing_s=_SMOOTHING.value,
                min_future_s=_MIN_FUTURE.value,
                min_history_s=_MIN_HISTORY.value,
                min_surroundings_s=_MIN_SURROUNDINGS.value,
                signal_checks=checked_signals(
                    leaving_out(parts) if _LEAVE_OUT.value else parts, places
                ),
            )
        ),
        test_fraction=_TEST_FRACTION.value,
        split_seed=_SPLIT_SEED.value,
        leave_out=_LEAVE_OUT.value,
    )
    floors: list[dict] = []
    splits: list[str] = []

    def judged(dataset: Dataset) -> None:
        floors.extend(_floors(dataset))
        splits.append(format_splits(dataset))

    manifest = import_parts(
        parts,
        _OUTPUT.value,
        config,
        executor=places,
        overwrite=_OVERWRITE.value,
        before_commit=judged,
    )
    print(format_quality(manifest.quality))
    print(*splits, sep="\n")
    for mode, floor in zip(MODES, floors, strict=True):
        mean, median = floor["best_fde_mean_m"], floor["best_fde_median_m"]
        print(
            f"oracle floor, {mode}: best of {floor['candidates']} candidates ends "
            f"{mean:.2f} m (median {median:.2f}) from the human at "
            f"{floor['horizon_s']:g} s, {floor['scenes']} scenes"
        )
    print(f"dataset: {_OUTPUT.value}")


def _floors(dataset: Dataset) -> list[dict]:
    """The oracle floor of every mode of the sampler, also in the dataset's facts."""
    dataset.verify()
    setups = [
        RankingSetup(sampler=SamplerConfig(mode=mode), horizon_s=_FLOOR.value)
        for mode in MODES
    ]
    floors = [oracle_floor(dataset, setup, max_scenes=512) for setup in setups]
    made_by_file(more={"oracle_floor": floors})(dataset)
    return floors


if __name__ == "__main__":
    run(main)
