"""The report of a tuning run: one HTML file that needs no other, verdict first."""

import dataclasses
import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import tqdm

from rcirl_jax.data.quality import format_quality
from rcirl_jax.data.store.dataset import Dataset, Demonstrations
from rcirl_jax.evaluation.closed_loop.dial import MEASURES
from rcirl_jax.evaluation.closed_loop.summary import (
    COMFORT_HEADS,
    COMFORT_TITLE,
    PAPER,
    SHORT,
    Rate,
    RowSummary,
    SuiteComparison,
    SuiteReport,
    SuiteRuns,
    comfort_cells,
    summarise,
)
from rcirl_jax.evaluation.gate.types import Check, GateConfig, Verdict
from rcirl_jax.evaluation.gate.words import OUTCOMES, RANKS, TITLES
from rcirl_jax.evaluation.ranking.metrics import METRICS
from rcirl_jax.evaluation.ranking.report import (
    BASELINE_ROWS,
    SIGNIFICANT,
    RankingReport,
    format_table,
)
from rcirl_jax.evaluation.statistics import CONFIDENCE
from rcirl_jax.export.forms import own_weights
from rcirl_jax.export.loading import features_of, own_sampler_of
from rcirl_jax.export.reader import Reward
from rcirl_jax.export.sweep import table as sweep_table
from rcirl_jax.report.charts import (
    dial_picture,
    forest_axis,
    forest_cell,
    sweep_picture,
    time_curves,
)
from rcirl_jax.report.features import features_view
from rcirl_jax.report.frames import draw_frames, draw_training
from rcirl_jax.report.pages import (
    TERMS,
    Table,
    facts_text,
    interval,
    number,
    part,
    picture,
    write_page,
)
from rcirl_jax.report.player import SCRIPT, case_lines, player_data
from rcirl_jax.report.replays import Replay
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.simulation.metrics import COLUMNS

