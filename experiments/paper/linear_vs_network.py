"""What the hidden layer buys: linear, non-negative, 21-15-1, wider, deeper.

    python -m experiments.paper.linear_vs_network --data=DATASET --output=DIR [--quick]

One loss (logistic pairs), same candidates and seeds; only the shape of the
reward differs. Expected: 10 minutes on two cores; the free linear reward is far
behind because no straight line prefers a middle speed, the non-negative one,
linear in departures from the usual, is close to the network. `--quick`: a minute.
"""

from experiments.common import run
from experiments.paper.common import base, dataset, picture, ranked, seeds, write
from rcirl_jax.evaluation.ranking.format import format_table
from rcirl_jax.evaluation.ranking.learners import (
    LINEAR,
    learner_config,
    train_learners,
)
from rcirl_jax.evaluation.ranking.table import to_json
from rcirl_jax.report.ranking.intervals import ranking_chart
from rcirl_jax.reward import RewardConfig


def main() -> None:
    """Train every shape, rank, draw."""
    data = dataset()
    configs = {
        "linear": base(reward=LINEAR),
        "non-negative linear": learner_config("logistic non-negative", base()),
        "21-5-1": base(reward=RewardConfig(hidden=(5,))),
        "21-15-1": base(),
        "21-64-1": learner_config("logistic 64", base()),
        "21-32-16-1": learner_config("logistic 32-16", base()),
    }
    learned = train_learners(data, configs, seeds())
    report = ranked(data, learned, ["21-15-1"])
    print(format_table(report, 118))
    ranking_chart(picture("linear_vs_network"), report)
    write("linear_vs_network", {"ranking": to_json(report)}, data)


if __name__ == "__main__":
    run(main)
