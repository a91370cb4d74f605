"""Write the ranking report as one HTML page with its pictures.

python -m experiments.report --weights=FILE[,FILE...] --data=DATASET \
        --output=report.html [--workdir=RUN]
"""

from pathlib import Path

from absl import flags

from experiments.common import provenance, run
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.evaluation.ranking.evaluate import RankingSetup, evaluate_ranking
from rcirl_jax.export.loading import load_runs, open_reward
from rcirl_jax.report.ranking.page import write_ranking_page

_WEIGHTS = flags.DEFINE_list("weights", None, "weights files", required=True)
_DATA = flags.DEFINE_string("data", None, "dataset", required=True)
_OUTPUT = flags.DEFINE_string("output", None, "HTML to write", required=True)
_WORKDIR = flags.DEFINE_string("workdir", None, "run whose training curve is drawn")
_HORIZON = flags.DEFINE_float("horizon", 5.0, "s at which distances are taken")


def main() -> None:
    """Flags -> one page."""
    learned, preset, sampler = load_runs(_WEIGHTS.value)
    dataset = open_dataset(_DATA.value)
    setup = RankingSetup(preset=preset, sampler=sampler, horizon_s=_HORIZON.value)
    page = write_ranking_page(
        Path(_OUTPUT.value),
        dataset=dataset,
        rewards=[open_reward(path) for path in _WEIGHTS.value],
        report=evaluate_ranking(dataset, learned, setup),
        workdir=Path(_WORKDIR.value) if _WORKDIR.value else None,
        facts=provenance(_WEIGHTS.value),
    )
    print(f"report: {page}")


if __name__ == "__main__":
    run(main)
