"""Scenes to be tuned on, and what a row of an evaluation chooses in them."""

import numpy as np

from rcirl_jax.evaluation.ranking.score import score_scenes


def scored_baselines(rows, sampler, tuned):
    """`score_scenes` of the baselines alone, at 8 s."""
    return score_scenes(
        rows,
        np.arange(rows.future_s.size),
        preset="paper21",
        sampler=sampler,
        horizon_s=8.0,
        scorers={},
        futures="recorded",
        tuned=tuned,
    )


def mean_chosen_fde(scored, name):
    """m, of the feasible candidate that a row values most."""
    values = np.where(scored.feasible, scored.values[name], -np.inf)
    return scored.fde[np.arange(len(values)), values.argmax(axis=1)].mean()
