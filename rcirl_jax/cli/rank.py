"""Rank held-out scenes with exported rewards beside all baselines.

    rcirl rank --weights=FILE[,FILE...] --data=DATASET[,DATASET...] --output=FILE

Several files of one loss and shape are the seeds of one row; where two of them have the
same seed, each is a row by the name of its file. Prints the table with intervals.
"""

from pathlib import Path

from absl import flags

from rcirl_jax.api.runs import rank
from rcirl_jax.cli import flags as shared
from rcirl_jax.cli.running import provenance
from rcirl_jax.data.store.dataset import open_datasets
from rcirl_jax.data.store.splits import with_tags
from rcirl_jax.evaluation.ranking.report import format_table, to_json
from rcirl_jax.runtime.atomic_files import write_json

USUAL = ("weights", "data", "output", "horizon", "split", "tags", "workers")
_WEIGHTS = flags.DEFINE_list(
    "weights", None, "weights files, with commas", required=True
)
_DATA = flags.DEFINE_list(
    "data", None, "datasets of `rcirl import`, with commas", required=True
)
_OUTPUT = flags.DEFINE_string(
    "output", None, "JSON to write, beside the table that is printed"
)
_SPLIT = flags.DEFINE_string(
    "split", "test", "test: the held-out scenes; train: those that were learned from"
)
_TAGS = flags.DEFINE_list(
    "tags", [], "only scenes with one of these tags, e.g. lane_change,cut_in"
)
_FILTER = flags.DEFINE_bool(
    "drop_collisions", False, "rank only candidates that meet nothing, in every row"
)
_WIDTH = flags.DEFINE_integer("width", 118, "columns of the printed table")
_HORIZON = shared.horizon()
_EXECUTOR = shared.executor()


def main() -> None:
    """Flags -> one report."""
    dataset = with_tags(open_datasets(_DATA.value), _TAGS.value)
    report = rank(
        _WEIGHTS.value,
        dataset,
        horizon_s=_HORIZON.value,
        split=_SPLIT.value,
        drop_collisions=_FILTER.value,
        executor=_EXECUTOR(),
    )
    print(format_table(report, _WIDTH.value))
    if _OUTPUT.value:
        output = Path(_OUTPUT.value)
        made_by = {**provenance(_WEIGHTS.value), "data_hash": dataset.hash}
        write_json(output, {**to_json(report), "made_by": made_by})
        print(f"report: {output}")
