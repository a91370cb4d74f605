"""The report of a tuning run: one HTML file that needs no other, verdict first."""

import dataclasses
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.scenes.quality import format_quality
from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.evaluation.closed_loop.summary import SuiteReport
from rcirl_jax.evaluation.gate.types import GateConfig, Verdict
from rcirl_jax.evaluation.ranking.format import format_table
from rcirl_jax.evaluation.ranking.metrics import METRICS
from rcirl_jax.evaluation.ranking.table import RIVALS, SIGNIFICANT, RankingReport
from rcirl_jax.evaluation.statistics import Difference
from rcirl_jax.export.reader import Reward
from rcirl_jax.export.sweep.result import table as sweep_table
from rcirl_jax.report import html
from rcirl_jax.report.charts import bars_cell, curves, legend
from rcirl_jax.report.html import facts_text
from rcirl_jax.report.markup import (
    contents,
    folded,
    interval,
    number,
    paragraph,
    picture,
    preformatted,
    section,
    table,
)
from rcirl_jax.report.player.player import head, player, script
from rcirl_jax.report.player.replays import Replay
from rcirl_jax.report.ranking.frames import draw_frames, draw_training
from rcirl_jax.report.ranking.sweep_picture import sweep_picture
from rcirl_jax.report.tuning.contributions import Contributions, contributions
from rcirl_jax.report.tuning.verdict_sections import (
    families_section,
    suite_section,
    verdict_section,
)
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.simulation.rows import RECORDED_HUMAN

NUM_FRAMES = 2  # example frames
RANKED = ("percentile_rank", "top1_fde", "top3_fde", "mrr", "crash_rate", "miss")
WIDTH = 118  # characters of preformatted tables


@dataclasses.dataclass(frozen=True, kw_only=True)
class TuningReport:
    """All that a tuning run has found."""

    verdict: Verdict
    gate: GateConfig
    suite: SuiteReport  # the first row is the candidate
    incumbent: str  # its row in `suite`
    ranking: RankingReport
    # "candidate" first and, where it is learned, "incumbent"
    rewards: Mapping[str, Reward]
    dataset: Demonstrations  # its held-out scenes are shown
    replays: Sequence[Replay]
    workdir: Path | None  # run whose training curve is drawn
    sweep: Mapping | None  # contents of sweep.json
    likeness: str  # table of held-out drives; "" without
    training_runs: int  # of which the candidate is the median one
    # provenance: flags, commit, versions, hashes by stage
    facts: Mapping[str, object]


def write_tuning_page(path: Path, report: TuningReport) -> Path:
    """Write the page; nothing else is left behind.

    Args:
      path: HTML file.
      report: what it shows.

    Raises:
      InputError: a held-out split with fewer than two vehicles.
    """
    parts: list[tuple[str, str, Callable[[], str]]] = [
        ("verdict", "Verdict", lambda: _verdict(report)),
        ("suite", "Closed loop: the paper's table", lambda: _suite(report)),
        ("families", "Families", lambda: families_section(report.verdict)),
        ("worst", "Worst cases, to be played", lambda: _played(report)),
        ("frames", "Example frames", lambda: _frames(report)),
        ("ranking", "Ranking of held-out human driving", lambda: _ranking(report)),
        ("likeness", "Near to the human, in closed loop", lambda: _likeness(report)),
        ("gamma", "Time weights", lambda: _gamma(report)),
        ("features", "What each feature contributes", lambda: _features(report)),
        ("data", "Data", lambda: _data(report.dataset)),
        ("sweep", "Sweep", lambda: _sweep(report.sweep)),
        ("provenance", "Provenance", lambda: _provenance(report)),
    ]
    workdir = report.workdir
    if workdir is not None:
        parts.insert(8, ("training", "Training", lambda: _training(workdir)))
    entries = [(anchor, heading) for anchor, heading, _ in parts]
    sections = [section(anchor, heading, body()) for anchor, heading, body in parts]
    return html.write_page(
        path,
        f"Tuning report: {report.verdict.decision}",
        "A reward learned from human driving, driven in closed loop against the one "
        "in use.",
        [contents(entries), *sections, script()],
        head=head(),
    )


def _compared(report: TuningReport) -> tuple[str, str]:
    return next(iter(report.suite.rows)), report.incumbent


def _verdict(report: TuningReport) -> str:
    played = [replay.case for replay in report.replays]
    runs = report.training_runs
    said = (
        f"The candidate is the median of {runs} training runs."
        if runs > 1
        else "The candidate is one training run: with another seed it may drive "
        "otherwise (--seeds)."
    )
    found = verdict_section(report.verdict, report.gate, report.incumbent, played)
    return found + paragraph(said)


