"""Does any learner train to NaN, with any optimiser, as a recipe trains?

    python -m experiments.paper.stability --data=DATASET --output=DIR [--quick]

Every learner of `LEARNERS` with every optimiser, epochs, step size and positive as
the --recipe says, on one dataset; a learner's optimisers train side by side. A step
whose loss or gradient is not finite is refused by the trainer and counts as a failure
here. Expected: no failure; exit code 1 otherwise. How many pairs each wins is drawn,
not judged. 20 minutes on one core with US-101 and --epochs=20; `--quick`: two minutes.
"""

import sys

import numpy as np
import tqdm
from absl import flags

from experiments.common import run
from experiments.paper.common import (
    QUICK,
    base,
    dataset,
    fixed,
    picture,
    positive,
    unread,
    write,
)
from rcirl_jax.evaluation.ranking.learners import (
    LEARNERS,
    FrozenSets,
    learner_configs,
    train_with_each,
)
from rcirl_jax.report.style import figure, label, save
from rcirl_jax.train.state import PAPER_OPTIMIZERS

# "on curves" are the runs of --positive=human
_LEARNERS = flags.DEFINE_list(
    "learners", [x for x in LEARNERS if not x.endswith("on curves")], "rows to train"
)
fixed(horizon=8.0)
unread("seeds")


def main() -> None:
    """Train all, say which stayed finite, draw."""
    data = dataset()
    sets, rows = FrozenSets(data), {}
    names = _LEARNERS.value[::5] if QUICK.value else _LEARNERS.value
    configs, optimizers = learner_configs(names, base()), sorted(PAPER_OPTIMIZERS)
    for name, config in tqdm.tqdm(configs.items(), desc="train", unit="learner"):
        runs = train_with_each(sets.of(config), config, optimizers)
        for how, learned in runs.items():
            rows[f"{name}, {how}"] = {
                "finite": learned.finite and bool(np.isfinite(learned.loss).all()),
                "loss": learned.loss.tolist(),
                "wins": learned.wins.tolist(),
            }
    failed = [name for name, row in rows.items() if not row["finite"]]
    made, axes = figure(1, 1, 7.0, 1.2 + 0.2 * len(rows))
    axis = axes[0, 0]
    for place, (name, row) in enumerate(rows.items()):
        colour = "#D55E00" if name in failed else "#0072B2"
        axis.plot([row["wins"][0], row["wins"][-1]], [-place] * 2, color=colour, lw=1)
        axis.plot([row["wins"][-1]], [-place], "o", color=colour, ms=4)
    axis.set_yticks(-np.arange(len(rows)), list(rows), fontsize=7)
    label(axis, "training: first epoch to last", "share of pairs won", "")
    save(made, picture("stability"))
    print(f"{len(rows)} runs, not finite: {len(failed)} {failed or ''}")
    write("stability", {"rows": rows, "failed": failed, "positive": positive()}, data)
    if failed:
        sys.exit(1)


if __name__ == "__main__":
    run(main)
