"""Latency of one plan with 512 candidates, learned reward, on one core.

    taskset -c 0 python -m benchmarks.single_plan

Sampling, features, safety filter, network and choice of one scene, one call
each, after warm-up; scenes differ from call to call. Goal: p99 below 2 ms.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from absl import app, flags

from benchmarks.common import percentiles, timed, untrained, write
from rcirl_jax.features import feature_map
from rcirl_jax.planner.rank import ONLINE, RankConfig, learned_score, rank_policy
from rcirl_jax.reward import RewardConfig
from rcirl_jax.sampling import num_candidates
from tests.helpers.scenes import random_scene

_CALLS = flags.DEFINE_integer("calls", 2000, "plans that are timed")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")


def main(_: list[str]) -> None:
    """Time 512 and 64 candidates."""
    weights = untrained()
    score = learned_score(feature_map("paper21"), RewardConfig().activation)
    scenes = [jax.tree.map(jnp.asarray, random_scene(i)) for i in range(32)]
    result = {}
    for count in (64, 512):
        missing = count - num_candidates(ONLINE)
        sampler = dataclasses.replace(ONLINE, num_random=ONLINE.num_random + missing)
        config = RankConfig(sampler=sampler)
        plan = jax.jit(rank_policy(score, config))
        turn = iter(np.arange(10**9))
        key = jax.random.key(0)

        def call(plan=plan, turn=turn, key=key) -> object:  # noqa: ANN001
            return plan(weights, scenes[next(turn) % len(scenes)], key)

        result[f"rank_{count}"] = percentiles(timed(call, _CALLS.value))
        print(f"rank, {count} candidates: {result[f'rank_{count}']}")
    write("single_plan", result, _OUTPUT.value)


if __name__ == "__main__":
    app.run(main)
