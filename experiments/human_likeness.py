"""Which learner chooses most like a human: all on the same frozen candidates.

    python -m experiments.human_likeness --data=DATASET --output=DIR [--seeds=10]

Every learner of `LEARNERS` is trained with every seed on the same candidates of
the training scenes and ranks the same candidates of the held-out scenes, beside
random, constant speed, IDM, hand-set and oracle rows. Of the scenes recorded as
long as the horizon none is dropped; a crash of the chosen candidate is charged.
`--holdout`:

    groups      the dataset's split by vehicle-disjoint groups
    vehicles    a quarter of the vehicles (drawn by --split_seed), which drove
                beside those of the training scenes
    recording   recordings (numbers --recording) and their vehicles
    validation  a quarter of the training scenes, by group or vehicle; the
                dataset's held-out scenes stay unseen: to choose a learner by

Writes ranking.json, table.txt, table.md and ranking.png. US-101 on two cores:
about 15 minutes with 5 learners, an hour with all; expected at 5 s: networks with
a top-1 FDE of 2.2 to 3.1 m, GAN among them, IDM 4.4, hand-set 8.8, oracle 0.2 m.
"""

from pathlib import Path

from absl import flags

from experiments.common import provenance, run
from experiments.holdout import split
from rcirl_jax.data.store import open_dataset
from rcirl_jax.evaluation.evaluate import RankingSetup, evaluate_ranking
from rcirl_jax.evaluation.format import format_table, markdown_table
from rcirl_jax.evaluation.learners import (
    LEARNERS,
    learner_configs,
    scorers,
    train_learners,
)
from rcirl_jax.evaluation.table import to_json
from rcirl_jax.export.hand_weights import tuned_rows
from rcirl_jax.report.intervals import ranking_chart
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.whole import write_json, write_whole

_DATA = flags.DEFINE_string("data", None, "dataset of import_logs", required=True)
_OUTPUT = flags.DEFINE_string("output", "out/likeness", "folder to write")
_LEARNERS = flags.DEFINE_list("learners", list(LEARNERS), "rows to train")
_SEEDS = flags.DEFINE_integer("seeds", 10, "training runs per learner", lower_bound=1)
_EPOCHS = flags.DEFINE_integer(
    "epochs", 10, "passes over the training scenes", lower_bound=1
)
_HALVE = flags.DEFINE_integer("halve_every", 0, "steps per halving of the step size")
_HORIZON = flags.DEFINE_float(
    "horizon", 5.0, "s at which distances are taken", lower_bound=0.4, upper_bound=8.0
)
_MODE = flags.DEFINE_enum(
    "mode", "speed", ["speed", "path_speed"], "what the sampler varies"
)
_HAND = flags.DEFINE_list(
    "hand_weights", [], "of tune_hand_set with the same split: runs of a further row"
)


def main() -> None:
    """Flags -> one comparison."""
    dataset, words = split(open_dataset(_DATA.value))
    tuned = tuned_rows(_HAND.value, dataset.hash)
    sampler = SamplerConfig(mode=_MODE.value)
    base = TrainConfig(
        positive="nearest",
        epochs=_EPOCHS.value,
        halve_every=_HALVE.value,
        train_horizon=_HORIZON.value,
        sampler=sampler,
    )
    configs = learner_configs(_LEARNERS.value, base)
    setup = RankingSetup(sampler=sampler, horizon_s=_HORIZON.value, hand_set=tuned)
    folder = Path(_OUTPUT.value)
    learned = train_learners(dataset, configs, range(_SEEDS.value))
    report = evaluate_ranking(dataset, scorers(learned), setup)
    write_whole(folder / "table.txt", format_table(report, 118))
    write_whole(folder / "table.md", markdown_table(report))
    made_by = {**provenance(), "data_hash": dataset.hash}
    failed = [name for name, runs in learned.items() if not all(x.finite for x in runs)]
    body = {**to_json(report), "split": words, "not_finite": failed, "made_by": made_by}
    write_json(folder / "ranking.json", body)
    picture = ranking_chart(folder / "ranking.png", report)
    print(f"{format_table(report, 118, differences=False)}\nsplit: {words}")
    print(f"written: {folder}/ranking.json, table.md, {picture.name}")
    if failed:
        print(f"steps were refused for a NaN or infinity: {', '.join(failed)}")
    print(f"with paired differences: {folder}/table.txt")


if __name__ == "__main__":
    run(main)
