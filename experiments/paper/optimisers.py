"""SGD, Adam and RMSProp, under the paper's loss and the GAN's: does it matter?

    python -m experiments.paper.optimisers --data=DATASET --output=DIR [--quick]

The paper saw no substantial difference. Its 21-15-1 network with each optimiser, each
at the step size that serves it best on validation scenes, trained for at least --steps
steps, with the same candidates and seeds: learning curves and held-out ranking. The GAN
stands with the rank loss's scale constraint and without. `--quick`: about a minute, its
numbers mean nothing.
"""

import dataclasses
import itertools

import numpy as np

from experiments.paper.common import (
    HORIZON,
    base,
    dataset,
    picture,
    seeds,
    write,
)
from experiments.paper.step_sizes import RATES, plateau_warnings, with_chosen_rates
from rcirl_jax.cli.running import run
from rcirl_jax.evaluation.ranking.evaluate import RankingSetup, evaluate_ranking
from rcirl_jax.evaluation.ranking.learners import scorers, train_learners
from rcirl_jax.evaluation.ranking.report import format_table, to_json
from rcirl_jax.report.charts import curves_panel, interval_panel
from rcirl_jax.report.style import figure, label, save
from rcirl_jax.reward import RewardConfig
from rcirl_jax.train.state import PAPER_OPTIMIZERS, TrainConfig

LOSSES = {
    "rank": ("rank", "unit"),
    "GAN": ("gan", "unit"),
    "GAN free": ("gan", "none"),
}
# of the paired differences
REFERENCES = ("rank, adam", "GAN, adam", "IDM", "hand-set", "random")


def configs() -> dict[str, TrainConfig]:
    """Every loss with every optimiser; step sizes are chosen later."""
    made = {}
    for (name, (loss, scale)), optimizer in itertools.product(
        LOSSES.items(), PAPER_OPTIMIZERS
    ):
        reward = RewardConfig(scale_constraint=scale)
        made[f"{name}, {optimizer}"] = base(
            loss=loss, optimizer=optimizer, reward=reward
        )
    return made


def main() -> None:
    """Choose step sizes, train with each, rank, draw."""
    data = dataset()
    chosen, how = with_chosen_rates(data, configs())
    learned = train_learners(data, chosen, seeds())
    told = base()
    setup = RankingSetup(
        preset=told.features, sampler=told.sampler, horizon_s=HORIZON.value
    )
    report = evaluate_ranking(data, scorers(learned), setup, references=REFERENCES)
    print(format_table(report, 118))
    warnings = plateau_warnings(learned)
    made, axes = figure(1, len(LOSSES) + 1, 16.0, 4.4)
    for panel, loss in zip(axes[0], LOSSES, strict=False):
        tried = {
            one: np.array(
                [[how[f"{loss}, {one}"].distance.get(x, np.nan) for x in RATES]]
            )
            for one in PAPER_OPTIMIZERS
        }
        curves_panel(panel, np.array(RATES), tried)
        panel.set_xscale("log")
        label(panel, f"{loss}: validation", "step size", "distance of the chosen, m")
    found = {name: row["top1_fde"] for name, row in report.rows.items()}
    interval_panel(
        axes[0, -1], {name: (x.value, x.low, x.high) for name, x in found.items()}
    )
    label(axes[0, -1], "held out: distance of the chosen", "m, lower is better", "")
    save(made, picture("optimisers"))
    write(
        "optimisers",
        {
            "step_sizes": {name: dataclasses.asdict(x) for name, x in how.items()},
            "epochs": {name: one.epochs for name, one in chosen.items()},
            "warnings": warnings,
            "wins": {n: [r.wins.tolist() for r in x] for n, x in learned.items()},
            "finite": {n: all(r.finite for r in runs) for n, runs in learned.items()},
            "ranking": to_json(report),
        },
        data,
    )


if __name__ == "__main__":
    run(main)
