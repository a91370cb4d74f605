"""The main job, end to end, on synthetic human traffic; what `make demo` runs.

    python -m experiments.demo --output=out/demo

import -> train -> export -> rank -> report, about two minutes on two cores.
Running it again reuses the finished dataset and resumes the training run.
"""

from pathlib import Path

from absl import flags

from experiments.common import provenance, run
from rcirl_jax.data.config import CollectConfig
from rcirl_jax.data.importers import read_recordings
from rcirl_jax.data.importing import ImportConfig, import_logs
from rcirl_jax.data.quality import format_quality
from rcirl_jax.data.store import open_dataset
from rcirl_jax.evaluation.evaluate import RankingSetup, evaluate_ranking
from rcirl_jax.evaluation.format import format_table
from rcirl_jax.export.from_run import export_run
from rcirl_jax.export.loading import load_runs
from rcirl_jax.report.ranking_page import write_ranking_page
from rcirl_jax.train.loop import train
from rcirl_jax.train.state import TrainConfig

_OUTPUT = flags.DEFINE_string("output", "out/demo", "folder for everything")
_STRIDE = flags.DEFINE_float("stride", 6.0, "s between planning frames of a driver")
_EPOCHS = flags.DEFINE_integer("epochs", 6, "passes over the training scenes")


def main() -> None:
    """The five steps in order."""
    output = Path(_OUTPUT.value)
    data, workdir = output / "dataset", output / "run"
    if not (data / "manifest.json").exists():
        config = ImportConfig(
            format="synthetic", collect=CollectConfig(stride_s=_STRIDE.value)
        )
        import_logs(read_recordings("synthetic", None), data, config)
    dataset = open_dataset(data)
    print(format_quality(dataset.manifest.quality))
    facts = provenance()
    train(dataset, workdir, TrainConfig(epochs=_EPOCHS.value), provenance=facts)
    reward = export_run(workdir, dataset, output / "weights.msgpack")
    learned, preset, _ = load_runs([reward.file])
    report = evaluate_ranking(dataset, learned, RankingSetup(preset=preset))
    print(format_table(report, 118))
    page = write_ranking_page(
        output / "report.html",
        dataset=dataset,
        rewards=[reward],
        report=report,
        workdir=workdir,
    )
    print(f"weights: {reward.file}")
    print(f"report to open: {page}")


if __name__ == "__main__":
    run(main)
