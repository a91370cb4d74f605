"""Weights files -> scorers, with the features and sampler they were made for."""

import dataclasses
import functools
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.score import PriorCostScorer, RankingSetup
from rcirl_jax.export.own_planner.choose import check_times
from rcirl_jax.export.own_planner.features import FeatureError
from rcirl_jax.export.reader import (
    RANGES,
    Reward,
    WeightsError,
    load_weights,
)
from rcirl_jax.features.mapping import FeatureMap, feature_map
from rcirl_jax.planner.own_cost import OwnCost, own_cost
from rcirl_jax.reward.network import LEAKY_SLOPE, point_of
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.types import Normaliser, RewardParams

Scorer = Callable[[np.ndarray, np.ndarray], np.ndarray]

# types of the entries that are used; None stands for "not said"
_SAID: dict[str, type] = {
    **dict.fromkeys(("seed", "steps"), int),
    **dict.fromkeys(("git_commit", "dataset_sha256", "created", "mode"), str),
    **dict.fromkeys(("flags", "metrics", "versions", "config", "sweep"), dict),
    **dict.fromkeys(("own_cost", "own_sampler", "own_terms"), dict),
}


def open_reward(path: str) -> Reward:
    """Read a weights file whose features are those this package computes.

    Raises:
      InputError: unreadable or damaged file, other features, units or times, or a
        provenance of other types.
    """
    try:
        reward = load_weights(path)
    except WeightsError as error:
        raise InputError(str(error)) from error
    check_provenance(reward.provenance, reward.file)
    if named := reward.provenance.get("own_terms"):
        # the file's own name of them is too short for a place
        reward = dataclasses.replace(reward, preset=str(named.get("place")))
    features_of(reward)
    return reward


def features_of(reward: Reward) -> FeatureMap:
    """Return the features that a reward reads, as this package computes them.

    Raises:
      InputError: it computes others, with other units or at other times.
    """
    try:
        features = feature_map(reward.preset)
    except InputError as error:
        raise InputError(f"{reward.file}: {error}") from error
    named = reward.provenance.get("own_terms") or {}
    if features.own and features.own.sha256 != named.get("sha256"):
        raise InputError(
            f"{reward.file}: own terms {reward.preset}: they are no longer those that "
            "the weights were tuned for: expected the same file, or a new tuning"
        )
    try:
        reward.check_features(features.names, [s.unit for s in features.specs])
        check_times(reward)
    except (WeightsError, FeatureError) as error:
        raise InputError(str(error)) from error
    return features


def check_provenance(found: Mapping[str, Any], file: str) -> None:
    """Check the entries that this package uses; others may be anything.

    Raises:
      InputError: one is of another type (names file, entry and value).
    """
    for name, kind in _SAID.items():
        value = found.get(name)
        if value is not None and type(value) is not kind:
            raise InputError(
                f"{file}: provenance.{name}: {value}: expected {kind.__name__} or none"
            )


def reward_params(reward: Reward) -> tuple[RewardParams, Normaliser]:
    """Return a weights file's numbers as the pytrees that JAX code takes.

    Files hold effective (pinned) parameters; the output bias, 0 in every file
    of ours, cancels between the candidates of a scene.

    Raises:
      InputError: a leaky ReLU of another slope than this package's.
    """
    if reward.activation == "leaky_relu" and reward.leaky_slope != LEAKY_SLOPE:
        raise InputError(
            f"{reward.file}: leaky_slope: {reward.leaky_slope}: expected {LEAKY_SLOPE}"
        )
    gated = {} if reward.scene_gating is None else {"scene_gating": reward.scene_gating}
    params = {
        "gamma": reward.gamma,
        "point": point_of(list(reward.kernels), list(reward.biases[:-1])),
        **gated,
    }
    single = functools.partial(jnp.asarray, dtype=jnp.float32)
    ranges = {name: single(getattr(reward, name)) for name in RANGES}
    return jax.tree.map(single, params), Normaliser(**ranges)


def scorer_of(reward: Reward) -> Scorer | PriorCostScorer:
    """Return the reward as a row of rankings: V, on top of its prior cost if any."""
    if reward.prior_cost is None:
        return reward.value
    return PriorCostScorer(incumbent=reward.prior_cost.incumbent, total=reward.total)


def own_cost_of(
    rewards: Sequence[Reward], places: Sequence[str] = ()
) -> OwnCost | None:
    """Return the user's own cost that rewards are added to.

    Args:
      rewards: each names in its provenance where its own cost was.
      places: of own costs that drive besides; the reward's may have moved there.

    Raises:
      InputError: two own costs; one that is not where it was, or has changed.
    """
    found: dict[str, OwnCost] = {}
    here = {(cost.name, cost.sha256): cost for cost in map(own_cost, places)}
    for reward in rewards:
        was, prior_cost = reward.provenance.get("own_cost"), reward.prior_cost
        if prior_cost is None or not was:
            continue
        moved = here.get((prior_cost.incumbent, was["sha256"]))
        made = moved or own_cost(was["place"])
        if made.sha256 != was["sha256"]:
            raise InputError(
                f"{reward.file}: own cost {was['place']}: it is no longer the one that "
                "the reward was tuned on: expected the same file, or a new tuning"
            )
        found[made.place] = made
    if len(found) > 1:
        raise InputError(
            f"own cost: {', '.join(found)}: expected one for all weights files: they "
            "are ranked beside the own cost that they were tuned on"
        )
    return next(iter(found.values()), None)


