"""Which features the reward needs: each group left out, and each alone.

    python -m experiments.paper.feature_ablation --data=DATASET --output=DIR [--quick]

A feature is left out by giving it no spread (its normalised value is always 0),
in training and in ranking. Expected with US-101: 15 minutes on two cores; without
the obstacle features crashes of the chosen appear, alone they are half a metre
behind (3.1 against 2.6 m, not after correction); without progress (station, time,
speed, limit) the choice is no worse.
`--quick`: a minute.
"""

from experiments.common import run
from experiments.paper.common import base, dataset, picture, ranked, seeds, write
from rcirl_jax.evaluation.ranking.format import format_table
from rcirl_jax.evaluation.ranking.learners import FrozenSets, train_learner
from rcirl_jax.evaluation.ranking.table import to_json
from rcirl_jax.features import feature_map
from rcirl_jax.report.ranking.intervals import ranking_chart

GROUPS = {
    "lateral": ("l", "dl", "ddl", "curvature", "lateral_acceleration"),
    "progress": ("station", "time", "velocity", "speed_limit"),
    "comfort": ("acceleration", "jerk"),
    "obstacles": (
        *("collision", "collision_distance", "follow_distance", "follow_speed"),
        *("overtake_distance", "overtake_speed", "nudge_distance", "nudge_lateral"),
        "nudge_speed",
        *("sidepass_front_distance", "sidepass_front_speed"),
        *("sidepass_rear_distance", "sidepass_rear_speed"),
    ),
    "lines": ("stop_distance", "stop_speed", "virtual_distance", "virtual_speed"),
}


def main() -> None:
    """Train without each group and with each alone, rank, draw."""
    data, config = dataset(), base()
    frozen, names = FrozenSets(data).of(config), feature_map(config.features).names
    keeps = {"all 21": names}
    for group, members in GROUPS.items():
        keeps[f"without {group}"] = tuple(n for n in names if n not in members)
    for group, members in GROUPS.items():
        keeps[f"{group} alone"] = tuple(n for n in names if n in members)
    learned = {
        row: train_learner(frozen, config, seeds(), keep=keep)
        for row, keep in keeps.items()
    }
    report = ranked(data, learned, ["all 21"])
    print(format_table(report, 118))
    ranking_chart(picture("feature_ablation"), report)
    write("feature_ablation", {"kept": keeps, "ranking": to_json(report)}, data)


if __name__ == "__main__":
    run(main)
