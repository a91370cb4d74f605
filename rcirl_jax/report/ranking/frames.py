"""Pictures of example frames under an exported reward."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.evaluation.attribution import attribute
from rcirl_jax.evaluation.ranking.score import candidates_key
from rcirl_jax.export.closed_loop import incumbent_score
from rcirl_jax.export.loading import reward_params
from rcirl_jax.export.reader import Reward
from rcirl_jax.features import feature_map
from rcirl_jax.report.ranking import plots
from rcirl_jax.sampling import SamplerConfig, sample
from rcirl_jax.train.featurise import human_of
from rcirl_jax.train.metrics import read_metrics
from rcirl_jax.types import (
    Candidates,
    Decision,
    Demonstration,
    Scene,
    Tag,
    Trajectory,
)

WANTED = (
    Tag.STOPPING,
    Tag.STARTING,
    Tag.CUT_IN,
    Tag.YIELDING,
    Tag.OVERTAKING,
    Tag.RED_LIGHT,
)


def pick_frames(dataset: Demonstrations, count: int) -> np.ndarray:
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class DrawnFrame:
    """What stands in one example-frame figure."""

    picture: Path
    caption: str
    chosen: int  # candidate with the highest value
    values: np.ndarray  # [K]
    feasible: np.ndarray  # [K] bool
    human_value: float
    human_s: np.ndarray  # [T] m
    chosen_s: np.ndarray  # [T] m
    # feature -> its part of V(chosen) - V(human), over all times
    reasons: dict[str, float]


_attributed = jax.jit(attribute, static_argnames="activation")


@functools.cache
def _sampled(preset: str, sampler: SamplerConfig) -> Callable:
    """One scene -> candidates, human, and the features of both; one program."""
    features = feature_map(preset)

    def made(key: jax.Array, one: Demonstration) -> tuple:
        candidates, human = sample(key, one.scene, sampler), human_of(one, sampler)
        x = features.of_candidates(one.scene, candidates)
        return candidates, human, x, features(one.scene, human)

    return jax.jit(made)


def _only(trajectory: Trajectory) -> Candidates:
    """A trajectory as the only candidate."""
    return Candidates(
        trajectory=jax.tree.map(lambda x: x[None], trajectory),
        feasible=jnp.ones(1, bool),
        family=jnp.zeros(1, jnp.int32),
    )


def _driven_by(
    reward: Reward,
    scene: Scene,
    candidates: Candidates,
    x: np.ndarray,
    mask: np.ndarray,
) -> np.ndarray:
    """[K] what the candidates are ranked by: V, on top of the prior cost if any."""
    if reward.prior_cost is None:
        return reward.value(x, mask)
    own, weights = incumbent_score(reward.prior_cost.incumbent)
    return reward.total(x, np.asarray(own(weights, scene, candidates)), mask)


def draw_frame(
    dataset: Demonstrations,
    reward: Reward,
    sampler: SamplerConfig,
    row: int,
    picture: Path,
    *,
    st_graph: Path | None = None,
) -> DrawnFrame:
    """The six-panel figure of one scene, and its ST graph if a path is given."""
    rows = dataset.read(np.array([row]))
    one = jax.tree.map(lambda x: jnp.asarray(x[0]), rows)
    made = _sampled(reward.preset, sampler)(candidates_key(jnp.asarray(row)), one)
    candidates, human = made[:2]
    x, x_human = map(np.asarray, made[2:])
    valid = np.asarray(one.scene.time_valid)
    mask = np.broadcast_to(valid, x.shape[:2])
    values = _driven_by(reward, one.scene, candidates, x, mask)
    feasible = np.asarray(candidates.feasible)
    chosen = int(np.argmax(np.where(feasible, values, -np.inf)))
    drawn = one.replace(human=human)
    names = [tag.name.lower() for tag in Tag if bool(one.scene.tags[tag])]
    weights = reward_params(reward)
    parts = _attributed(*weights, x[chosen], x_human, valid, reward.activation)
    reasons = np.asarray(parts, np.float64).sum(axis=0).tolist()
    plots.example_frame(
        picture,
        drawn,
        candidates,
        chosen,
        human_features=x_human,
        chosen_features=x[chosen],
        names=feature_map(reward.preset).names,
    )
    if st_graph is not None:
        plots.st_graph(st_graph, drawn, candidates, chosen)
    return DrawnFrame(
        picture=picture,
        caption=(
            f"scene {row} ({', '.join(names) or 'no tag'}): human (black), chosen "
            "(orange, dashed) and candidates (grey)"
        ),
        chosen=chosen,
        values=values,
        feasible=feasible,
        human_value=float(
            _driven_by(reward, one.scene, _only(human), x_human[None], valid[None])[0]
        ),
        human_s=np.asarray(human.s),
        chosen_s=np.asarray(candidates.trajectory.s[chosen]),
        reasons=dict(zip(reward.names, reasons, strict=True)),
    )


def draw_frames(
    dataset: Demonstrations,
    reward: Reward,
    sampler: SamplerConfig,
    folder: Path,
    count: int,
) -> list[tuple[Path, str]]:
    """The paper's example-frame figure for some held-out scenes.

    Returns:
      (PNG, caption) per frame: the first also as a large ST graph.
    """
    pictures = []
    for number, row in enumerate(pick_frames(dataset, count)):
        path, graph = folder / f"frame_{number}.png", folder / "st_graph.png"
        frame = draw_frame(
            dataset,
            reward,
            sampler,
            int(row),
            path,
            st_graph=graph if number == 0 else None,
        )
        pictures.append((path, frame.caption))
        if number == 0:
            pictures.append((graph, f"station-time graph of scene {int(row)}"))
    return pictures


def draw_training(workdir: Path, folder: Path) -> list[tuple[Path, str]]:
    """Loss and pair accuracy over the steps of a run, from metrics.jsonl."""
    rows = read_metrics(workdir / "metrics.jsonl")
    steps = np.array([row["step"] for row in rows])
    series = {
        name: np.array([row.get(name) or np.nan for row in rows], float)
        for name in ("loss", "pair_accuracy", "queries_per_s")
    }
    path = folder / "training.png"
    plots.training_curve(path, steps, series)
    return [(path, "training: loss, pairs won by the human, queries per second")]
