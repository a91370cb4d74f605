"""Time of one DP plan, and how much value it finds beyond ranking.

    taskset -c 0 python -m benchmarks.dp

The lattice at two resolutions and ranking (64 and 512 candidates) in turn on
the same scenes, one core. Value gained by the DP is given in the unit of the
spread between the best and the median candidate of each scene.
"""

import dataclasses
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from absl import app, flags

from benchmarks.common import percentiles, untrained, write
from rcirl_jax.export.loading import open_reward, reward_params
from rcirl_jax.features import feature_map
from rcirl_jax.planner.dp import DpConfig, Weights, search
from rcirl_jax.planner.rank import ONLINE, Score, learned_score
from rcirl_jax.planner.safety import check
from rcirl_jax.reward import RewardConfig
from rcirl_jax.sampling import num_candidates, sample
from rcirl_jax.types import Scene
from tests.helpers.scenes import random_scene

_WEIGHTS = flags.DEFINE_string("weights", None, "weights file (default: random)")
_SCENES = flags.DEFINE_integer("scenes", 24, "scenes")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")


Planner = Callable[[Scene], tuple[jax.Array, jax.Array]]


def _reward() -> tuple:
    """(weights, activation) of the file, or random ones with declared scales."""
    if _WEIGHTS.value:
        reward = open_reward(_WEIGHTS.value)
        return reward_params(reward), reward.activation
    params, norm = untrained()
    middle, scale = 0.5 * (norm.lower + norm.upper), 0.25 * (norm.upper - norm.lower)
    scaled = norm.replace(location=middle, scale=scale)
    return (params, scaled), RewardConfig().activation


def _ranking(count: int, weights: Weights, score: Score) -> Planner:
    """Best admissible value of `count` candidates, and the median of all."""
    more = ONLINE.num_random + count - num_candidates(ONLINE)
    config = dataclasses.replace(ONLINE, num_random=more)

    def plan(scene: Scene) -> tuple[jax.Array, jax.Array]:
        candidates = sample(jax.random.key(0), scene, config)
        values = score(weights, scene, candidates)
        fine = check(scene, candidates).admissible
        middle = jnp.nanmedian(jnp.where(candidates.feasible, values, jnp.nan))
        return jnp.max(jnp.where(fine, values, -jnp.inf)), middle

    return jax.jit(plan)


def _lattice(step: float, weights: Weights, activation: str) -> Planner:
    """Value of the lattice's plan, twice."""
    config = DpConfig(step=step, proposals=1)
    features = feature_map("paper21")

    def plan(scene: Scene) -> tuple[jax.Array, jax.Array]:
        found = search(scene, weights, features, activation, config)
        (value,) = found.value
        return jnp.where(found.feasible[0], value, -jnp.inf), value

    return jax.jit(plan)


def main(_: list[str]) -> None:
    """Alternate the planners over the scenes."""
    weights, activation = _reward()
    score = learned_score(feature_map("paper21"), activation)
    planners = {
        "rank_64": _ranking(64, weights, score),
        "rank_512": _ranking(512, weights, score),
        "dp_step_2": _lattice(2.0, weights, activation),
        "dp_step_1": _lattice(1.0, weights, activation),
    }
    scenes = [jax.tree.map(jnp.asarray, random_scene(i)) for i in range(_SCENES.value)]
    seconds: dict[str, list[float]] = {name: [] for name in planners}
    values: dict[str, list[tuple[float, float]]] = {name: [] for name in planners}
    for plan in planners.values():
        jax.block_until_ready(plan(scenes[0]))
    for scene in scenes:
        for name, plan in planners.items():
            # untimed: what the last planner left in the caches must not count
            jax.block_until_ready(plan(scene))
            begin = time.perf_counter()
            best, middle = jax.block_until_ready(plan(scene))
            seconds[name].append(time.perf_counter() - begin)
            values[name].append((float(best), float(middle)))
    result: dict = {name: percentiles(found) for name, found in seconds.items()}
    ranked, middle = np.array(values["rank_64"]).T
    for name in ("rank_512", "dp_step_2", "dp_step_1"):
        found, spread = np.array(values[name])[:, 0], ranked - middle
        both = np.isfinite(found) & np.isfinite(ranked) & (spread > 0.0)
        gain = (found[both] - ranked[both]) / spread[both]
        result[name]["value_gain_median"] = round(float(np.median(gain)), 4)
        result[name]["scenes"] = int(both.sum())
    for name, found in result.items():
        print(f"{name}: {found}")
    known = [_WEIGHTS.value] if _WEIGHTS.value else []
    write("dp", result, _OUTPUT.value, weights=known)


if __name__ == "__main__":
    app.run(main)
