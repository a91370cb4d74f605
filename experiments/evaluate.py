"""Rank held-out scenes with exported rewards beside all baselines.

    python -m experiments.evaluate --weights=FILE[,FILE...] --data=DATASET \
        --output=ranking.json

Several files are the seeds of one row. Prints the table with intervals.
"""

from pathlib import Path

from absl import flags

from experiments.flags.common import provenance, run
from experiments.flags.executor import executor
from rcirl_jax.api.evidence import rank
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.data.store.resplit import with_tags
from rcirl_jax.evaluation.ranking.format import format_table
from rcirl_jax.evaluation.ranking.table import to_json
from rcirl_jax.runtime.atomic_files import write_json

_WEIGHTS = flags.DEFINE_list("weights", None, "weights files", required=True)
_DATA = flags.DEFINE_string("data", None, "dataset", required=True)
_OUTPUT = flags.DEFINE_string("output", None, "JSON to write")
_HORIZON = flags.DEFINE_float("horizon", 5.0, "s at which distances are taken")
_SPLIT = flags.DEFINE_string("split", "test", "split that is ranked")
_TAGS = flags.DEFINE_list("tags", [], "only scenes with one of these tags")
_FILTER = flags.DEFINE_bool(
    "drop_collisions", False, "rank only candidates that meet nothing, in every row"
)
_WIDTH = flags.DEFINE_integer("width", 118, "columns of the printed table")


def main() -> None:
    """Flags -> one report."""
    dataset = with_tags(open_dataset(_DATA.value), _TAGS.value)
    report = rank(
        _WEIGHTS.value,
        dataset,
        horizon_s=_HORIZON.value,
        split=_SPLIT.value,
        drop_collisions=_FILTER.value,
        executor=executor(),
    )
    print(format_table(report, _WIDTH.value))
    if _OUTPUT.value:
        output = Path(_OUTPUT.value)
        made_by = {**provenance(_WEIGHTS.value), "data_hash": dataset.hash}
        write_json(output, {**to_json(report), "made_by": made_by})
        print(f"report: {output}")


if __name__ == "__main__":
    run(main)
