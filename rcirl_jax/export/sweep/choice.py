"""Members and configurations of a sweep, scored and chosen."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.evaluation.ranking.metrics import METRICS
from rcirl_jax.evaluation.ranking.sweep import (
    Scores,
    SweepConfig,
    best,
    estimates,
    held_out_scores,
    member_name,
    seed_means,
    shape_name,
)
from rcirl_jax.evaluation.statistics import ClusterBootstrap
from rcirl_jax.export.loading import compiled_scorer, open_reward
from rcirl_jax.export.sweep.folder import weights_file
from rcirl_jax.runtime.executors import Executor
from rcirl_jax.train.state import TrainConfig

Rows = Mapping[str, Sequence[TrainConfig]]  # configuration -> its members


def judged(
    config: SweepConfig,
    folder: Path,
    split: Demonstrations,
    rows: Rows,
    groups: Mapping[str, dict],
    executor: Executor,
) -> dict:
    """Members and configurations on the validation split; the chosen on the test."""

    def scores(name: str, rows: Rows) -> tuple[Scores, ClusterBootstrap]:
        runs = {
            row: [
                compiled_scorer(open_reward(str(weights_file(folder, m)))) for m in of
            ]
            for row, of in rows.items()
        }
        return held_out_scores(split, name, runs, config.setup, executor)

    members = {n: m for group in groups.values() for n, m in group["members"].items()}
    found, vehicles = scores("validation", rows)
    configurations = {}
    for row, of in rows.items():
        names = [member_name(one) for one in of]
        values = estimates(found[row], vehicles)
        configurations[row] = {
            **_values_of(of[0]),
            "members": names,
            "finite": all(members[name]["finite"] for name in names),
            "validation": {n: dataclasses.asdict(e) for n, e in values.items()},
        }
        for name, one, means in zip(
            names, of, seed_means(found[row], vehicles), strict=True
        ):
            members[name] |= {**_values_of(one), "seed": one.seed, "validation": means}
    metric = config.choose_by
    fine = {row: c for row, c in configurations.items() if c["finite"]}
    row = best({r: c["validation"][metric]["value"] for r, c in fine.items()}, metric)
    names = configurations[row]["members"]
    member = best({n: members[n]["validation"][metric] for n in names}, metric)
    tested, vehicles = scores("test", {row: rows[row]})
    return {
        "choose_by": {"metric": metric, **dataclasses.asdict(METRICS[metric])},
        "members": members,
        "configurations": configurations,
        "chosen": {
            "configuration": row,
            "member": member,
            "validation": configurations[row]["validation"],
            "test": {
                name: dataclasses.asdict(estimate)
                for name, estimate in estimates(tested[row], vehicles).items()
            },
            "member_test": seed_means(tested[row], vehicles)[names.index(member)],
        },
    }


def _values_of(config: TrainConfig) -> dict:
    return {
        "hidden": shape_name(config.reward.hidden),
        "leaky_rate": config.leaky_rate,
        "learning_rate": config.learning_rate,
    }
