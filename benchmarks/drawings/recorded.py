"""Recorded scenes: what labels say of them, and what the guard says of a plan."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
from PIL import Image

from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.score import candidates_key
from rcirl_jax.export.guard import Guard
from rcirl_jax.export.loading import open_reward
from rcirl_jax.features import feature_map
from rcirl_jax.planner.rank import ONLINE
from rcirl_jax.report.scene import GRAPH_INCHES, HEIGHT_INCHES, draw_scene
from rcirl_jax.report.style import CHOSEN, CLASS_COLOURS, figure, label, save
from rcirl_jax.sampling import sample
from rcirl_jax.types import Decision, Scene, Tag

DPI, AXIS_INCHES = 130, 0.42  # of `style.save`; words below the graph


def labels(path: Path, data: Sequence[str]) -> None:
    """A cut-in and an overtake: the upper part of two pictures of `rcirl inspect`."""
    wanted = ((Tag.CUT_IN, Decision.YIELD), (Tag.OVERTAKING, Decision.OVERTAKE))
    pictures = []
    with tempfile.TemporaryDirectory() as folder:
        for tag, decision in wanted:
            one, row = _scene_with(data, tag, decision)
            drawn = draw_scene(Path(folder) / f"{tag}.png", one, row)
            pictures.append(Image.open(drawn).convert("RGB"))
    cut = round(DPI * (HEIGHT_INCHES - GRAPH_INCHES[0] + AXIS_INCHES))
    both = Image.new("RGB", (sum(p.width for p in pictures), cut), "white")
    both.paste(pictures[0], (0, 0))
    both.paste(pictures[1], (pictures[0].width, 0))
    both.save(path)


def _scene_with(data: Sequence[str], tag: Tag, decision: Decision) -> tuple:
    """The first scene with a whole future, a tag and a decision, and its row."""
    for name in data:
        dataset = open_dataset(name, verify=False)
        fits = dataset.column("scene.tags")[:, tag] & (dataset.column("future_s") > 7.9)
        fits &= (dataset.column("decisions") == decision).any(axis=1)
        if fits.any():
            row = int(np.argmax(fits))
            return jax.tree.map(lambda x: x[0], dataset.read(np.array([row]))), row
    raise InputError(f"--data: no scene with {tag.name}")


GUARDED = (
    *("velocity", "speed_limit", "acceleration", "jerk", "station"),
    *("follow_distance", "follow_speed", "l", "curvature"),
)


def guard(path: Path, weights: str, data: Sequence[str]) -> None:
    """A plan of a held-out scene beside the training's ranges, also with km/h."""
    reward, dataset = open_reward(weights), open_dataset(data[0], verify=False)
    row = int(dataset.indices("test")[0])
    one = jax.tree.map(lambda x: x[0], dataset.read(np.array([row])))

    @jax.jit
    def look(scene: Scene) -> tuple:
        candidates = sample(candidates_key(row), scene, ONLINE)
        x = feature_map(reward.preset).of_candidates(scene, candidates)
        return x, candidates.feasible

    x, feasible = map(np.asarray, look(one.scene))
    x = x[feasible]
    wrong = x.copy()
    wrong[..., reward.names.index("velocity")] *= 3.6
    watch = Guard(reward)
    made, axes = figure(1, 2, 7.6, 3.2)
    for axis, (plan, title) in zip(
        axes[0], ((x, "as it is"), (wrong, "velocity in km/h")), strict=True
    ):
        verdict = watch.check(plan)
        for place, name in enumerate(GUARDED):
            i = reward.names.index(name)
            span = reward.upper[i] - reward.lower[i]
            low, high = (
                np.clip((b[i] - reward.lower[i]) / span, -0.15, 1.15)
                for b in (watch.low, watch.high)
            )
            values = (plan[..., i] - reward.lower[i]) / span
            axis.barh(-place, high - low, 0.7, low, color="#DDDDDD")
            outside = np.mean((values < low) | (values > high))
            colour = CHOSEN if outside > watch.limits.share else CLASS_COLOURS["follow"]
            axis.plot(
                np.quantile(values, (0.02, 0.98)), [-place] * 2, color=colour, lw=3
            )
            if outside > 0.01:
                axis.text(
                    1.6,
                    -place,
                    f"{100 * outside:.0f} % outside",
                    fontsize=8,
                    va="center",
                )
        answer = (
            "inside" if verdict.in_distribution else f"outside, by {verdict.feature}"
        )
        label(axis, f"{title}: {answer}", "share of the network's range", "")
        axis.set(yticks=-np.arange(len(GUARDED)), xlim=(-0.2, 2.1))
        axis.set_yticklabels(GUARDED if axis is axes[0, 0] else [])
    save(made, path)
