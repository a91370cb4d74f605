"""Export a trained run as weights.msgpack.

    python -m experiments.export_weights --workdir=RUN --data=DATASET --output=FILE
    python -m experiments.export_weights --workdir=RUN --stablehlo=FILE

The file carries verification samples from the dataset's training split; a
reader recomputes them before it accepts the file. The ranges are for the guard
(docs/guard.md); a reader that knows schema versions 1 and 2 only takes --noranges.
A run with --module has no such file: --stablehlo and --jax_export write its scorer.
"""

from pathlib import Path

from absl import flags

from experiments.common import run
from rcirl_jax.data.store.joined import open_datasets
from rcirl_jax.errors import InputError
from rcirl_jax.export.forms.stablehlo import Form, exported_run, write_stablehlo
from rcirl_jax.export.from_run import export_run, read_config
from rcirl_jax.export.provenance import dataset_names

_WORKDIR = flags.DEFINE_string("workdir", None, "run folder", required=True)
_DATA = flags.DEFINE_list(
    "data", None, "dataset (default: the run's own); several are joined"
)
_RANGES = flags.DEFINE_bool(
    "ranges", True, "record what training saw of each feature (schema version 3)"
)
_STABLEHLO = flags.DEFINE_string(
    "stablehlo", None, "write StableHLO bytecode in its place"
)
_JAX = flags.DEFINE_string("jax_export", None, "write bytes of jax.export in its place")
_OUTPUT = flags.DEFINE_string("output", None, "file (default: RUN/weights.msgpack)")


def main() -> None:
    """Flags -> one file."""
    workdir = Path(_WORKDIR.value)
    if _STABLEHLO.value or _JAX.value:
        made = exported_run(workdir)
        files: dict[Form, str | None]
        files = {"stablehlo": _STABLEHLO.value, "jax": _JAX.value}
        for form, file in files.items():
            if file:
                write_stablehlo(Path(file), made, form)
                print(f"written: {file}")
        return
    output = Path(_OUTPUT.value or workdir / "weights.msgpack")
    dataset = open_datasets(_DATA.value or _own(workdir))
    reward = export_run(workdir, dataset, output, ranges=_RANGES.value)
    print(f"{output}: {len(reward.names)} features, sha256 {reward.sha256[:16]}...")


def _own(workdir: Path) -> list[str]:
    """The datasets named in the run's own flags."""
    path = workdir / "run.json"
    if not path.is_file():
        raise InputError(f"{path}: missing: expected a run made by experiments.train")
    found = read_config(workdir)[1].get("flags", {}).get("data")
    if not found:
        raise InputError("--data: not given and not in run.json: expected a dataset")
    return dataset_names(found, f"{path}: flags.data")


if __name__ == "__main__":
    run(main)
