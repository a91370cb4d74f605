"""Table II of the paper: closed-loop rates of every row over the whole suite.

    python -m experiments.paper.table2 --data=DATASET[,DATASET] --output=DIR [--quick]
    python -m experiments.paper.table2 --weights=FILE[,FILE] --output=DIR

Without --weights rewards are trained as by `experiments.paper.rank_against_gan`, whose
flags of training these are: every loss alone and on top of the own cost. Two seeds
train, the first drives. OUTPUT/suite holds the table of every row, OUTPUT/dp that of
the first file by ranking, by search beside the sampled candidates and by the plans of
search alone, on --dp_cases of each family. Expected: four hours of two cores, nearly
all of it the suite, a quarter of an hour a row. `--quick`: three minutes, numbers
without meaning.
"""

from collections.abc import Sequence
from pathlib import Path

from absl import flags

from experiments.paper import rank_against_gan
from experiments.paper.common import (
    OUTPUT,
    QUICK,
    QUICK_S,
    as_used,
    fixed,
    instead,
    seeds,
    undefine_flags,
)
from experiments.paper.step_sizes import with_chosen_rates
from rcirl_jax.cli.running import run
from rcirl_jax.evaluation.closed_loop.suite import SuiteConfig, run_suite, write_suite
from rcirl_jax.export.closed_loop import table_rows
from rcirl_jax.report.charts import suite_chart
from rcirl_jax.simulation.rows import BASELINES, Row
from rcirl_jax.simulation.suite import FULL_S, catalogue_set, suite_refs

_WEIGHTS = flags.DEFINE_list("weights", None, "weights files instead of training")
_DP_CASES = flags.DEFINE_integer("dp_cases", 2, "cases per family of the DP rows", 1)
undefine_flags("cases", "duration", "catalogue_seed", "horizon")
fixed(seeds=2)
TRAINING = ("data", "recipe", "losses", "share", "seeds", "epochs", "positive")


def trained() -> dict[str, str]:
    """Weights files by row: of the first seed of every loss and form."""
    data, sources = rank_against_gan.opened()
    learners, _ = with_chosen_rates(data, rank_against_gan.configs())
    learned, seen = rank_against_gan.trained(data, learners)
    each = [*sources.values()]
    share = float(flags.FLAGS["share"].value or 0.0)
    files, _ = rank_against_gan.written(learned, share, data, each, seen)
    first = f" {seeds()[0]}"
    names = [name for name in files if name.endswith(first)]
    return {name.removesuffix(first): files[name] for name in names}


def table(
    name: str, rows: Sequence[Row], which: str, cases: int | None, made_by: dict
) -> None:
    """OUTPUT/NAME: some families' cases, as text, JSON, CSV and picture."""
    folder = Path(OUTPUT.value) / name
    duration = QUICK_S if QUICK.value else FULL_S
    refs = suite_refs(which, 1 if QUICK.value else cases)
    result = run_suite(rows, catalogue_set(refs, duration), SuiteConfig())
    print(f"--- {name}\n{write_suite(result, folder, made_by)}")
    suite_chart(folder / "table.png", result.report)


def main() -> None:
    """Both tables, a folder each."""
    if _WEIGHTS.value:
        instead("weights", *TRAINING)
        files, names = _WEIGHTS.value, ()
    else:
        found = trained()
        files, names = [*found.values()], [*found]
    rows = table_rows(files, BASELINES, names=names)
    made_by = as_used(files)
    table("suite", rows, "full", None, made_by)
    rows = table_rows(files[:1], ("hand-set", "IDM"), dp=True)
    which = "free_cruise,stopped_lead" if QUICK.value else "full"
    table("dp", rows, which, _DP_CASES.value, made_by)


if __name__ == "__main__":
    run(main)
