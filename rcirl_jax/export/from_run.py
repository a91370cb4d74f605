"""A training run -> weights.msgpack with verification samples."""

import datetime
import math
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.data.store.dataset import EQUAL, Demonstrations
from rcirl_jax.errors import MALFORMED, InputError
from rcirl_jax.export.reader import MAX_NAME, PriorCost, Reward
from rcirl_jax.export.weights import save
from rcirl_jax.features import feature_map
from rcirl_jax.planner.own_cost import OwnCost, is_place, own_cost
from rcirl_jax.reward import (
    Normaliser,
    RewardModel,
    RewardParams,
    effective_params,
    seen_range,
    value,
)
from rcirl_jax.reward.network import LEAKY_SLOPE, layers_of
from rcirl_jax.runtime.atomic_files import read_json
from rcirl_jax.runtime.checked import typed_settings
from rcirl_jax.train.featurise import in_chunks, normaliser_rows
from rcirl_jax.train.loop import restore_run
from rcirl_jax.train.metrics import read_metrics
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.units import TIMES_S

NUM_SAMPLES = 32  # verification samples in the file


def read_config(workdir: Path) -> tuple[TrainConfig, dict]:
    """Return the configuration a run was made with, and all of run.json."""
    path = workdir / "run.json"
    if not path.is_file():
        raise InputError(f"{path}: missing: expected a run made by `rcirl train`")
    run = read_json(path, "a run of this version")
    try:
        settings = run["config"]
        for name in ("reward", "sampler"):
            settings[name]  # these are no flags with a default
        config = typed_settings(TrainConfig, settings)
        if not isinstance(run.get("flags", {}), dict):
            raise ValueError("flags: not a table")
    except MALFORMED as error:
        raise InputError(f"{path}: {error}: expected a run of this version") from error
    return config, run


def datasets_of(workdir: Path) -> list[str]:
    """Return the datasets that a run's flags name.

    Raises:
      InputError: no run, or flags that name none that a file can have.
    """
    found = read_config(workdir)[1].get("flags", {}).get("data")
    names = found if isinstance(found, list) else [found]
    for name in names or [None]:
        if not isinstance(name, str) or not name.strip("\0") or "\0" in name:
            raise InputError(
                f"{workdir / 'run.json'}: flags.data: {found}: expected a dataset, or "
                "a list of them; or give data"
            )
    return names


def data_weights_of(workdir: Path) -> str:
    """Return the share of each dataset that a run's flags name (`open_datasets`)."""
    found = read_config(workdir)[1].get("flags", {}).get("data_weights")
    return found if isinstance(found, str) else EQUAL


def tags_of(workdir: Path) -> list[str]:
    """Return the tags of scenes that a run's flags name, [] for all scenes."""
    return list(read_config(workdir)[1].get("flags", {}).get("tags") or [])


def export_run(
    workdir: Path,
    dataset: Demonstrations,
    output: Path,
    *,
    prior_cost: PriorCost | None = None,
    own: OwnCost | None = None,
) -> Reward:
    """Write weights.msgpack from a run's newest checkpoint.

    Verification samples are humans and candidates of the training split, with
    their values as the trainer computes them.

    Args:
      workdir: run folder of `rcirl train`.
      dataset: the dataset of the run (its hash has to match).
      output: file to write, atomically.
      prior_cost: of a reward driven on top of an incumbent. That of a residual is
        what was learned: V_total = beta own / unit + V drives as own + unit / beta V.
      own: the user's own cost, if that is the incumbent.

    Raises:
      InputError: no run, no checkpoint, another dataset, or another network than
        the package's own.
    """
    config, run = read_config(workdir)
    if run.get("dataset_hash") != dataset.hash:
        raise InputError(
            f"{workdir / 'run.json'}: dataset_hash: {run.get('dataset_hash')}: "
            f"expected that of the given dataset, {dataset.hash}"
        )
    config.reward.check_own()
    state = restore_run(workdir, config)
    rows = normaliser_rows(dataset, config)
    seen = seen_range(rows, feature_map(config.features))
    same = ("git_commit", "machine", "cpu", "cores", "device", "devices")
    provenance = {
        **{name: run.get(name) for name in same},
        **{name: run[name] for name in ("code_sha256", "environment") if name in run},
        "dataset_sha256": run["dataset_hash"],
        "seed": config.seed,
        "flags": run.get("flags", {}),
        "metrics": last_metrics(workdir),
        "versions": run.get("versions", {}),
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "steps": int(state.step),
        "mode": config.sampler.mode,
        "config": run["config"],
    }
    if config.residual_on:
        own = own_cost(config.residual_on) if is_place(config.residual_on) else None
        gain = config.own_unit / math.exp(float(np.asarray(state.params["log_beta"])))
        name = own.name if own else config.residual_on
        prior_cost = PriorCost(incumbent=name, gain=gain)
    if own is not None:
        place = os.path.abspath(own.place)
        provenance["own_cost"] = {"place": place, "sha256": own.sha256}
    return write_weights(
        output,
        state.params,
        state.normaliser,
        config,
        verification_samples(dataset, config),
        provenance,
        seen,
        prior_cost=prior_cost,
    )


