"""Train on one site, test on another: does the reward travel?

    python -m experiments.paper.cross_site --sites=NAME=DATASET,NAME=DATASET \
        --output=DIR [--quick]

Every site's training scenes, ranked on every site's held-out scenes, beside the
rows that learn nothing. Expected with US-101, I-80 and the urban recordings: 6
minutes on one core with 10 seeds; motorways lend to each other, between motorways
and signalised streets nothing carries over. Without --sites two synthetic halves
stand in. `--quick`: a minute.
"""

from absl import flags

from experiments.common import run
from experiments.paper.common import (
    base,
    dataset,
    few,
    instead,
    intervals,
    picture,
    print_differences,
    ranked,
    seeds,
    write,
)
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.data.store.resplit import halves
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.learners import FrozenSets, train_learner
from rcirl_jax.evaluation.ranking.table import to_json
from rcirl_jax.report.ranking.intervals import interval_panel
from rcirl_jax.report.style import figure, label, save

_SITES = flags.DEFINE_list("sites", [], "NAME=DATASET, at least two")


def sites() -> dict[str, Demonstrations]:
    """Datasets by name."""
    if not _SITES.value:
        first, second = halves(dataset())
        return {"half A": first, "half B": second}
    instead("sites", "data")
    pairs = [item.partition("=") for item in _SITES.value]
    named = {name: path for name, _, path in pairs}
    if len(pairs) < 2 or len(named) < len(pairs) or not all(named.values()):
        raise InputError(
            f"--sites: {_SITES.value}: expected two or more NAME=DATASET, named apart"
        )
    return {name: few(open_dataset(path)) for name, path in named.items()}


def main() -> None:
    """Train on each, rank on each, draw one panel per test site."""
    found = sites()
    learned = {
        f"trained on {name}": train_learner(
            FrozenSets(data).of(base()), base(), seeds()
        )
        for name, data in found.items()
    }
    made, axes = figure(1, len(found), 5.5 * len(found), 3.6)
    reports = {}
    for axis, (name, data) in zip(axes[0], found.items(), strict=True):
        own = f"trained on {name}"
        report = ranked(data, learned, [own])
        reports[name] = to_json(report)
        rows = intervals(report, "top1_fde")
        interval_panel(axis, rows)
        label(axis, f"held-out scenes of {name}", "top-1 distance, m", "")
        for row, (value, low, high) in rows.items():
            print(f"on {name}: {row}: top-1 FDE {value:.2f} m [{low:.2f}, {high:.2f}]")
        print_differences(report, [(other, own) for other in learned if other != own])
    save(made, picture("cross_site"))
    hashes = {name: data.hash for name, data in found.items()}
    write("cross_site", {"tested_on": reports, "data_hashes": hashes})


if __name__ == "__main__":
    run(main)
