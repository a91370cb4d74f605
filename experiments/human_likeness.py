r"""Compares learners: which one chooses most like a human, on the same candidates?

    python -m experiments.human_likeness --data=DATASET --output=DIR \
        --flagfile=experiments/flagfiles/learners.flags

Every learner is trained with every seed on the same candidates and ranks the same
held-out candidates, beside the baselines. No scene is dropped, crashes are charged.
`rcirl human-likeness` also tunes baselines and splits by recordings.
"""

from pathlib import Path

from absl import flags

from rcirl_jax.cli.running import provenance, run
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.evaluation.ranking.evaluate import RankingSetup, evaluate_ranking
from rcirl_jax.evaluation.ranking.learners import (
    LEARNERS,
    learner_configs,
    scorers,
    train_learners,
    untrained,
)
from rcirl_jax.evaluation.ranking.report import UNTRAINED_ROW, format_table, to_json
from rcirl_jax.runtime.atomic_files import write_json, write_whole
from rcirl_jax.train.state import POSITIVES, TrainConfig

_DATA = flags.DEFINE_string("data", None, "dataset", required=True)
_OUTPUT = flags.DEFINE_string("output", None, "folder to write", required=True)
_LEARNERS = flags.DEFINE_list("learners", list(LEARNERS), "what to train")
_SEEDS = flags.DEFINE_integer("seeds", 10, "trainings of each", lower_bound=1)
_EPOCHS = flags.DEFINE_integer("epochs", 16, "passes over the training scenes")
_POSITIVE = flags.DEFINE_enum("positive", "nearest", POSITIVES, "what is ranked first")
_RATE = flags.DEFINE_float("learning_rate", 1e-2, "step size")
_HORIZON = flags.DEFINE_float("horizon", 5.0, "s at which distances are taken")


def main() -> None:
    """Trains all learners, ranks, prints the table with paired differences."""
    dataset, folder = open_dataset(_DATA.value), Path(_OUTPUT.value)
    base = TrainConfig(
        epochs=_EPOCHS.value,
        positive=_POSITIVE.value,
        learning_rate=_RATE.value,
        admissible_in="none",
    )
    configs = learner_configs(_LEARNERS.value, base)
    learned = train_learners(dataset, configs, range(_SEEDS.value))
    rows = {**learned, UNTRAINED_ROW: untrained(next(iter(learned.values())))}
    setup = RankingSetup(preset=base.features, horizon_s=_HORIZON.value)
    report = evaluate_ranking(dataset, scorers(rows), setup)
    table = format_table(report, 118)
    write_whole(folder / "table.txt", table)
    made_by = {**provenance(), "data_hash": dataset.hash}
    write_json(folder / "ranking.json", {**to_json(report), "made_by": made_by})
    print(f"{table}\nwritten: {folder}/ranking.json, table.txt")


if __name__ == "__main__":
    run(main)
