"""The batch sweep: leaky rate a against hidden size, all seeds in one program.

    python -m experiments.paper.leaky_rate_and_hidden_size --data=DATASET \
        --output=DIR [--quick]

The paper's rank loss over a grid of leaky rates and hidden sizes. All leaky
rates and seeds of one size train side by side as members of one vmapped program.
Expected with US-101: 5 minutes on one core with 5 seeds; a = 0.5 fails at every
size, 0.05 with 15 or 45 units is lowest, a = 0.01 is behind with 5 units (+3.2 m)
and with 15 (+1.3 m, not after correction). `--quick`: a minute, its numbers mean
nothing.
"""

import numpy as np
from absl import flags

from experiments.common import floats, hidden_sizes, run
from experiments.paper.common import (
    base,
    dataset,
    intervals,
    picture,
    print_differences,
    ranked,
    seeds,
    write,
)
from rcirl_jax.evaluation.ranking.learners import FrozenSets, train_grid
from rcirl_jax.evaluation.ranking.table import to_json
from rcirl_jax.report.ranking.intervals import interval_curves
from rcirl_jax.report.style import figure, label, save
from rcirl_jax.reward import RewardConfig

_RATES = flags.DEFINE_list("leaky_rates", ["0.01", "0.05", "0.2", "0.5"], "values of a")
_SIZES = flags.DEFINE_list("hidden_sizes", ["5", "15", "45"], "units; 0 is linear")


PAPERS = "a 0.05, 15 hidden"  # the row with the paper's values


def main() -> None:
    """Train the grid, rank, draw."""
    data, rates = dataset(), floats(_RATES.value, "leaky_rates")
    sets, learned = FrozenSets(data), {}
    for size in _SIZES.value:
        hidden = hidden_sizes([size], "hidden_sizes")
        config = base(loss="rank", reward=RewardConfig(hidden=hidden))
        for rate, runs in train_grid(sets.of(config), config, rates, seeds()).items():
            learned[f"a {rate:g}, {size} hidden"] = runs
    own = [PAPERS] if PAPERS in learned else []
    report = ranked(data, learned, own)
    made, axes = figure(1, 2, 11.0, 4.2)
    for axis, metric, title, unit in (
        (axes[0, 0], "top1_fde", "distance of the chosen", "m, lower is better"),
        (
            axes[0, 1],
            "percentile_rank",
            "rank of the human's curve",
            "higher is better",
        ),
    ):
        found = intervals(report, metric)
        curves = {
            f"{size} hidden": [found[f"a {rate:g}, {size} hidden"] for rate in rates]
            for size in _SIZES.value
        }
        interval_curves(axis, np.asarray(rates), curves)
        axis.set_xscale("log")
        label(axis, title, "leaky rate a", unit)
    save(made, picture("leaky_rate_and_hidden_size"))
    for name in learned:
        value, low, high = intervals(report, "top1_fde")[name]
        print(f"{name:22s} top-1 FDE {value:.2f} m [{low:.2f}, {high:.2f}]")
    print_differences(report, [(x, ref) for ref in own for x in learned if x != ref])
    write("leaky_rate_and_hidden_size", {"ranking": to_json(report)}, data)


if __name__ == "__main__":
    run(main)
