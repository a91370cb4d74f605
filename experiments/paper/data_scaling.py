"""Quality against the number of training scenes.

    python -m experiments.paper.data_scaling --data=DATASET --output=DIR [--quick]

Whole vehicles are added until a count of scenes is reached; the held-out scenes
stay the same, and so does the number of queries: the fewer the scenes, the more
epochs. Rows: logistic pairs with 21-15-1, linear and non-negative. Expected: 15
minutes on two cores; with 30 scenes the non-negative linear reward is ahead of the
network, from some hundred on neither. `--quick`: a minute.
"""

import dataclasses

import jax
import numpy as np
from absl import flags

from experiments.common import run, whole_numbers
from experiments.paper.common import (
    QUICK,
    base,
    dataset,
    intervals,
    picture,
    print_differences,
    ranked,
    seeds,
    write,
)
from rcirl_jax.data.store.resplit import fewer
from rcirl_jax.evaluation.ranking.learners import (
    FrozenSets,
    learner_config,
    train_learner,
)
from rcirl_jax.evaluation.ranking.table import to_json
from rcirl_jax.report.ranking.intervals import interval_curves
from rcirl_jax.report.style import figure, label, save

_COUNTS = flags.DEFINE_list(
    "counts", ["30", "100", "300", "1000", "3000"], "training scenes"
)
ROWS = ("RC-IRL logistic", "logistic non-negative", "logistic linear")


def main() -> None:
    """Train on ever more scenes, rank the same ones, draw."""
    asked, data = whole_numbers(_COUNTS.value, "counts"), dataset()
    most = data.indices("train").size
    counts = sorted({min(count, most) for count in asked})
    counts = counts[:2] if QUICK.value else counts
    sets, learned = FrozenSets(data), {}
    for count in counts:
        for name in ROWS:
            config = learner_config(name, base())
            epochs = round(config.epochs * most / count)
            config = dataclasses.replace(config, epochs=max(epochs, 1))
            learned[f"{name}, {count}"] = []
            for seed in seeds():
                rows = fewer(data, count, seed).indices("train")
                at = np.searchsorted(sets.index, rows)
                part = jax.tree.map(lambda x, at=at: x[at], sets.of(config))
                learned[f"{name}, {count}"] += train_learner(part, config, [seed])
    networks = [f"{ROWS[0]}, {count}" for count in counts]
    report = ranked(data, learned, networks)
    found = intervals(report, "top1_fde")
    made, axes = figure(1, 1, 6.8, 4.4)
    curves = {name: [found[f"{name}, {count}"] for count in counts] for name in ROWS}
    interval_curves(axes[0, 0], counts, curves)
    axes[0, 0].set_xscale("log")
    label(axes[0, 0], "distance of the chosen", "training scenes", "m, lower is better")
    save(made, picture("data_scaling"))
    for name in learned:
        print(f"{name:30s} top-1 FDE {found[name][0]:.2f} m")
    # linear rewards with as much data, then networks with less
    alike = [(f"{name}, {n}", f"{ROWS[0]}, {n}") for n in counts for name in ROWS[1:]]
    print_differences(report, alike + [(less, networks[-1]) for less in networks[:-1]])
    write("data_scaling", {"counts": counts, "ranking": to_json(report)}, data)


if __name__ == "__main__":
    run(main)
