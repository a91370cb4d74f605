r"""Exports a trained run as weights.msgpack, and as StableHLO for XLA without Python.

    python -m experiments.export_weights --run=RUN --output=weights.msgpack \
        --stablehlo=reward.stablehlo

The file carries verification samples from the dataset's training split; a reader
recomputes them before it accepts the file. `rcirl export` writes further forms.
"""

from pathlib import Path

from absl import flags

from rcirl_jax.cli.running import run
from rcirl_jax.data.store.dataset import open_datasets
from rcirl_jax.data.store.splits import with_tags
from rcirl_jax.export.forms import exported, write_stablehlo
from rcirl_jax.export.from_run import datasets_of, export_run, tags_of
from rcirl_jax.export.loading import open_reward

_RUN = flags.DEFINE_string("run", None, "folder of a training run", required=True)
_OUTPUT = flags.DEFINE_string("output", None, "weights file to write", required=True)
_DATA = flags.DEFINE_list("data", [], "datasets, where they have moved")
_STABLEHLO = flags.DEFINE_string("stablehlo", None, "StableHLO bytecode to write")


def main() -> None:
    """Writes the weights, and the scorer that they make."""
    workdir, output = Path(_RUN.value), Path(_OUTPUT.value)
    dataset = open_datasets(_DATA.value or datasets_of(workdir))
    dataset = with_tags(dataset, tags_of(workdir))
    reward = export_run(workdir, dataset, output)
    print(f"{output}: {len(reward.names)} features, sha256 {reward.sha256[:16]}")
    if _STABLEHLO.value:
        scorer = exported(open_reward(str(output)))
        write_stablehlo(Path(_STABLEHLO.value), scorer, "stablehlo")
        print(f"written: {_STABLEHLO.value}")


if __name__ == "__main__":
    run(main)
