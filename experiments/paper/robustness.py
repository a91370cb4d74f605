"""Optimality gap and robustness of the plan, the paper's two further criteria.

    python -m experiments.paper.robustness --weights=FILE --output=DIR [--quick]

Planning frames are taken from the planner's own drives through every family.
In each: how much value is left on the table against a finer lattice with local
ascent, and what perception errors do to the plan and to its decisions. Rows:
ranking, dynamic programming, Apollo's (t, s)-only recursion (gap only) and the
hand-set cost (steadiness only: it has another value). Expected: 20 minutes on
two cores; the DP's gap is near 0, ranking pays for its 64 candidates with about
a tenth of the value of not braking. `--quick`: a few frames, three minutes.
"""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags

from experiments.common import provenance, run
from rcirl_jax.evaluation.robustness import Disturbance, frames, gaps, steadiness
from rcirl_jax.evaluation.statistics import ClusterBootstrap
from rcirl_jax.export.loading import open_reward, reward_params
from rcirl_jax.features import FeatureMap, feature_map
from rcirl_jax.planner.dp import dp_policy
from rcirl_jax.planner.grid import DpConfig, Weights
from rcirl_jax.planner.optimality import GapConfig
from rcirl_jax.planner.plan import Plan
from rcirl_jax.planner.rank import (
    Policy,
    RankConfig,
    hand_score,
    learned_score,
    rank_policy,
)
from rcirl_jax.planner.time_station import plan_time_station
from rcirl_jax.simulation.suite import build, suite_refs
from rcirl_jax.types import Scene

_WEIGHTS = flags.DEFINE_string("weights", None, "weights file", required=True)
_OUTPUT = flags.DEFINE_string("output", "out/robustness", "folder to write")
_FRAMES = flags.DEFINE_integer("frames", 69, "planning frames")
_QUICK = flags.DEFINE_bool("quick", False, "a few frames, coarse lattices")


def _time_station(features: FeatureMap, activation: str, lattice: DpConfig) -> Policy:
    """Apollo's recursion on the learned reward, as a policy that is never driven."""

    def policy(params: Weights, scene: Scene, key: jax.Array) -> Plan:
        del key
        plan = plan_time_station(scene, params, features, activation, lattice)
        return Plan(
            acceleration=plan.trajectory.a[0],
            s=plan.trajectory.s,
            fallback=~plan.feasible,
            admissible=plan.feasible.astype(jnp.int32),
        )

    return policy


def _line(values: np.ndarray) -> dict[str, float]:
    """Mean with its 95 % bootstrap interval, and quantiles, of finite values."""
    finite = values[np.isfinite(values)].astype(float)
    if finite.size < 2:
        return {"n": float(finite.size)}
    low, high = np.quantile(
        ClusterBootstrap(np.arange(finite.size)).means(finite), [0.025, 0.975]
    )
    return {
        "n": float(finite.size),
        "mean": float(finite.mean()),
        "low": float(low),
        "high": float(high),
        "median": float(np.median(finite)),
        "p95": float(np.quantile(finite, 0.95)),
    }


def main() -> None:
    """Frames, gaps, steadiness; table on the terminal, numbers as JSON."""
    reward = open_reward(_WEIGHTS.value)
    params, config = reward_params(reward), RankConfig(period=0.2)
    features, activation = feature_map(str(reward.preset)), reward.activation
    rank = rank_policy(learned_score(features, activation), config)
    coarse = DpConfig(step=4.0 if _QUICK.value else 2.0)
    fine = DpConfig(step=2.0 if _QUICK.value else 1.0)
    count = 4 if _QUICK.value else _FRAMES.value
    refs = suite_refs("full", 1, 500)
    cases, duration = build(refs, 60.0), 60.0
    met = frames(rank, params, cases, duration, 4.0)
    chosen = np.linspace(0, met.ego.v.shape[0] - 1, count).astype(int)
    scenes = jax.tree.map(lambda leaf: leaf[chosen], met)
    dp = dp_policy(features, activation, config, coarse)
    baseline = _time_station(features, activation, coarse)
    gap = GapConfig(lattice=fine)
    result: dict = {"optimality": {}, "robustness": {}, "frames": count}
    for name, policy in {"rank": rank, "dp": dp, "(t, s) only": baseline}.items():
        found = gaps(policy, params, scenes, features, activation, gap)
        of = np.where(found["known"] & found["admissible"], 1.0, np.nan)
        result["optimality"][name] = {
            key: _line(found[key] * of)
            for key in ("normalised", "gap", "jerk_regret", "progress_regret")
        }
        print(f"optimality, {name}: {_text(result['optimality'][name])}", flush=True)
    noise = Disturbance(samples=8 if _QUICK.value else 32)
    hand = rank_policy(hand_score, config)
    rows = {"rank": (rank, params), "hand-set": (hand, None)}
    if not _QUICK.value:
        rows["dp"] = (dp, params)
        noise = dataclasses.replace(noise, samples=16)
    for name, (policy, weights) in rows.items():
        found = steadiness(policy, weights, scenes, noise)
        result["robustness"][name] = {key: _line(x) for key, x in found.items()}
        print(f"robustness, {name}: {_text(result['robustness'][name])}", flush=True)
    folder = Path(_OUTPUT.value)
    folder.mkdir(parents=True, exist_ok=True)
    body = {**result, "disturbance": dataclasses.asdict(noise)}
    body["made_by"] = provenance()
    (folder / "robustness.json").write_text(json.dumps(body, indent=2) + "\n")
    print(f"written: {folder}/robustness.json")


def _text(lines: dict[str, dict[str, float]]) -> str:
    return "; ".join(
        f"{key} {x['mean']:.3f} [{x['low']:.3f}, {x['high']:.3f}] "
        f"(median {x['median']:.3f}, n {x['n']:.0f})"
        for key, x in lines.items()
        if "mean" in x
    )


if __name__ == "__main__":
    run(main)
