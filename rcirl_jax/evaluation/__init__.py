"""Ranking metrics, honest intervals and the table that shows them."""

from rcirl_jax.evaluation.exact import (
    clopper_pearson,
    holm,
    mcnemar_exact,
    rule_of_three,
)
from rcirl_jax.evaluation.ranking.format import format_table
from rcirl_jax.evaluation.ranking.metrics import (
    Outcomes,
    fit_temperature,
    miss_threshold,
    oracle_fde,
    oracle_scorer,
    random_scorer,
    scene_metrics,
)
from rcirl_jax.evaluation.ranking.table import RankingReport, build_report, to_json
from rcirl_jax.evaluation.statistics import (
    ClusterBootstrap,
    Difference,
    Estimate,
    bootstrap_median,
    combine_seeds,
    paired_difference,
)

__all__ = [
    "ClusterBootstrap",
    "Difference",
    "Estimate",
    "Outcomes",
    "RankingReport",
    "bootstrap_median",
    "build_report",
    "clopper_pearson",
    "combine_seeds",
    "fit_temperature",
    "format_table",
    "holm",
    "mcnemar_exact",
    "miss_threshold",
    "oracle_fde",
    "oracle_scorer",
    "paired_difference",
    "random_scorer",
    "rule_of_three",
    "scene_metrics",
    "to_json",
]