NUM_FRAMES = 2  # example scenes
CONTENTS = (
    ("verdict", "Verdict"),
    ("own_terms", "The weights of your own terms"),
    ("cases", "Cases"),
    ("likeness", "Nearer to the human"),
    ("decided", "How much the learned part decides"),
    ("dial", "How strongly the learned value counts"),
    ("checks", "What was tested"),
    ("families", "Families of cases"),
    ("suite", "Closed loop: the paper's table"),
    ("ranking", "Ranking of held-out human driving"),
    ("features", "What the reward wants"),
    ("gamma", "Time weights"),
    ("frames", "Example scenes"),
    ("training", "Training"),
    ("data", "Data"),
    ("sweep", "Sweep"),
    ("provenance", "Provenance"),
    ("terms", "Terms"),
)
RANKED = ("percentile_rank", "top1_fde", "top3_fde", "mrr", "crash_rate", "miss")
WIDTH = 118  # characters of preformatted tables
LEVEL = f"{100.0 * CONFIDENCE:g} %"
DECISIONS = {  # classes of the decisions
    "ship": "ship",
    "do not ship": "refused",
    "no difference": "refused",
    "could not judge": "open",
}
SAFETY = {"fail": "refused", "open": "open"}  # of the card, by the worst outcome
# families have a section of their own
KINDS = (
    "safety",
    "recorded traffic",
    "no loss",
    "trivial baselines",
    "likeness",
    "gain",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TuningReport:
    """All that a tuning run has found."""

    verdict: Verdict
    gate: GateConfig
    suite: SuiteRuns  # the first row is the candidate
    incumbent: str  # its row in `suite`
    ranking: RankingReport
    # "candidate" first and, where it is learned, "incumbent"
    rewards: Mapping[str, Reward]
    dataset: Demonstrations  # its held-out scenes are shown
    replays: Sequence[Replay]
    workdir: Path | None  # run whose training curve is drawn
    sweep: Mapping | None  # contents of sweep.json
    dial: Mapping | None  # contents of dial.json
    decided: Mapping | None  # contents of decided.json
    likeness: str  # table of held-out drives; "" without
    training_runs: int  # of which the candidate is the median one
    # why numbers may be worth nothing, by the anchor of their section
    warnings: Mapping[str, Sequence[str]]
    # provenance: flags, commit, versions, hashes by stage
    facts: Mapping[str, object]


def write_tuning_page(path: Path, report: TuningReport) -> Path:
    """Write the page; leave nothing else behind.

    Args:
      path: HTML file.
      report: what it shows.

    Raises:
      InputError: a held-out split with fewer than two vehicles.
    """
    suite, workdir = summarise(report.suite), report.workdir
    reward = next(iter(report.rewards.values()))
    sampler = own_sampler_of([reward], SamplerConfig(mode=reward.mode))
    hidden, quality = len(reward.kernels) > 1, ""
    if isinstance(report.dataset, Dataset):
        quality = format_quality(report.dataset.manifest.quality)
    own = own_weights(reward) if features_of(reward).own and not hidden else {}
    without = {"training": not workdir, "dial": not report.dial, "own_terms": not own}
    without["decided"] = not report.decided
    shown = [entry for entry in CONTENTS if not without.get(entry[0])]
    margins = [
        (name.replace("_", " "), f"{100.0 * value:g} %")
        for name, value in report.gate.margins.items()
    ]
    verdict, rows = report.verdict, (next(iter(suite.rows)), report.incumbent)
    sections: dict[str, Callable[[], object]] = {
        "own_terms": lambda: Table(
            caption="Only the ratios of weights decide; their geometric mean is kept",
            heads=("own term", "today", "tuned", "times"),
            rows=[
                (name, f"{was:.4g}", f"{now:.4g}", number(now / was, 2))
                for name, (was, now) in own.items()
            ],
        ),
        "cards": lambda: cards(verdict, suite, report.incumbent),
        "cases": lambda: case_lines(report.suite, report.incumbent, report.replays),
        "replays": lambda: player_data(report.replays),
        "decided": lambda: decided_tables(report.decided),
        "dial": lambda: dial_view(report.dial),
        "checks": lambda: checks_tables(verdict),
        "margins": lambda: Table(
            caption="Margins, declared before",
            heads=("", ""),
            rows=[*margins, ("primary metrics", ", ".join(report.gate.primary))],
        ),
        "families": lambda: families_tables(verdict),
        "suite": lambda: suite_view(suite, rows),
        "ranking": lambda: ranking_view(report.ranking),
        "features": lambda: features_view(
            report.dataset, report.rewards, report.incumbent
        ),
        "gamma": lambda: _gamma(report.rewards),
        "frames": lambda: _drawn(
            lambda to: draw_frames(report.dataset, reward, sampler, to, NUM_FRAMES)
        ),
        "training": lambda: _drawn(
            lambda to: draw_training(workdir, to) if workdir else []
        ),
        "data": lambda: {"quality": quality, "hash": report.dataset.hash},
        "sweep": lambda: _sweep(report.sweep),
        "provenance": lambda: _provenance(report),
    }
    bar = tqdm.tqdm(sections.items(), desc="draw the report", unit="section")
    return write_page(
        path,
        "tuning.html",
        SCRIPT,
        title=f"Tuning report: {verdict.decision}",
        contents=shown,
        level=LEVEL,
        terms=TERMS,
        runs=report.training_runs,
        incumbent=report.incumbent,
        verdict=verdict,
        kind=DECISIONS[verdict.decision],
        likeness=report.likeness,
        warnings=report.warnings,
        headings=dict(CONTENTS),
        **{name: make() for name, make in bar},
    )


def _drawn(draw: Callable[[Path], list[tuple[Path, str]]]) -> list[dict]:
    """Return pictures as data; the folder that they are drawn into is removed."""
    with tempfile.TemporaryDirectory() as folder:
        return [picture(path, caption) for path, caption in draw(Path(folder))]


def cards(
    verdict: Verdict, suite: SuiteReport, incumbent: str
) -> list[dict[str, object]]:
    """Return five cards: cases, nearer to the human, safety, comfort, progress."""
    new = len(verdict.new_faults)
    mine, theirs = next(iter(suite.rows.values())), suite.rows[incumbent]
    outcomes = {c.outcome for c in verdict.checks if c.kind == "safety"}
    more = mine.at_fault > theirs.at_fault and outcomes == {"pass"}
    return [
        {
            "title": "Cases driven",
            "value": f"{verdict.cases:,}",
            "words": f"of {verdict.families} families, {new} with a new fault",
            "kind": DECISIONS[verdict.decision],
        },
        _amount(verdict, "Nearer to the human", ("likeness",), "on held-out drives"),
        {
            "title": "Safety",
            "value": f"{mine.at_fault} / {theirs.at_fault}",
            "words": "at-fault collisions, candidate / incumbent; red lights "
            f"{mine.red_lights} / {theirs.red_lights}, stop signs {mine.stop_signs} / "
            f"{theirs.stop_signs}{'; no more than the margin allows' if more else ''}",
            "kind": next(
                (SAFETY[x] for x in ("fail", "open") if x in outcomes), "ship"
            ),
        },
        _amount(
            verdict,
            "Comfort",
            ("rms_a", "rms_j"),
            f"less RMS acceleration / RMS jerk than {incumbent}",
        ),
        _amount(verdict, "Progress", ("progress",), f"of {incumbent}'s"),
    ]


def _amount(
    verdict: Verdict, title: str, names: Sequence[str], words: str
) -> dict[str, object]:
    """Return a card on checks of an amount, coloured by the worst outcome.

    It is green where the verdict calls the amount better, which Holm's correction may
    refuse to an interval above 0.
    """
    ranked = ("gain", "likeness", "no loss", "trivial baselines")
    known = {
        name: [c for c in verdict.checks if c.name == name and c.measured]
        for name in names
    }
    found = [
        min(checks, key=lambda c: ranked.index(c.kind))
        for checks in known.values()
        if checks
    ]
    if not found:
        return {"title": title, "value": "–", "words": "not measured", "kind": "open"}
    values = " / ".join(number(100.0 * c.difference, 1, signed=True) for c in found)
    ends = "; ".join(
        f"[{number(100.0 * c.low, 1)}, {number(100.0 * c.high, 1)}]" for c in found
    )
    every = [c for checks in known.values() for c in checks]
    kind = "refused" if any(c.outcome == "fail" for c in every) else "open"
    if kind == "open" and all(c.low > 0.0 for c in found):
        if all(c.outcome == "pass" for c in found):
            kind = "ship"
        else:
            words = f"{words}, not certain among so many tests"
    return {
        "title": title,
        "value": f"{values} %",
        "words": f"{words} {ends}",
        "kind": kind,
    }


def decided_tables(decided: Mapping | None) -> list[Table]:
    """Return shares of plans that differ from the own cost's, by family and site."""
    if decided is None:
        return []

    def cells(name: str, one: Mapping) -> tuple[str, ...]:
        share = f"{100.0 * one['share']:.0f} %"
        if one["low"] is not None:
            share = interval((one["share"], one["low"], one["high"]), 0, 100.0) + " %"
        return name, share, number(one["apart_m"], 1), f"{one['moments']:,}"

    heads = ("", f"plans that differ [{LEVEL}]", "apart after 5 s, m", "moments")
    made = []
    for part_, title in (("sites", "Held-out recordings"), ("families", "The suite")):
        every, *rest = (cells(*item) for item in decided[part_].items())
        rest.sort(key=lambda row: -decided[part_][row[0]]["share"])
        rows = [every, *rest] if len(rest) > 1 else rest
        made.append(Table(caption=title, heads=heads, rows=rows, marked=["all"]))
    return made


def dial_view(dial: Mapping | None) -> dict | None:
    """Return what each setting of the dial drives like, and differs from setting 0."""
    if dial is None:
        return None
    settings = dial["settings"]
    heads = [f"{how.title}, {how.unit}" for how in MEASURES.values()]

    def rows(cell: Callable[[Mapping, int], str], some: Sequence[Mapping]) -> list:
        cells = [
            [cell(one["measures"][name], how.digits) for name, how in MEASURES.items()]
            for one in some
        ]
        return [(f"{x['dial']:g}", *row) for x, row in zip(some, cells, strict=True)]

    def value(found: Mapping, digits: int) -> str:
        return interval((found["value"], found["low"], found["high"]), digits)

    def difference(found: Mapping, digits: int) -> str:
        apart = found["minus_own"]
        low, high = (
            math.nan if apart[x] is None else apart[x] for x in ("low", "high")
        )
        return interval((apart["mean"], low, high), digits, signed=True)

    return {
        **dial,
        "picture": dial_picture(settings),
        "files": [one["file"] for one in settings if one["dial"] not in (0.0, 1.0)],
        "tables": [
            Table(
                caption=f"Each setting [{LEVEL}]; setting 1 is the candidate",
                heads=("dial", *heads),
                rows=rows(value, settings),
                marked=["1"],
            ),
            Table(
                caption="Minus the own cost alone, on the same drives "
                f"[{LEVEL}, each for itself]",
                heads=("dial", *heads),
                rows=rows(difference, settings[1:]),
                marked=["1"],
            ),
        ],
    }


def checks_tables(verdict: Verdict) -> list[Table]:
    """Return checks over all cases, a forest plot for each kind."""
    tables = []
    for kind in KINDS:
        checks = [check for check in verdict.checks if check.kind == kind]
        if checks:
            tables.append(forest(TITLES[kind], checks, [c.title for c in checks]))
    return tables


def forest(title: str, checks: Sequence[Check], names: Sequence[str]) -> Table:
    """Return checks as rows of a forest plot on one axis, with their numbers."""
    measured = [check for check in checks if check.measured]
    limit = max(
        [
            0.1,
            *(100.0 * max(abs(c.low), abs(c.high), c.margin or 0.0) for c in measured),
        ]
    )
    rows: list[Sequence[object]] = [("", forest_axis(limit, "%"), "", "", "")]
    failing = []
    for name, check in zip(names, checks, strict=True):
        word, kind = outcome_of(check)
        said = part("outcome", kind, word, check.note if check.measured else "")
        if not check.measured:
            rows.append((name, "", "not measured", check.note, said))
            continue
        found = 100.0 * check.difference, 100.0 * check.low, 100.0 * check.high
        numbers = interval(found, 2, signed=True) + " %"
        if kind == "fail":
            failing.append(name)
        cell = forest_cell(
            found,
            limit=limit,
            margin=None if check.margin is None else 100.0 * check.margin,
            failed=kind == "fail",
            words=f"{name}: {numbers}, {word}",
        )
        # the margin, cases that only one of them passes, and the p value
        margin = "" if check.margin is None else f"−{100.0 * check.margin:g} %"
        pairs = "" if check.lost is None else f"+{check.gained} −{check.lost}"
        p = "" if check.p is None else _p(check.p)
        rest = ", ".join(filter(None, (margin, pairs, p)))
        rows.append((name, cell, numbers, rest, said))
    heads = ("", "", f"difference [{LEVEL}]", "margin, cases, p", "")
    return Table(caption=title, heads=heads, rows=rows, kind="forest", marked=failing)


def outcome_of(check: Check) -> tuple[str, str]:
    """Return word and class; a missing gain is no failure of the gate."""
    if check.kind != "gain" or check.outcome == "fail":
        return OUTCOMES[check.outcome], check.outcome
    if check.outcome == "pass":
        return "better", "pass"
    worse = check.difference < 0.0 and (check.p or 0.0) < SIGNIFICANT
    return ("worse", "open") if worse else ("no difference", "open")


def _p(p: float) -> str:
    return f"p {p:.3f}" if p >= 0.001 else "p < 0.001"


def families_tables(verdict: Verdict) -> list[Table]:
    """Return clean drives and progress per family, the worst first."""
    tables = []
    for kind in ("clean drives", "progress"):
        checks = [
            check
            for check in verdict.checks
            if check.kind == "families" and check.name.endswith(f", {kind}")
        ]
        checks.sort(key=lambda c: (RANKS[c.outcome], c.difference))
        if checks:
            names = [check.title.removesuffix(f": {kind}") for check in checks]
            tables.append(forest(kind.capitalize(), checks, names))
    return tables


def suite_view(suite: SuiteReport, marked: Sequence[str]) -> dict:
    """Return the paper's table per case and per sample, safety, differences."""
    lead = (
        f"{suite.cases:,} cases of {len(suite.families)} groups; {suite.preventable:,} "
        f"preventable by a careful driver, {suite.trivial:,} trivial."
    )
    heads = ("", *(SHORT[name] for name in COLUMNS))
    paper = [(name, *(f"{x:.2f}" for x in row)) for name, row in PAPER.items()]
    tables = []
    for field, title in (
        ("per_case", "Per case: every sample inside the bound, no at-fault collision"),
        ("per_sample", "Per sample: 10 Hz; intervals take samples for independent"),
    ):
        rows = [
            (name, *(_rate(getattr(row, field)[c]) for c in COLUMNS))
            for name, row in suite.rows.items()
        ]
        found = Table(caption=title, heads=heads, rows=[*rows, *paper], marked=marked)
        tables.append(found)
    rows = [(name, *comfort_cells(row)) for name, row in suite.rows.items()]
    heads = ("", *COMFORT_HEADS)
    tables.append(Table(caption=COMFORT_TITLE, heads=heads, rows=rows, marked=marked))
    tables.append(_safety(suite.rows, suite.reference, marked))
    if suite.comparisons:
        tables.append(_comparisons(suite.comparisons))
    return {"lead": lead, "tables": tables}


def _rate(rate: Rate) -> str:
    if rate.bound is not None:
        digits = 2 if rate.bound < 0.9999 else 4
        return f"100 (≥ {100.0 * rate.bound:.{digits}f})"
    low, high = 100.0 * rate.low, 100.0 * rate.high
    return f"{100.0 * rate.rate:.2f} [{low:.1f}, {high:.1f}]"


def _safety(
    rows: Mapping[str, RowSummary], reference: str, marked: Sequence[str]
) -> Table:
    heads = (
        "", "at-fault collisions", "preventable", "with pedestrians, cyclists",
        "collisions", "red lights", "stop signs", "off road", "progress",
        f"nuPlan [{LEVEL}]",
    )  # fmt: skip
    body = [
        (
            name,
            row.at_fault,
            row.at_fault_preventable,
            row.at_fault_vru,
            row.collisions,
            row.red_lights,
            row.stop_signs,
            row.off_road,
            f"{100.0 * row.progress_ratio:.1f} %",
            interval((row.nuplan, row.nuplan_low, row.nuplan_high), 1, scale=100.0),
        )
        for name, row in rows.items()
    ]  # fmt: skip
    title = f"Safety (counts) and progress, % of {reference}'s"
    return Table(caption=title, heads=heads, rows=body, marked=marked)


def _comparisons(comparisons: Sequence[SuiteComparison]) -> Table:
    """Return the first row minus every other; call none what is not significant."""
    first = comparisons[0].a
    heads = ("", *(SHORT[name] for name in COLUMNS), "progress, m", "nuPlan")
    rows = []
    for one in comparisons:
        cells: list[object] = [one.b]
        for name in COLUMNS:
            wins, losses, _, p = one.columns[name]
            is_known = p < SIGNIFICANT and one.over_families[name].is_apart
            said = "" if is_known else " no difference"
            cells.append(f"+{wins} −{losses}, {_p(p)}{said}")
        for found, scale in ((one.progress_m, 1.0), (one.nuplan, 100.0)):
            values = (found.mean, found.low, found.high)
            none = "" if found.is_apart else " no difference"
            cells.append(interval(values, 1, scale=scale, signed=True) + none)
        rows.append(cells)
    title = (
        f"{first} against each row on the same cases: drives only it passes, only the "
        "other passes (exact McNemar, Holm over the columns); no difference also where "
        "the interval over families contains 0"
    )
    return Table(caption=title, heads=heads, rows=rows, kind="wrap")


def ranking_view(ranking: RankingReport) -> dict:
    """Return rows and paired differences, and all columns as text."""
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


def _gamma(rewards: Mapping[str, Reward]) -> dict:
    """Return curves of gamma_t over its largest: scale and sign are free."""
    times = next(iter(rewards.values())).times
    rows = {}
    for name, reward in rewards.items():
        gamma = np.asarray(reward.gamma, np.float64)
        sign = -1.0 if gamma.sum() < 0.0 else 1.0
        curve = sign * gamma / max(float(np.abs(gamma).max()), 1e-12)
        rows[name] = np.interp(times, reward.times, curve)
    cells = [
        (f"{t:.2f}", *(number(float(row[i]), 3) for row in rows.values()))
        for i, t in enumerate(times)
    ]
    caption = "gamma over its largest value"
    return {
        "curves": time_curves("gamma", times, rows, caption),
        "table": Table(caption=caption, heads=("t, s", *rows), rows=cells),
    }


def _sweep(sweep: Mapping | None) -> dict | None:
    if sweep is None:
        return None
    caption = "validation over the swept settings, two standard errors over seeds"
    return {
        "pictures": _drawn(
            lambda folder: [(sweep_picture(folder / "sweep.png", sweep), caption)]
        ),
        "text": sweep_table(sweep),
    }


def _provenance(report: TuningReport) -> dict:
    files = [
        (
            name,
            reward.file,
            reward.provenance.get("seed", "not said"),
            reward.mode,
            reward.provenance.get("git_commit", "not said"),
            reward.sha256,
        )
        for name, reward in report.rewards.items()
    ]
    heads = ("reward", "file", "seed", "mode", "commit", "sha256")
    return {
        "table": Table(caption="Weights", heads=heads, rows=files, kind="wrap"),
        "text": facts_text({"dataset_sha256": report.dataset.hash, **report.facts}),
    }