def write_weights(
    output: Path,
    params: RewardParams,
    normaliser: Normaliser,
    config: TrainConfig,
    samples: tuple[np.ndarray, np.ndarray],
    provenance: dict,
    seen: np.ndarray,
    *,
    prior_cost: PriorCost | None = None,
) -> Reward:
    """Write trained parameters as weights.msgpack, atomically.

    Args:
      output: file; its folder is made if missing.
      params: trained, raw.
      normaliser: of the training.
      config: of the training.
      samples: of `verification_samples`; their values are computed here as the
        trainer computes them.
      provenance: `weights.PROVENANCE_KEYS` and more.
      seen: [2, F] of `seen_range`.
      prior_cost: of a reward driven on top of an incumbent.
    """
    x, valid = map(jnp.asarray, samples)
    values = value(RewardModel(config.reward), params, normaliser, x, valid)
    features = feature_map(config.features)
    if config.sampler.own:
        named = {"place": config.sampler.own, "sha256": config.sampler.own_sha256}
        provenance = {**provenance, "own_sampler": named}
    preset = config.features
    if own := features.own:
        named = {"place": os.path.abspath(own.place), "sha256": own.sha256}
        provenance = {**provenance, "own_terms": named}
        preset = os.path.basename(own.place)[-MAX_NAME:]
    effective = effective_params(params, config.reward)
    kernels, biases = layers_of(effective["point"])
    weights = Reward(
        preset=preset,
        names=features.names,
        units=tuple(spec.unit for spec in features.specs),
        none_values=tuple(spec.none for spec in features.specs),
        lower=np.asarray(normaliser.lower),
        upper=np.asarray(normaliser.upper),
        location=np.asarray(normaliser.location),
        scale=np.asarray(normaliser.scale),
        times=TIMES_S,
        gamma=np.asarray(effective["gamma"]),
        kernels=tuple(map(np.asarray, kernels)),
        biases=(*map(np.asarray, biases), np.zeros(1)),
        activation=config.reward.hidden_activation,
        leaky_slope=LEAKY_SLOPE,
        scene_gating=effective.get("scene_gating"),
        training_range=seen,
        prior_cost=prior_cost,
        loss={
            "name": config.loss,
            "leaky_rate": config.leaky_rate if config.loss == "rank" else None,
        },
        provenance=provenance,
    )
    output.parent.mkdir(parents=True, exist_ok=True)
    return save(output, weights, *samples, np.asarray(values))


def verification_samples(
    dataset: Demonstrations, config: TrainConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Return [m, T, F] features and [m, T] masks: half humans, half candidates."""
    count = min(NUM_SAMPLES // 2, dataset.indices("train").size)
    index = dataset.indices("train")[:count]
    key = jax.random.key(config.seed)
    parts = in_chunks(key, dataset.read(index), index, config)
    made = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    human, candidates = made.human, made.points
    picked = candidates[np.arange(count), np.arange(count) % candidates.shape[1]]
    valid = made.time_valid
    return np.concatenate([human, picked]), np.concatenate([valid, valid])


def last_metrics(workdir: Path) -> dict:
    """Return the last whole line of metrics.jsonl, or nothing."""
    rows = read_metrics(workdir / "metrics.jsonl")
    return {k: v for k, v in rows[-1].items() if v is not None} if rows else {}
