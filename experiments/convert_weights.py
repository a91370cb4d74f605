"""A weights file in other forms, for planners that read neither it nor Python.

    python -m experiments.convert_weights --weights=FILE --onnx=FILE --stablehlo=FILE
    python -m experiments.convert_weights --weights=LINEAR --yaml=FILE

--onnx and --jax_export need the extra [export]. Each form scores as the file does;
only weights.msgpack carries samples that a reader checks itself against. FILE.json
beside each says which weights it is of, what trained them and what wrote it.
"""

from pathlib import Path

from absl import flags

from experiments.common import provenance, run
from rcirl_jax.errors import InputError
from rcirl_jax.export.forms.linear_yaml import reward_yaml
from rcirl_jax.export.forms.onnx_model import write_onnx
from rcirl_jax.export.forms.stablehlo import exported, write_stablehlo
from rcirl_jax.export.loading import open_reward
from rcirl_jax.runtime.atomic_files import write_json, write_whole

_WEIGHTS = flags.DEFINE_string("weights", None, "weights file", required=True)
_ONNX = flags.DEFINE_string("onnx", None, "ONNX model to write")
_STABLEHLO = flags.DEFINE_string("stablehlo", None, "StableHLO bytecode to write")
_JAX = flags.DEFINE_string("jax_export", None, "bytes of jax.export to write")
_YAML = flags.DEFINE_string("yaml", None, "linear costs to write")


def main() -> None:
    """Flags -> files."""
    wanted = {"onnx": _ONNX, "stablehlo": _STABLEHLO, "jax_export": _JAX}
    files = {name: Path(flag.value) for name, flag in wanted.items() if flag.value}
    if not files and not _YAML.value:
        raise InputError("--onnx, --stablehlo, --jax_export, --yaml: expected one")
    reward = open_reward(_WEIGHTS.value)
    if reward.anchor is not None:
        raise InputError(
            f"--weights: {reward.file}: expected a reward without an anchor: these "
            "forms hold V alone, and the gain on top of the own cost would be lost"
        )
    text = reward_yaml(reward) if _YAML.value else ""
    for name, path in files.items():
        if name == "onnx":
            write_onnx(path, reward)
        else:
            form = "jax" if name == "jax_export" else "stablehlo"
            write_stablehlo(path, exported(reward), form)
    if _YAML.value:
        files["yaml"] = Path(_YAML.value)
        write_whole(files["yaml"], text)
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


if __name__ == "__main__":
    run(main)
