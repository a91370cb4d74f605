"""Import recorded driving into a dataset.

    rcirl import --input=DIR --output=DATASET
    rcirl import --format=csv --source=log.toml --input=log.csv --output=DATASET
    rcirl import --suggest=log.csv

The last line writes the TOML of --source for a table (log.toml, or --output), and
shows its first rows as understood, what was recognised and what is not known. Without
--format an input is recognised by its names.

Prints the data-quality report and writes it into DATASET/manifest.json; commit,
versions, flags and the oracle floor stand in DATASET/made_by.json. An interrupted
import resumes (SIGTERM ends with exit status 143, SIGINT with 130, a full disk with 2:
finished shards stay); bad input leaves nothing behind. Of large releases a few odd
recordings may be left out (--leave_out), counted and named in the report.
"""

import dataclasses
import shlex
from pathlib import Path

from absl import flags

from rcirl_jax.cli import flags as shared
from rcirl_jax.cli.running import made_by_file
from rcirl_jax.data.formats import IMPORTERS
from rcirl_jax.data.formats.csv.reader import parts
from rcirl_jax.data.formats.csv.suggest import suggested
from rcirl_jax.data.formats.files import table_stem
from rcirl_jax.data.formats.recognise import recognised_format
from rcirl_jax.data.importing import ImportConfig, import_logs
from rcirl_jax.data.inputs import input_files, leaving_out
from rcirl_jax.data.quality import format_quality, format_splits
from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.evaluate import RankingSetup, oracle_floor
from rcirl_jax.runtime.atomic_files import write_whole
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.sampling.sampler import MODES

USUAL = (
    *("input", "output", "format", "source", "suggest", "overwrite", "recipe"),
    *("stride", "test_fraction", "leave_out", "workers"),
)
_FORMAT = flags.DEFINE_enum(
    "format", None, sorted(IMPORTERS), "of the logs, where it is not recognised"
)
_SUGGEST = flags.DEFINE_string(
    "suggest", None, "table for which the TOML of --source is written; no import"
)
_INPUT = flags.DEFINE_string(
    "input", None, "logs: a file or folder (synthetic: a TOML of recordings)"
)
_SOURCE = flags.DEFINE_string(
    "source", None, "TOML that maps columns and units (default: data_specs/sources)"
)
_OUTPUT = flags.DEFINE_string("output", None, "folder of the dataset to write")
_OVERWRITE = flags.DEFINE_bool(
    "overwrite", False, "replace a finished dataset, or TOML"
)
_RECIPE = shared.recipe()
_IMPORT = shared.importing()
_SIGNALS = shared.signals()
_HORIZON = shared.horizon()
_EXECUTOR = shared.executor()


def main() -> None:
    """Flags -> one import, or the TOML for one."""
    if _SUGGEST.value:
        suggest(Path(_SUGGEST.value))
        return
    if not _OUTPUT.value:
        raise InputError("--output: not given: expected the dataset to write")
    if not (_INPUT.value or _FORMAT.value):
        raise InputError(
            "--input: not given: expected a file or folder of logs, or "
            "--format=synthetic for the embedded traffic"
        )
    places = _EXECUTOR()
    path = Path(_INPUT.value) if _INPUT.value else None
    source = Path(_SOURCE.value) if _SOURCE.value else None
    form = _FORMAT.value or recognised_format(path, source)
    if _FORMAT.value is None and path is not None:
        print(f"--format={form}: recognised", flush=True)
    parts = input_files(form, path, source)
    config = _IMPORT(ImportConfig(format=form, collect=_RECIPE().collect))
    if _SIGNALS.value:
        read = leaving_out(parts) if config.leaves_out else parts
        checks = shared.pooled_signals(read, places)
        collect = dataclasses.replace(config.collect, signal_checks=checks)
        config = dataclasses.replace(config, collect=collect)
    floors: list[dict] = []
    splits: list[str] = []

    def judged(dataset: Dataset) -> None:
        floors.extend(_floors(dataset))
        splits.append(format_splits(dataset))

    manifest = import_logs(
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


def suggest(table: Path) -> None:
    """Write a source TOML for a table, and show what it makes of the first rows.

    Of a folder, for its first table.
    """
    given = table
    if table.is_dir():
        table = parts(table, {})[0]
        print(f"{table}: the first table of the folder")
    if not table.is_file():
        raise InputError(f"{table}: --suggest: missing: expected a table")
    target = Path(_OUTPUT.value or f"{table_stem(table)}.toml")
    if target.exists() and not _OVERWRITE.value:
        raise InputError(
            f"{target}: there already: expected --overwrite, or another --output"
        )
    found = suggested(table)
    write_whole(target, found.toml)
    print(*found.lines, sep="\n")
    source, logs = shlex.quote(str(target)), shlex.quote(str(given))
    print(
        f"\nwritten: {target}; read it through, then\n"
        f"  rcirl import --format=csv --source={source} --input={logs} --output=DATASET"
    )
    if found.last:
        print(found.last)


def _floors(dataset: Dataset) -> list[dict]:
    """The oracle floor of every mode of the sampler, also in the dataset's facts."""
    dataset.verify()
    setups = [
        RankingSetup(sampler=SamplerConfig(mode=mode), horizon_s=_HORIZON.value)
        for mode in MODES
    ]
    floors = [oracle_floor(dataset, setup, max_scenes=512) for setup in setups]
    made_by_file(oracle_floor=floors)(dataset)
    return floors
