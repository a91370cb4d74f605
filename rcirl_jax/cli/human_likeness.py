"""Compares learners: which chooses most like a human, on the same frozen candidates.

    rcirl human-likeness --data=DATASET --output=DIR [--seeds=10]

Every learner is trained with every seed on the same candidates and ranks the same
held-out candidates, beside random, untrained, constant speed, IDM, hand-set and oracle
rows. No scene is dropped, crashes are charged. Its name says a learner's loss and
network; all else is as the --recipe says, and a flag given beside it wins.

--holdout: `groups`, the dataset's split by groups of vehicles; `vehicles`, a quarter of
them (drawn by --split_seed); `recording`, those numbered --recording; `validation`, a
quarter of the training scenes, to choose a learner by: the held-out ones stay unseen.
--folds=6 instead: the recordings in six parts, each held out once. Either way no
vehicle is the ego of a held-out and of a training scene.

Writes ranking.json, table.txt, table.md and ranking.png, in ten minutes with five
learners, half an hour with all. Needs the extra [report].
"""

import dataclasses
from pathlib import Path

from absl import flags

from rcirl_jax.cli import flags as shared
from rcirl_jax.cli.running import provenance
from rcirl_jax.data.store.dataset import Demonstrations, open_dataset
from rcirl_jax.evaluation.baselines import as_numbers, tuned_baselines
from rcirl_jax.evaluation.ranking.evaluate import (
    RankingSetup,
    pooled,
    rank_scenes,
)
from rcirl_jax.evaluation.ranking.learners import (
    LEARNERS,
    learner_configs,
    scorers,
    train_learners,
    untrained,
)
from rcirl_jax.evaluation.ranking.report import (
    UNTRAINED_ROW,
    build_report,
    format_table,
    markdown_table,
    to_json,
)
from rcirl_jax.evaluation.ranking.score import Baseline
from rcirl_jax.reward import RewardConfig
from rcirl_jax.runtime.atomic_files import write_json, write_whole

USUAL = (
    *("data", "output", "learners", "seeds", "recipe", "horizon", "holdout"),
    *("folds", "split_seed", "recording", "tuned"),
)
_DATA = flags.DEFINE_string("data", None, "dataset of `rcirl import`", required=True)
_OUTPUT = flags.DEFINE_string("output", "out/likeness", "folder to write")
_LEARNERS = flags.DEFINE_list(
    "learners", list(LEARNERS), "what to train; fewer are quicker; all by default"
)
_SEEDS = flags.DEFINE_integer(
    "seeds", 10, "trainings of each, 1 or more; more tell luck from merit", 1
)
_TUNED = flags.DEFINE_integer(
    "tuned", 0, "baselines tuned on the training scenes, so many times; 0: none", 0
)
_LONG = flags.DEFINE_integer(
    "tuned_long", 3000, "evaluations of the hand-set cost's long search, or 0", 0
)
_LEARNERS_SAY = (
    *("loss", "hidden_size", "activation"),
    *("constraint", "scale_constraint", "scene_gating"),
)
_TRAINING = shared.training(without=(*_LEARNERS_SAY, "data_weights"))
_SPLITS = shared.holdout()
_HORIZON = shared.horizon()
_SEARCH = shared.search()


def _tuned(
    part: Demonstrations, setup: RankingSetup, epochs: int
) -> dict[str, list[Baseline]]:
    """Tunes baselines, if any, with the queries of a learner's epochs."""
    if not _TUNED.value:
        return {}
    seeds = range(_TUNED.value)
    return tuned_baselines(
        part,
        setup,
        epochs=epochs,
        seeds=seeds,
        long=_LONG.value,
        search=_SEARCH.value,
    )


def main() -> None:
    """Flags -> one comparison."""
    from rcirl_jax.report.charts import ranking_chart

    dataset = open_dataset(_DATA.value)
    parts, words = _SPLITS(dataset)
    base = dataclasses.replace(_TRAINING.config(), reward=RewardConfig())
    configs = learner_configs(_LEARNERS.value, base)
    setup = RankingSetup(
        preset=base.features, sampler=base.sampler, horizon_s=_HORIZON.value
    )
    setups = [
        dataclasses.replace(setup, tuned=_tuned(x, setup, base.epochs)) for x in parts
    ]
    folder, ranked, failed = Path(_OUTPUT.value), [], set()
    for part, own in zip(parts, setups, strict=True):
        learned = train_learners(part, configs, range(_SEEDS.value))
        rows = {**learned, UNTRAINED_ROW: untrained(next(iter(learned.values())))}
        ranked.append(rank_scenes(part, scorers(rows), own))
        failed |= {n for n, runs in learned.items() if not all(x.finite for x in runs)}
    report = build_report(pooled(ranked))
    write_whole(folder / "table.txt", format_table(report, 118))
    write_whole(folder / "table.md", markdown_table(report))
    split_of = parts[0] if len(parts) == 1 else dataset
    made_by = {**provenance(), "data_hash": split_of.hash}
    bad = sorted(failed)
    body = {
        **to_json(report),
        "split": words,
        "parts": [
            {name: int(x.indices(name).size) for name in ("train", "test")}
            for x in parts
        ],
        "tuned": [
            {row: as_numbers(runs) for row, runs in x.tuned.items()} for x in setups
        ],
        "not_finite": bad,
        "settings": dataclasses.asdict(base),  # which learners depart from
        "made_by": made_by,
    }
    write_json(folder / "ranking.json", body, indent=0)  # a third smaller
    picture = ranking_chart(folder / "ranking.png", report)
    print(f"{format_table(report, 118, differences=False)}\nsplit: {words}")
    print(f"written: {folder}/ranking.json, table.md, {picture.name}")
    if bad:
        print(f"steps were refused for a NaN or infinity: {', '.join(bad)}")
    print(f"with paired differences: {folder}/table.txt")
