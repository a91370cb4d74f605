"""The ranking of held-out human driving as tables of the report."""

from collections.abc import Sequence

from rcirl_jax.evaluation.ranking.format import format_table
from rcirl_jax.evaluation.ranking.metrics import METRICS
from rcirl_jax.evaluation.ranking.table import BASELINE_ROWS, SIGNIFICANT, RankingReport
from rcirl_jax.report.pages import Table, interval

RANKED = ("percentile_rank", "top1_fde", "top3_fde", "mrr", "crash_rate", "miss")
WIDTH = 118  # characters of preformatted tables


def ranking_view(ranking: RankingReport) -> dict:
    """Rows and paired differences, and all columns as text."""
    learned = [name for name in ranking.rows if name not in BASELINE_ROWS]
    names = [*learned, *(name for name in BASELINE_ROWS if name in ranking.rows)]
    heads = ["", "seeds"]
    for metric in RANKED:
        how = METRICS[metric]
        better = "higher" if how.higher_is_better else "lower"
        unit = "" if how.unit == "1" else f", {how.unit}"
        heads.append(f"{how.title}{unit} ({better} is better)")
    rows = []
    for name in names:
        cells: list[object] = [name, ranking.runs[name]]
        for metric in RANKED:
            found, scale = ranking.rows[name][metric], _scale(metric)
            values = (found.value, found.low, found.high)
            cells.append(interval(values, 1 if scale > 1.0 else 2, scale))
        rows.append(cells)
    counts = ", ".join(f"{count:,} {name}" for name, count in ranking.counts.items())
    tables = [Table(caption="Rows", heads=heads, rows=rows, marked=learned)]
    return {
        "lead": f"{counts}; distances to the human at {ranking.horizon_s:g} s; "
        f"{100 * ranking.confidence:g} % intervals over vehicles and runs.",
        "tables": tables + _differences(ranking, learned),
        "text": format_table(ranking, WIDTH),
    }


def _scale(metric: str) -> float:
    return 100.0 if METRICS[metric].unit == "%" else 1.0


def _differences(ranking: RankingReport, learned: Sequence[str]) -> list[Table]:
    rows = []
    for one in ranking.comparisons:
        if one.row not in learned or one.metric not in RANKED:
            continue
        found = one.difference
        values = (found.mean, found.low, found.high)
        rows.append(
            (
                f"{one.row} minus {one.reference}",
                METRICS[one.metric].title,
                interval(values, 2, _scale(one.metric), signed=True),
                f"{one.p_holm:.3f}",
                one.verdict,
            )
        )
    if not rows:
        return []
    title = (
        "Paired differences on the same scenes; named where Holm's p is below "
        f"{SIGNIFICANT:g}"
    )
    heads = ("", "", "difference", "p, Holm", "")
    return [Table(caption=title, heads=heads, rows=rows)]
