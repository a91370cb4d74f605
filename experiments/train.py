r"""Trains a reward network on datasets of demonstrations, and exports its weights.

    python -m experiments.train --data=DATASET --workdir=RUN \
        --flagfile=experiments/flagfiles/paper_train.flags

The defaults are those of the paper: 21-15-1, rank loss with a leaky rate of 0.05, the
human's own curve against recorded surroundings. Run again, it goes on where it was.
"""

from pathlib import Path

from absl import flags

from rcirl_jax.cli.running import provenance, run
from rcirl_jax.data.store.dataset import open_datasets
from rcirl_jax.export.from_run import export_run
from rcirl_jax.reward import LOSSES
from rcirl_jax.reward.network import CONSTRAINTS, SCALE_CONSTRAINTS
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.sampling.sampler import MODES
from rcirl_jax.train.loop import Running, train
from rcirl_jax.train.parallel import PARALLEL
from rcirl_jax.train.state import LEARNED_FUTURES, POSITIVES, TrainConfig
from rcirl_jax.tuning.recipes import reward_config

_DATA = flags.DEFINE_list("data", None, "datasets, with commas", required=True)
_WORKDIR = flags.DEFINE_string("workdir", None, "folder of the run", required=True)
_SEED = flags.DEFINE_integer("seed", 0, "of initial weights, batches, candidates")
_FEATURES = flags.DEFINE_string("features", "paper21", "preset of data_specs/features")
_HIDDEN = flags.DEFINE_list("hidden_size", ["15"], "units per layer; empty: linear")
_ACTIVATION = flags.DEFINE_string("activation", "tanh", "of the hidden layers")
_SCALE = flags.DEFINE_enum(
    "scale_constraint", "unit", SCALE_CONSTRAINTS, "what fixes the scale of the reward"
)
_CONSTRAINT = flags.DEFINE_enum("constraint", "none", CONSTRAINTS, "on the weights")
_GATING = flags.DEFINE_bool("scene_gating", False, "scale features by the scene")
_LOSS = flags.DEFINE_enum("loss", "rank", sorted(LOSSES), "what training minimises")
_LEAKY = flags.DEFINE_float("leaky_rate", 0.05, "a of the rank loss")
_POSITIVE = flags.DEFINE_enum("positive", "human", POSITIVES, "what is ranked first")
_FUTURES = flags.DEFINE_enum("futures", "recorded", LEARNED_FUTURES, "of the others")
_MODE = flags.DEFINE_enum("mode", "speed", MODES, "what the sampler varies")
_OPTIMIZER = flags.DEFINE_string("optimizer", "adam", "by its name in optax")
_RATE = flags.DEFINE_float("learning_rate", 3e-3, "step size")
_HALVE = flags.DEFINE_integer("halve_every", 0, "steps per halving; 0: never")
_BATCH = flags.DEFINE_integer("batch_size", 64, "scenes per step, on all devices")
_EPOCHS = flags.DEFINE_integer("epochs", 2, "passes over the training scenes")
_PARALLEL = flags.DEFINE_enum("parallel", "auto", PARALLEL, "how devices share a batch")


def main() -> None:
    """Trains one network and writes WORKDIR/weights.msgpack."""
    settings = {
        "hidden": tuple(int(units) for units in _HIDDEN.value if units),
        "activation": _ACTIVATION.value,
        "scale_constraint": _SCALE.value,
        "constraint": _CONSTRAINT.value,
    }
    config = TrainConfig(
        features=_FEATURES.value,
        reward=reward_config(_FEATURES.value, settings, _GATING.value),
        sampler=SamplerConfig(mode=_MODE.value),
        loss=_LOSS.value,
        leaky_rate=_LEAKY.value,
        positive=_POSITIVE.value,
        futures=_FUTURES.value,
        admissible_in="none",
        optimizer=_OPTIMIZER.value,
        learning_rate=_RATE.value,
        halve_every=_HALVE.value,
        batch_size=_BATCH.value,
        epochs=_EPOCHS.value,
        seed=_SEED.value,
    )
    dataset, workdir = open_datasets(_DATA.value), Path(_WORKDIR.value)
    running = Running(parallel=_PARALLEL.value)
    result = train(dataset, workdir, config, running=running, provenance=provenance())
    reward = export_run(workdir, dataset, workdir / "weights.msgpack")
    print(
        f"loss {result.epochs[-1]['loss']:.4f}" if result.epochs else "trained before"
    )
    print(f"weights: {reward.file}, sha256 {reward.sha256[:16]}")


if __name__ == "__main__":
    run(main)
