"""Scenes to be tuned on, and what a row of an evaluation chooses in them."""

import jax
import numpy as np

from rcirl_jax.evaluation.ranking.score import score_scenes
from tests.helpers.scenes import T, demonstration


def long_rows(count):
    """Demonstrations in random scenes, all of 8 s."""
    rows = jax.tree.map(lambda *x: np.stack(x), *map(demonstration, range(count)))
    scene = rows.scene.replace(time_valid=np.ones((count, T), bool))
    return rows.replace(scene=scene, future_s=np.full(count, 8.0, np.float32))


def scored_rivals(rows, sampler, tuned):
    """`score_scenes` of the rivals alone, at 8 s."""
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
