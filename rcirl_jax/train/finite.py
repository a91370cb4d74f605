"""Numbers that are not finite: found on the device, named by scene and feature."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.data.store.rows import refuse_scenes, scene_name, unusable_leaves
from rcirl_jax.errors import InputError
from rcirl_jax.features import FeatureMap, feature_map
from rcirl_jax.reward.module import product
from rcirl_jax.train.state import FeatureBatch
from rcirl_jax.types import Demonstration

if TYPE_CHECKING:  # a step asks for bad values itself
    from rcirl_jax.train.step import StepMetrics

# what losses read besides features
FACTS = "distance, density or broken rules of a candidate"


def bad_values(batch: FeatureBatch) -> jax.Array:
    """[B, F] bool: scenes that count and hold a NaN or an infinity of a feature."""
    bad = _holds_bad(batch.candidates) | _holds_bad(batch.human.swapaxes(1, 2))
    return bad & (batch.weight > 0.0)[:, None]


def bad_facts(batch: FeatureBatch) -> jax.Array:
    """[B, 1] bool: scenes that count whose facts, which losses read, are not finite.

    Of candidates that count, and of the human.
    """
    facts = batch.facts
    of_each = jnp.isfinite(facts.distance) & jnp.isfinite(facts.breaks_rule)
    of_each &= jnp.isfinite(facts.density)
    of_human = jnp.isfinite(facts.human_distance) & jnp.isfinite(facts.human_density)
    bad = jnp.any(~of_each & batch.feasible, axis=-1) | ~of_human
    return (bad & (batch.weight > 0.0))[:, None]


def count_bad(bad: jax.Array, index: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Scenes with bad values per feature, and the row of one such scene (or -1)."""
    return jnp.sum(bad, axis=0), jnp.max(jnp.where(jnp.any(bad, axis=1), index, -1))


def _holds_bad(features: jax.Array) -> jax.Array:
    """[B, F] bool, of [B, F, ...]: one of the values is a NaN or an infinity.

    Seen in a weighted sum, which a CPU takes at the speed of its memory; the weight
    is so small that finite values do not overflow.
    """
    flat = features.reshape(*features.shape[:2], -1)
    return ~jnp.isfinite(product(flat, jnp.full((flat.shape[2],), 1e-30)))


def check_step(
    metrics: "StepMetrics",
    features: FeatureMap,
    step: int,
    dataset: Demonstrations | None = None,
) -> None:
    """Stop with the scene and the features named when a number is not finite.

    The scene is looked up in the dataset, if given, once the step has failed.
    """
    if bool(metrics.finite):
        return
    row = int(metrics.first_bad)
    if row >= 0:
        bad = np.flatnonzero(np.asarray(metrics.nonfinite))
        known = [*(f"feature {name}" for name in features.names), FACTS]
        names = ", ".join(known[i] for i in bad)
        scene, cause = f"scene {row}", ""
        if dataset is not None:
            rows = dataset.read(np.array([row]))
            scene, leaves = scene_name(rows, 0, row), unusable_leaves(rows, 0)
            cause = f" (as is the stored {', '.join(leaves)})" if leaves else ""
        raise InputError(
            f"train: step {step}: {scene}: {names}: not finite{cause}: "
            "expected finite numbers; the state before is kept"
        )
    raise InputError(
        f"train: step {step}: loss or gradient: not finite: features are finite; "
        "lower learning_rate; the state before is kept"
    )


def check_features(
    made: FeatureBatch, rows: Demonstration, stored: np.ndarray, preset: str
) -> None:
    """Refuse features (numpy) that are NaN or infinite.

    Args:
      made: features of the first n of the scenes; the others are not looked at.
      rows: the scenes.
      stored: their rows in the dataset.
      preset: of the features.

    Raises:
      InputError: names the first such scene and its features.
    """
    candidates, human = np.asarray(made.candidates), np.asarray(made.human)
    finite = [
        np.isfinite(candidates[:, i]).all(axis=(1, 2))
        & np.isfinite(human[:, :, i]).all(axis=1)
        for i in range(candidates.shape[1])
    ]
    names = (f"feature {name}" for name in feature_map(preset).names)
    found = {name: np.invert(fine) for name, fine in zip(names, finite, strict=True)}
    found[FACTS] = np.asarray(bad_facts(made))[:, 0]
    refuse_scenes("train", rows, stored, found)
