"""The report of a tuning run: one HTML file that needs no other, verdict first."""

import dataclasses
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import tqdm

from rcirl_jax.data.quality import format_quality
from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.evaluation.closed_loop.files import SuiteRuns
from rcirl_jax.evaluation.gate.types import GateConfig, Verdict
from rcirl_jax.evaluation.ranking.table import RankingReport
from rcirl_jax.export.reader import Reward
from rcirl_jax.export.sweep.result import table as sweep_table
from rcirl_jax.report.charts import time_curves
from rcirl_jax.report.glossary import TERMS
from rcirl_jax.report.pages import Table, facts_text, number, picture, write_page
from rcirl_jax.report.player.player import SCRIPT, player_data
from rcirl_jax.report.player.replays import Replay
from rcirl_jax.report.ranking.frames import draw_frames, draw_training
from rcirl_jax.report.ranking.sweep_picture import sweep_picture
from rcirl_jax.report.tuning.cases import case_lines
from rcirl_jax.report.tuning.features import features_view
from rcirl_jax.report.tuning.ranking import ranking_view
from rcirl_jax.report.tuning.verdict_sections import (
    LEVEL,
    cards,
    checks_tables,
    families_tables,
    margins_table,
    suite_view,
    verdict_view,
)
from rcirl_jax.sampling import SamplerConfig

NUM_FRAMES = 2  # example scenes
CONTENTS = (
    ("verdict", "Verdict"),
    ("cases", "Cases"),
    ("likeness", "Nearer to the human"),
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
    suite, workdir = report.suite.report(), report.workdir
    reward = next(iter(report.rewards.values()))
    sampler = SamplerConfig(mode=str(reward.provenance.get("mode", "speed")))
    shown = [entry for entry in CONTENTS if workdir or entry[0] != "training"]
    verdict, rows = report.verdict, (next(iter(suite.rows)), report.incumbent)
    frames = lambda folder: draw_frames(  # noqa: E731
        report.dataset, reward, sampler, folder, NUM_FRAMES
    )
    training = lambda folder: draw_training(workdir, folder) if workdir else []  # noqa: E731
    sections: dict[str, Callable[[], object]] = {
        "verdict": lambda: verdict_view(verdict),
        "cards": lambda: cards(verdict, suite, report.incumbent),
        "cases": lambda: case_lines(report.suite, report.incumbent, report.replays),
        "replays": lambda: player_data(report.replays),
        "likeness": lambda: report.likeness,
        "checks": lambda: checks_tables(verdict),
        "margins": lambda: margins_table(report.gate),
        "families": lambda: families_tables(verdict),
        "suite": lambda: suite_view(suite, rows),
        "ranking": lambda: ranking_view(report.ranking),
        "features": lambda: features_view(
            report.dataset, report.rewards, report.incumbent
        ),
        "gamma": lambda: _gamma(report.rewards),
        "frames": lambda: _drawn(frames),
        "training": lambda: _drawn(training),
        "data": lambda: _data(report.dataset),
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
        **{name: make() for name, make in bar},
    )


def _drawn(draw: Callable[[Path], list[tuple[Path, str]]]) -> list[dict]:
    """Pictures drawn into a folder that is gone afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        return [picture(path, caption) for path, caption in draw(Path(folder))]


def _gamma(rewards: Mapping[str, Reward]) -> dict:
    """Curves of gamma_t, each over its largest: its scale and sign are free."""
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


def _data(dataset: Demonstrations) -> dict:
    whole = isinstance(dataset, Dataset)
    quality = format_quality(dataset.manifest.quality) if whole else ""
    return {"quality": quality, "hash": dataset.hash}


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
            reward.provenance.get("git_commit", "not said"),
            reward.sha256,
        )
        for name, reward in report.rewards.items()
    ]
    heads = ("reward", "file", "seed", "commit", "sha256")
    return {
        "table": Table(caption="Weights", heads=heads, rows=files, kind="wrap"),
        "text": facts_text({"dataset_sha256": report.dataset.hash, **report.facts}),
    }
