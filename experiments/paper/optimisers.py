"""SGD, Adam and RMSProp: the paper saw no substantial difference. Is there one?

    python -m experiments.paper.optimisers --data=DATASET --output=DIR [--quick]

The paper's 21-15-1 network and rank loss with each optimiser at its own step
size (momentum SGD needs a larger one), same candidates, same seeds: learning
curves and held-out ranking. Expected: 5 minutes on two cores; Adam and RMSProp
within each other's intervals, SGD behind, clearly so with --positive=human, the
paper's setting. `--quick`: about a minute, its numbers
mean nothing.
"""

import numpy as np

from experiments.paper.common import HORIZON, base, dataset, picture, seeds, write
from rcirl_jax.cli.running import run
from rcirl_jax.evaluation.ranking.evaluate import RankingSetup, evaluate_ranking
from rcirl_jax.evaluation.ranking.learners import scorers, train_learners
from rcirl_jax.evaluation.ranking.report import format_table, to_json
from rcirl_jax.report.charts import curves_panel, interval_panel
from rcirl_jax.report.style import figure, label, save

RATES = {"adam": 3e-3, "rmsprop": 3e-3, "sgd": 3e-2}
REFERENCES = ("adam", "IDM", "hand-set", "random")  # of the paired differences


def main() -> None:
    """Train with each, rank, draw."""
    data = dataset()
    configs = {
        name: base(loss="rank", optimizer=name, learning_rate=rate)
        for name, rate in RATES.items()
    }
    learned = train_learners(data, configs, seeds())
    told = base()
    setup = RankingSetup(
        preset=told.features, sampler=told.sampler, horizon_s=HORIZON.value
    )
    report = evaluate_ranking(data, scorers(learned), setup, references=REFERENCES)
    print(format_table(report, 118))
    made, axes = figure(1, 2, 11.0, 4.2)
    wins = {n: np.array([r.wins for r in runs]) for n, runs in learned.items()}
    epochs = np.arange(1, next(iter(wins.values())).shape[1] + 1)
    curves_panel(axes[0, 0], epochs, wins)
    label(axes[0, 0], "training, band: 2 s.e.", "epoch", "share of pairs won")
    found = {name: row["top1_fde"] for name, row in report.rows.items()}
    interval_panel(
        axes[0, 1], {name: (x.value, x.low, x.high) for name, x in found.items()}
    )
    label(axes[0, 1], "held out: distance of the chosen", "m, lower is better", "")
    save(made, picture("optimisers"))
    write(
        "optimisers",
        {
            "learning_rates": RATES,
            "wins": {name: runs.tolist() for name, runs in wins.items()},
            "finite": {n: all(r.finite for r in runs) for n, runs in learned.items()},
            "ranking": to_json(report),
        },
        data,
    )


if __name__ == "__main__":
    run(main)