def own_sampler_of(rewards: Sequence[Reward], base: SamplerConfig) -> SamplerConfig:
    """Return a grid, or the user's own candidates that rewards are made for.

    Args:
      rewards: each names in its provenance where its own candidates were made.
      base: the grid where there are none, and the vehicle's limits.

    Raises:
      InputError: two own samplers; one that is not where it was, or has changed.
    """
    found: dict[str, SamplerConfig] = {}
    for reward in rewards:
        was = reward.provenance.get("own_sampler") or {}
        if not was or was["sha256"] in found:
            continue
        own = SamplerConfig(own=was["place"])
        if own.own_sha256 != was["sha256"]:
            raise InputError(
                f"{reward.file}: own sampler {was['place']}: it is no longer the one "
                "that the reward was tuned with: expected the same file, or a new "
                "tuning"
            )
        found[own.own_sha256] = own.on_own(base)
    if len(found) > 1:
        places = ", ".join(x.own for x in found.values())
        raise InputError(f"own sampler: {places}: expected one for all rows of a table")
    return next(iter(found.values()), base)


def row_name(reward: Reward) -> str:
    """Return the name of a reward's row in the tables: loss and network."""
    hidden = [str(kernel.shape[1]) for kernel in reward.kernels[:-1]]
    shape = f"{len(reward.names)}-{'-'.join([*hidden, '1'])}"
    name = {
        "rank": "RC-IRL",
        "logistic": "RC-IRL logistic",
        "listwise": "MaxEnt",
        "soft": "soft labels",
        "risk": "least expected distance",
        "gan": "GAN",
    }
    loss = str(reward.loss.get("name"))
    by_scene = "" if reward.scene_gating is None else ", by context"
    on = "" if reward.prior_cost is None else f", on {reward.prior_cost.incumbent}"
    words = name.get(loss, loss.replace("_", " "))
    return f"{words} {shape if hidden else 'linear'}{by_scene}{on}"


def _rows(rewards: Sequence[Reward]) -> list[tuple[str, str]]:
    """Return of each reward the row of its kind, and a name of its own.

    Those of one loss and network are seeds of one row. Where two of them have the same
    seed, each is a row by its file.

    Raises:
      InputError: a file twice.
    """
    parts = [Path(os.path.abspath(reward.file)).parts for reward in rewards]
    for number, one in enumerate(parts):
        if one in parts[:number]:
            raise InputError(
                f"weights: {rewards[number].file}: met twice: expected distinct files"
            )
    files, count = [one[-1] for one in parts], 1
    while len(set(files)) < len(files):  # as many folders as tell them apart
        count += 1
        files = ["/".join(one[-count:]) for one in parts]
    kinds = [row_name(reward) for reward in rewards]
    seeds = [int(reward.provenance.get("seed") or 0) for reward in rewards]
    found = []
    for kind, seed, file in zip(kinds, seeds, files, strict=True):
        alike = [s for k, s in zip(kinds, seeds, strict=True) if k == kind]
        by_seed = len({*alike}) == len(alike)
        own = f"{kind} ({f'seed {seed}' if by_seed else file})"
        own = own if len(alike) > 1 else kind
        found.append((kind if by_seed else own, own))
    return found


def row_names(rewards: Sequence[Reward]) -> list[str]:
    """Return names of rewards that have a row each: loss, network, what differs.

    Raises:
      InputError: a file twice.
    """
    return [own for _, own in _rows(rewards)]


def prior_cost_words(name: str, reward: Reward) -> str:
    """Return a sentence on what a prior cost does to a reward; "" without one."""
    prior_cost = reward.prior_cost
    if prior_cost is None:
        return ""
    return (
        f"The {name} has a prior cost: it drives by V_total = own cost "
        f"({prior_cost.incumbent}, negated) + {prior_cost.gain:g} V."
    )


def load_runs(
    paths: Sequence[str],
) -> tuple[dict[str, list[Scorer | PriorCostScorer]], RankingSetup]:
    """Return scorers by row (files of one loss and shape are its seeds), and a setup.

    Where two of them have the same seed, each file is a row, as `row_names` has it.

    Raises:
      InputError: a file twice; files of different features or sampler modes.
    """
    if not paths:
        raise InputError("weights: none: expected at least one file")
    rewards = [open_reward(path) for path in paths]
    settings = {(r.preset, str(r.provenance.get("mode", "speed"))) for r in rewards}
    if len(settings) > 1:
        raise InputError(
            f"weights: {sorted(settings)}: expected files of one preset and mode"
        )
    preset, mode = settings.pop()
    runs: dict[str, list[Scorer | PriorCostScorer]] = {}
    for reward, (row, _) in zip(rewards, _rows(rewards), strict=True):
        runs.setdefault(row, []).append(scorer_of(reward))
    sampler = own_sampler_of(rewards, SamplerConfig(mode=mode))
    own = own_cost_of(rewards)
    return runs, RankingSetup(preset=preset, sampler=sampler, own=own)
