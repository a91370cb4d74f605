"""The ranking report as a page: tables, example frames, gamma_t, data quality."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.scenes.quality import format_quality
from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.evaluation.ranking.format import format_table
from rcirl_jax.evaluation.ranking.table import RankingReport
from rcirl_jax.export.loading import row_name
from rcirl_jax.export.reader import Reward
from rcirl_jax.report import html
from rcirl_jax.report.ranking import plots
from rcirl_jax.report.ranking.frames import draw_frames, draw_training
from rcirl_jax.sampling import SamplerConfig

NUM_FRAMES = 4  # example frames drawn


def write_ranking_page(
    output: Path,
    *,
    dataset: Dataset,
    rewards: Sequence[Reward],
    report: RankingReport,
    workdir: Path | None,
    facts: Mapping[str, object],
) -> Path:
    """Draw everything into the page's folder and write report.html.

    Args:
      output: HTML file; PNGs go into `figures` beside it.
      dataset: the dataset that was ranked.
      rewards: the learned rewards (seeds); the first one chooses in the frames.
      report: of `evaluate_ranking`.
      workdir: training run whose curve is drawn, if any.
      facts: what made the page: commit, versions, flags.
    """
    folder = output.parent / "figures"
    sampler = SamplerConfig(mode=str(rewards[0].provenance.get("mode", "speed")))
    gammas: dict[str, list[np.ndarray]] = {}
    for reward in rewards:
        gammas.setdefault(row_name(reward), []).append(reward.gamma)
    gamma_path = plots.discount_factors(
        folder / "gamma.png", {name: np.stack(rows) for name, rows in gammas.items()}
    )
    frames = draw_frames(dataset, rewards[0], sampler, folder, NUM_FRAMES)
    learned = [(gamma_path, "learned time weights gamma_t (seeds as a band)")]
    if workdir is not None:
        learned += draw_training(workdir, folder)
    trained = "\n".join(
        f"{reward.file}: sha256 {reward.sha256}, commit "
        f"{reward.provenance.get('git_commit')}, seed {reward.provenance.get('seed')}"
        for reward in rewards
    )
    made_by = {**facts, "data_hash": dataset.hash}
    return html.write_page(
        output,
        "Learned reward: ranking of held-out human driving",
        "Candidates of every held-out scene are ranked by the learned reward and by "
        "its rivals; distances are to what the human did.",
        [
            html.table_section("Ranking", format_table(report, 118)),
            html.picture_section("Example frames", frames),
            html.picture_section("What was learned", learned),
            html.table_section("Data", format_quality(dataset.manifest.quality)),
            html.table_section("Weights", trained),
            html.table_section("Made by", html.facts_text(made_by)),
        ],
    )
