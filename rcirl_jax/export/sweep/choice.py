"""Members and configurations of a sweep, scored and chosen."""

import collections
import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
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
    row_name,
    seed_means,
    shape_name,
)
from rcirl_jax.evaluation.statistics import ClusterBootstrap
from rcirl_jax.export.loading import compiled_scorer, open_reward
from rcirl_jax.export.sweep.folder import weights_file
from rcirl_jax.runtime.executors import Executor
from rcirl_jax.train.state import TrainConfig

Rows = Mapping[str, Sequence[TrainConfig]]  # configuration -> its members
# (name of a split, rows) -> their metrics, and the vehicles of the scenes
Judge = Callable[[str, Rows], tuple[Scores, ClusterBootstrap]]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Found:
    """Trained members, with their values on the validation split; all by name."""

    rows: Rows
    groups: Mapping[str, dict]  # how each trained, in numbers
    members: Mapping[str, dict]
    configurations: Mapping[str, dict]

    def value(self, row: str, metric: str) -> float:
        """Of a configuration, the mean of its seeds; NaN where one did not train."""
        known = self.configurations[row]
        return known["validation"][metric]["value"] if known["finite"] else math.nan

    def beside(self, other: "Found") -> "Found":
        """These and those of another."""
        return Found(
            rows={**self.rows, **other.rows},
            groups={**self.groups, **other.groups},
            members={**self.members, **other.members},
            configurations={**self.configurations, **other.configurations},
        )


def scores_of(
    config: SweepConfig,
    folder: Path,
    split: Demonstrations,
    executor: Executor,
    name: str,
    rows: Rows,
) -> tuple[Scores, ClusterBootstrap]:
    """Metrics of the members in a sweep's folder on the scenes of a split."""
    runs = {
        row: [compiled_scorer(open_reward(str(weights_file(folder, m)))) for m in of]
        for row, of in rows.items()
    }
    return held_out_scores(split, name, runs, config.setup, executor)


def validated(config: SweepConfig, groups: Mapping[str, dict], judge: Judge) -> Found:
    """Members and configurations on the validation split.

    Args:
      config: whose members they are.
      groups: what is known of each group's training, by its name.
      judge: scores them.
    """
    members = {n: m for group in groups.values() for n, m in group["members"].items()}
    rows: dict[str, list[TrainConfig]] = collections.defaultdict(list)
    for one in config.members():
        rows[row_name(one)].append(one)
    found, vehicles = judge("validation", rows)
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
    return Found(
        rows=rows,
        groups={name: group["facts"] for name, group in groups.items()},
        members=members,
        configurations=configurations,
    )


def chosen(config: SweepConfig, found: Found, judge: Judge) -> dict:
    """The best on the validation split, and its scores on the test split."""
    metric, members = config.choose_by, found.members
    row = best({row: found.value(row, metric) for row in found.rows}, metric)
    names = found.configurations[row]["members"]
    member = best({n: members[n]["validation"][metric] for n in names}, metric)
    tested, vehicles = judge("test", {row: found.rows[row]})
    test = estimates(tested[row], vehicles)
    return {
        "configuration": row,
        "member": member,
        "validation": found.configurations[row]["validation"],
        "test": {name: dataclasses.asdict(one) for name, one in test.items()},
        "member_test": seed_means(tested[row], vehicles)[names.index(member)],
    }


def choice(config: SweepConfig, found: Found, judge: Judge) -> dict:
    """The part of sweep.json on the members and on the one that is chosen."""
    metric = config.choose_by
    return {
        "groups": found.groups,
        "choose_by": {"metric": metric, **dataclasses.asdict(METRICS[metric])},
        "members": found.members,
        "configurations": found.configurations,
        "chosen": chosen(config, found, judge),
    }


def _values_of(config: TrainConfig) -> dict:
    return {
        "hidden": shape_name(config.reward.hidden),
        "leaky_rate": config.leaky_rate,
        "learning_rate": config.learning_rate,
    }
