"""Export a trained run as weights.msgpack, and weights in other forms.

    rcirl export --run=RUN --output=FILE
    rcirl export --weights=FILE --onnx=FILE --stablehlo=FILE
    rcirl export --weights=LINEAR --yaml=FILE
    rcirl export --weights=FILE --into=PLANNER.yaml --output=NEW.yaml
    rcirl export --run=RUN --stablehlo=FILE
    rcirl export --weights=FILE --dial=0.5 --output=FILE

The file carries verification samples from the dataset's training split; a reader
recomputes them before it accepts the file. It also records the range of each feature in
training, for the guard (docs/guard.md).

Other forms are for planners that read neither it nor Python (--onnx and --jax_export
need the extra [export]). Each scores as the file does, and FILE.json beside it says
which weights it is of, what trained them and what wrote it. A run with --module has no
weights.msgpack: --stablehlo and --jax_export write its scorer.

--dial multiplies the gain of the learned value on top of the planner's own cost; `rcirl
gate` judges that file.
"""

from collections.abc import Mapping
from pathlib import Path

from absl import flags

from rcirl_jax.cli.running import provenance
from rcirl_jax.data.store.dataset import open_datasets
from rcirl_jax.data.store.splits import with_tags
from rcirl_jax.errors import InputError
from rcirl_jax.export.forms import (
    Form,
    exported,
    exported_run,
    reward_yaml,
    terms_yaml,
    with_weights,
    write_onnx,
    write_stablehlo,
)
from rcirl_jax.export.from_run import (
    data_weights_of,
    datasets_of,
    export_run,
    tags_of,
)
from rcirl_jax.export.loading import features_of, open_reward
from rcirl_jax.export.reader import Reward
from rcirl_jax.export.weights import save_with_dial
from rcirl_jax.runtime.atomic_files import write_json, write_whole

USUAL = (
    *("run", "weights", "output", "dial", "data", "onnx", "stablehlo", "jax_export"),
    *("yaml", "into"),
)
_RUN = flags.DEFINE_string("run", None, "run to export: a folder of `rcirl train`")
_WEIGHTS = flags.DEFINE_string(
    "weights", None, "instead: a weights file, to write in other forms"
)
_DATA = flags.DEFINE_list(
    "data", None, "datasets, where they have moved (default: those of the run)"
)
_OUTPUT = flags.DEFINE_string(
    "output", None, "weights file to write (default: RUN/weights.msgpack)"
)
_DIAL = flags.DEFINE_float(
    "dial",
    None,
    "with --weights and --output: number that multiplies the gain of the learned value "
    "on top of the own cost; 1 is the file as it is",
)
_ONNX = flags.DEFINE_string(
    "onnx", None, "file to write: an ONNX model, for onnxruntime and the like"
)
_STABLEHLO = flags.DEFINE_string(
    "stablehlo", None, "file to write: StableHLO bytecode, for XLA without Python"
)
_JAX = flags.DEFINE_string(
    "jax_export",
    None,
    "file to write: bytes of jax.export, for other programs with JAX",
)
_YAML = flags.DEFINE_string(
    "yaml", None, "file to write: costs by name, of a linear reward"
)
_INTO = flags.DEFINE_string(
    "into",
    None,
    "your planner's parameter file: --output is that file with the tuned weights of "
    "your own terms, found by their names",
)
FORMS: dict[str, Form] = {"stablehlo": "stablehlo", "jax_export": "jax"}


def main() -> None:
    """Flags -> files."""
    if bool(_RUN.value) == bool(_WEIGHTS.value):
        raise InputError("--run, --weights: expected one of them")
    files = {x.name: Path(x.value) for x in (_STABLEHLO, _JAX, _ONNX, _YAML) if x.value}
    if _DIAL.value is not None:
        if _INTO.value or not _WEIGHTS.value or not _OUTPUT.value or files:
            raise InputError("--dial: expected --weights and --output with it, no more")
        made = save_with_dial(_WEIGHTS.value, _DIAL.value, _OUTPUT.value)
        print(f"{_OUTPUT.value}: {made.prior_cost}, sha256 {made.sha256[:16]}...")
    elif _INTO.value:
        if not _WEIGHTS.value or not _OUTPUT.value or files:
            raise InputError("--into: expected --weights and --output with it, no more")
        theirs, output = Path(_INTO.value), Path(_OUTPUT.value)
        try:
            text = theirs.read_text("utf-8")
        except OSError as error:
            raise InputError(
                f"--into: {theirs}: {error.strerror}: expected your planner's "
                "parameter file"
            ) from error
        except ValueError as error:
            raise InputError(f"--into: {theirs}: {error}: expected text") from error
        write_whole(
            output, with_weights(text, open_reward(_WEIGHTS.value), str(theirs))
        )
        print(f"written: {output}")
    elif _WEIGHTS.value:
        _convert(open_reward(_WEIGHTS.value), files)
    elif _ONNX.value or _YAML.value:
        raise InputError("--onnx, --yaml: expected --weights with them")
    elif files:
        made = exported_run(Path(str(_RUN.value)))
        for name, path in files.items():
            write_stablehlo(path, made, FORMS[name])
            print(f"written: {path}")
    else:
        workdir = Path(str(_RUN.value))
        output = Path(_OUTPUT.value or workdir / "weights.msgpack")
        names = _DATA.value or datasets_of(workdir)
        dataset = open_datasets(names, weights=data_weights_of(workdir))
        dataset = with_tags(dataset, tags_of(workdir))
        reward = export_run(workdir, dataset, output)
        print(f"{output}: {len(reward.names)} features, sha256 {reward.sha256[:16]}...")


def _convert(reward: Reward, files: Mapping[str, Path]) -> None:
    """Other forms of a weights file by flag, each with its facts beside it."""
    if not files:
        raise InputError("--onnx, --stablehlo, --jax_export, --yaml: expected one")
    if reward.prior_cost is not None:
        raise InputError(
            f"--weights: {reward.file}: expected a reward without a prior cost: these "
            "forms hold V alone, and the gain on top of the own cost would be lost"
        )
    text = ""
    if "yaml" in files:
        of_terms = features_of(reward).own is not None
        text = terms_yaml(reward) if of_terms else reward_yaml(reward)
    for name, path in files.items():
        if name == "yaml":
            write_whole(path, text)
        elif name == "onnx":
            write_onnx(path, reward)
        else:
            write_stablehlo(path, exported(reward), FORMS[name])
    facts = {
        "weights_sha256": reward.sha256,
        "features": reward.names,
        "units": reward.units,
        "times_s": [float(time) for time in reward.times],
        "provenance": reward.provenance,
    }
    for name, path in files.items():
        beside = path.with_name(f"{path.name}.json")
        write_json(beside, {"form": name, **facts, "made_by": provenance()})
        print(f"written: {path}, {beside}")
