"""Scenes to be tuned on, and what a row of an evaluation chooses in them."""

import dataclasses

import numpy as np

from rcirl_jax.evaluation.ranking.score import RankingSetup, score_scenes


def scored_baselines(rows, sampler, tuned):
    """`score_scenes` of the baselines alone, at 8 s."""
    runs = {name: [baseline] for name, baseline in tuned.items()}
    setup = RankingSetup(sampler=sampler, horizon_s=8.0, futures="recorded", tuned=runs)
    scored = score_scenes(rows, np.arange(rows.future_s.size), setup, {})
    values = {name.removesuffix("#0"): x for name, x in scored.values.items()}
    return dataclasses.replace(scored, values=values)


def mean_chosen_fde(scored, name):
    """m, of the feasible candidate that a row values most."""
    values = np.where(scored.outcomes.feasible, scored.values[name], -np.inf)
    return scored.outcomes.fde[np.arange(len(values)), values.argmax(axis=1)].mean()
