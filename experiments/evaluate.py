r"""Ranks the candidates of held-out scenes by exported rewards, beside all baselines.

    python -m experiments.evaluate --weights=FILE[,FILE...] \
        --data=DATASET --output=ranking.json \
        --flagfile=experiments/flagfiles/paper_evaluate.flags

Files that differ in their seed only are the seeds of one row.
"""

from pathlib import Path

from absl import flags

import rcirl_jax
from rcirl_jax.cli.running import provenance, run
from rcirl_jax.evaluation.ranking.report import to_json
from rcirl_jax.runtime.atomic_files import write_json
from rcirl_jax.runtime.executors import make_executor

_WEIGHTS = flags.DEFINE_list("weights", None, "files, with commas", required=True)
_DATA = flags.DEFINE_string("data", None, "dataset", required=True)
_OUTPUT = flags.DEFINE_string("output", None, "JSON to write", required=True)
_HORIZON = flags.DEFINE_float("horizon", 5.0, "s at which distances are taken")
_SPLIT = flags.DEFINE_enum("split", "test", ["test", "train"], "scenes to rank")
_FILTER = flags.DEFINE_bool("drop_collisions", False, "rank what meets nothing only")
_WORKERS = flags.DEFINE_integer("workers", 1, "processes at once")


def main() -> None:
    """Ranks, prints the table with intervals, writes it."""
    dataset = rcirl_jax.open_dataset(_DATA.value)
    report = rcirl_jax.rank(
        _WEIGHTS.value,
        dataset,
        horizon_s=_HORIZON.value,
        split=_SPLIT.value,
        drop_collisions=_FILTER.value,
        executor=make_executor("local", workers=_WORKERS.value),
    )
    print(rcirl_jax.format_report(report))
    made_by = {**provenance(_WEIGHTS.value), "data_hash": dataset.hash}
    write_json(Path(_OUTPUT.value), {**to_json(report), "made_by": made_by})
    print(f"written: {_OUTPUT.value}")


if __name__ == "__main__":
    run(main)
