"""Pictures of example frames under an exported reward."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.data.store import Dataset
from rcirl_jax.evaluation.score import EVALUATION_SEED
from rcirl_jax.export.reader import Reward
from rcirl_jax.features import feature_map
from rcirl_jax.report import plots
from rcirl_jax.sampling import SamplerConfig, sample
from rcirl_jax.train.step import human_of
from rcirl_jax.types import Decision, Tag

WANTED = (
    Tag.STOPPING,
    Tag.STARTING,
    Tag.CUT_IN,
    Tag.YIELDING,
    Tag.OVERTAKING,
    Tag.RED_LIGHT,
)


def pick_frames(dataset: Dataset, count: int) -> np.ndarray:
    """Held-out rows to draw: one per interesting tag, then any."""
    index = dataset.indices("test")
    rows = dataset.read(index)
    tags = np.asarray(rows.scene.tags)
    follows = np.any(np.asarray(rows.decisions) == Decision.FOLLOW, axis=1)
    full = np.asarray(rows.future_s) > 7.0
    chosen: list[int] = []
    for tag in WANTED:
        found = np.flatnonzero(tags[:, tag] & follows & full)
        chosen += [int(i) for i in found[:1] if int(i) not in chosen]
    chosen += [i for i in range(index.size) if i not in chosen]
    return index[np.array(chosen[:count], int)]


def draw_frames(
    dataset: Dataset, reward: Reward, sampler: SamplerConfig, folder: Path, count: int
) -> list[tuple[Path, str]]:
    """The paper's example-frame figure for some held-out scenes.

    Returns:
      (PNG, caption) per frame: the first two also as a large ST graph.
    """
    features = feature_map(reward.preset)
    pictures = []
    for number, row in enumerate(pick_frames(dataset, count)):
        rows = dataset.read(np.array([row]))
        one = jax.tree.map(lambda x: jnp.asarray(x[0]), rows)
        key = jax.random.fold_in(jax.random.key(EVALUATION_SEED), int(row))
        candidates = sample(key, one.scene, sampler)
        human = human_of(one, sampler)
        x = np.asarray(features.of_candidates(one.scene, candidates))
        x_human = np.asarray(features(one.scene, human))
        valid = np.asarray(one.scene.time_valid)
        values = reward.value(x, np.broadcast_to(valid, x.shape[:2]))
        feasible = np.asarray(candidates.feasible)
        chosen = int(np.argmax(np.where(feasible, values, -np.inf)))
        drawn = one.replace(human=human)
        names = [tag.name.lower() for tag in Tag if bool(one.scene.tags[tag])]
        caption = (
            f"scene {int(row)} ({', '.join(names) or 'no tag'}): human (black), chosen "
            "(orange, dashed) and candidates (grey)"
        )
        path = folder / f"frame_{number}.png"
        plots.example_frame(
            path,
            drawn,
            candidates,
            chosen,
            human_features=x_human,
            chosen_features=x[chosen],
            names=features.names,
        )
        pictures.append((path, caption))
        if number == 0:
            path = folder / "st_graph.png"
            plots.st_graph(path, drawn, candidates, chosen)
            pictures.append((path, f"station-time graph of scene {int(row)}"))
    return pictures


def draw_training(workdir: Path, folder: Path) -> list[tuple[Path, str]]:
    """Loss and pair accuracy over the steps of a run, from metrics.jsonl."""
    lines = (workdir / "metrics.jsonl").read_text().splitlines()
    rows = [json.loads(line) for line in lines]
    steps = np.array([row["step"] for row in rows])
    series = {
        name: np.array([row[name] or np.nan for row in rows], float)
        for name in ("loss", "pair_accuracy", "queries_per_s")
    }
    path = folder / "training.png"
    plots.training_curve(path, steps, series)
    return [(path, "training: loss, pairs won by the human, queries per second")]
