r"""Goes through the whole loop: train, export, rank, drive, judge and report.

    python -m experiments.autotune --data=DATASET,DATASET --workdir=RUN \
        --flagfile=experiments/flagfiles/tuned_three_sites.flags

Every stage is kept until what it is made from changes; a killed run goes on where it
was. The candidate is WORKDIR/weights.msgpack, the page to open WORKDIR/report.html.
`rcirl autotune` also imports logs and has a flag for every setting.
"""

import sys

from absl import flags

import rcirl_jax
from rcirl_jax.cli.running import run
from rcirl_jax.runtime.executors import make_executor
from rcirl_jax.tuning.recipes import DEFAULT

_DATA = flags.DEFINE_list("data", None, "datasets, with commas", required=True)
_WORKDIR = flags.DEFINE_string("workdir", None, "folder of the run", required=True)
_RECIPE = flags.DEFINE_string("recipe", DEFAULT, "tuned, paper, quick or a TOML")
_EPOCHS = flags.DEFINE_integer("epochs", None, "instead of the recipe's")
_INCUMBENT = flags.DEFINE_string(
    "incumbent", "hand-set", "weights file, own cost or baseline"
)
_SUITE = flags.DEFINE_string("suite", "full", "full, smoke, or families with commas")
_CASES = flags.DEFINE_integer("cases", None, "per family; default: as declared")
_DURATION = flags.DEFINE_float("duration", None, "s of a case; 120, of smoke 20")
_DRIVES = flags.DEFINE_integer("drives", 240, "held-out drives to compare with")
_WORKERS = flags.DEFINE_integer("workers", 1, "processes at once")


def main() -> None:
    """Runs the loop; its exit status is the gate's."""
    own = {} if _EPOCHS.value is None else {"epochs": _EPOCHS.value}
    verdict = rcirl_jax.tune(
        _DATA.value,
        _WORKDIR.value,
        recipe=_RECIPE.value,
        incumbent=_INCUMBENT.value,
        suite=_SUITE.value,
        cases=_CASES.value,
        duration_s=_DURATION.value,
        drives=_DRIVES.value,
        executor=make_executor("local", workers=_WORKERS.value),
        **own,
    )
    sys.exit(verdict.exit_code)


if __name__ == "__main__":
    run(main)