def _suite(report: TuningReport) -> str:
    return suite_section(report.suite, _compared(report))


def _played(report: TuningReport) -> str:
    lead = paragraph(
        "Driven again for this page, every row in the same case. On a CPU these are "
        "the suite's own drives; elsewhere another program rounds the last digit "
        "differently, and traffic can make more of that."
    )
    human = any(d.row == RECORDED_HUMAN for one in report.replays for d in one.drives)
    said = (
        "The last are recorded drives, with the human beside the others; who meets "
        "the planner may leave the log."
        if human
        else "No human drives in these: recorded drives are played where the run has "
        "imported the logs itself."
    )
    return lead + paragraph(said) + player(report.replays)


def _pictures(draw: Callable[[Path], list[tuple[Path, str]]]) -> str:
    """Pictures drawn into a folder that is gone afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        found = draw(Path(folder))
        return "\n".join(picture(path, caption) for path, caption in found)


def _frames(report: TuningReport) -> str:
    reward = next(iter(report.rewards.values()))
    sampler = SamplerConfig(mode=str(reward.provenance.get("mode", "speed")))
    return paragraph(
        "Held-out scenes under the candidate: what the human did, what was sampled, "
        "what the reward chooses."
    ) + _pictures(
        lambda folder: draw_frames(report.dataset, reward, sampler, folder, NUM_FRAMES)
    )


def _training(workdir: Path) -> str:
    return _pictures(lambda folder: draw_training(workdir, folder))


def _ranking(report: TuningReport) -> str:
    ranking = report.ranking
    learned = [name for name in ranking.rows if name not in RIVALS]
    names = [*learned, *(name for name in RIVALS if name in ranking.rows)]
    heads = ["", "seeds"]
    for metric in RANKED:
        how = METRICS[metric]
        better = "higher" if how.higher_is_better else "lower"
        unit = "" if how.unit == "1" else f", {how.unit}"
        heads.append(f"{how.title}{unit} ({better})")
    rows = []
    for name in names:
        cells: list[object] = [name, ranking.runs[name]]
        for metric in RANKED:
            found, scale = ranking.rows[name][metric], _scale(metric)
            values = (found.value, found.low, found.high)
            cells.append(interval(values, 1 if scale > 1.0 else 2, scale=scale))
        rows.append(cells)
    counts = ", ".join(f"{count:,} {name}" for name, count in ranking.counts.items())
    return "\n".join(
        [
            paragraph(
                f"{counts}; distances to the human at {ranking.horizon_s:g} s; "
                f"{100 * ranking.confidence:g} % intervals over vehicles and runs."
            ),
            table("Rows", heads, rows, marked=learned),
            _ranking_differences(ranking, learned),
            folded("All columns and differences", _all_columns(ranking)),
        ]
    )


def _scale(metric: str) -> float:
    return 100.0 if METRICS[metric].unit == "%" else 1.0


def _all_columns(ranking: RankingReport) -> str:
    return preformatted(format_table(ranking, WIDTH), "ranking, all columns")


def _ranking_differences(ranking: RankingReport, learned: Sequence[str]) -> str:
    rows = []
    for one in ranking.comparisons:
        if one.row not in learned or one.metric not in RANKED:
            continue
        scale, found = _scale(one.metric), one.difference
        values = (found.mean, found.low, found.high)
        rows.append(
            (
                f"{one.row} minus {one.reference}",
                METRICS[one.metric].title,
                interval(values, 2, scale=scale, signed=True),
                f"{one.p_holm:.3f}",
                one.verdict,
            )
        )
    if not rows:
        return ""
    heads = ("", "", "difference", "p, Holm", "")
    title = (
        "Paired differences on the same scenes; named where Holm's p is below "
        f"{SIGNIFICANT:g}"
    )
    return table(title, heads, rows)


def _likeness(report: TuningReport) -> str:
    """Held-out recordings, driven: what a reward is for."""
    if not report.likeness:
        return paragraph("Not measured.")
    lead = paragraph(
        "Every row drives held-out recordings from the human's own state; how far from "
        "the human it is along the road, nearest row first."
    )
    return lead + preformatted(report.likeness, "held-out drives")


def _gamma(report: TuningReport) -> str:
    """Curves of gamma_t, each over its largest: its scale and sign are free."""
    times = next(iter(report.rewards.values())).times
    rows = {}
    for name, reward in report.rewards.items():
        gamma = np.asarray(reward.gamma, np.float64)
        sign = -1.0 if gamma.sum() < 0.0 else 1.0
        curve = sign * gamma / max(float(np.abs(gamma).max()), 1e-12)
        rows[name] = np.interp(times, reward.times, curve)
    heads = ("t, s", *rows)
    cells = [
        (f"{t:.2f}", *(number(float(row[i]), 3) for row in rows.values()))
        for i, t in enumerate(times)
    ]
    alone = _alone(report) if len(report.rewards) == 1 else ""
    return (
        alone
        + paragraph(
            "How much each time of a plan counts: learned gamma_t over its largest "
            "(scale and sign are free)."
        )
        + curves(times, rows, "gamma over time", ("t, s", "gamma"))
        + folded("Numbers", table("gamma_t over its largest", heads, cells))
    )


def _features(report: TuningReport) -> str:
    found = contributions(report.dataset, report.rewards)
    lead = paragraph(
        "Share of each feature in the value difference of the human and sampled "
        f"candidates: mean absolute contribution (integrated gradients), "
        f"{found.scenes} held-out scenes of {found.vehicles} vehicles; 95 % intervals "
        "over vehicles, not adjusted for the number of features."
    )
    for name, reward in report.rewards.items():
        if reward.unsupported:
            lead += paragraph(
                f"Without effect in the {name}, for they never vary in its training "
                f"data: {', '.join(reward.unsupported)}."
            )
        if said := anchor_words(name, reward):
            lead += paragraph(said)
    if len(report.rewards) == 1:
        lead += _alone(report)
    return lead + legend(report.rewards) + _contributions(found, list(report.rewards))


def anchor_words(name: str, reward: Reward) -> str:
    """One sentence on what an anchored reward drives by; "" of another one."""
    anchor = reward.anchor
    if anchor is None:
        return ""
    return (
        f"The {name} is anchored: it drives by V_total = own cost ({anchor.incumbent}, "
        f"negated) + gain V, with a gain from {anchor.low:g}, where nothing like the "
        f"scene was recorded, to {anchor.high:g}, where all of it was."
    )


def _alone(report: TuningReport) -> str:
    """Why nothing is compared."""
    return paragraph(
        f"The incumbent, {report.incumbent}, is no weights file: it has neither gamma "
        "nor these features, so what changed shows in the drives only."
    )


def _contributions(found: Contributions, names: Sequence[str]) -> str:
    heads = ["feature", *names]
    two = len(names) > 1
    if two:
        heads += [f"{names[0]} minus {names[1]}, points", ""]
    shares = [x.value for row in found.rows for x in row.share.values() if x]
    limit = max([*shares, 1e-9])
    rows, without = [], []
    for row in found.rows:
        if not any(one and one.high > 0.0 for one in row.share.values()):
            without.append(row.feature)
            continue
        cells: list[object] = [row.feature]
        for name in names:
            one = row.share[name]
            cells.append(
                "not a feature of it"
                if one is None
                else interval((one.value, one.low, one.high), 1, scale=100.0) + " %"
            )
        if two:
            cells += _changed(row.difference)
        values = [None if (x := row.share[n]) is None else x.value for n in names]
        rows.append([*cells, bars_cell(values, limit, f"{row.feature}: shares")])
    silent = paragraph(f"No share in any of these scenes: {', '.join(without)}.")
    return table("Contributions", [*heads, ""], rows, kind="bars") + (
        silent if without else ""
    )


def _changed(d: Difference | None) -> list[object]:
    if d is None:
        return ["", ""]
    word = "no difference"
    if not d.low <= 0.0 <= d.high:
        word = "counts more" if d.mean > 0.0 else "counts less"
    return [interval((d.mean, d.low, d.high), 1, scale=100.0, signed=True), word]


def _data(dataset: Demonstrations) -> str:
    if not isinstance(dataset, Dataset):
        return paragraph(
            "Several datasets joined: see the page of each one (experiments."
            f"inspect_data). sha256 of the whole: {dataset.hash}"
        )
    return preformatted(format_quality(dataset.manifest.quality), "data quality")


def _sweep(sweep: Mapping | None) -> str:
    if sweep is None:
        return paragraph(
            "No sweep: one configuration was trained (--sweep=FOLDER shows one of "
            "experiments.sweep)."
        )
    caption = "validation over the swept settings, two standard errors over seeds"
    return _pictures(
        lambda folder: [(sweep_picture(folder / "sweep.png", sweep), caption)]
    ) + preformatted(sweep_table(sweep), "sweep, all configurations")


def _provenance(report: TuningReport) -> str:
    files = [
        (
            name,
            reward.file,
            str(reward.provenance.get("seed", "not said")),
            str(reward.provenance.get("git_commit", "not said")),
            reward.sha256,
        )
        for name, reward in report.rewards.items()
    ]
    heads = ("reward", "file", "seed", "commit", "sha256")
    facts = {"dataset_sha256": report.dataset.hash, **report.facts}
    return table("Weights", heads, files) + preformatted(
        facts_text(facts), "provenance"
    )
