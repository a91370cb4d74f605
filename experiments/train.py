"""Train the Siamese value network on a dataset.

    python -m experiments.train --data=DATASET --workdir=RUN

Resumes from RUN/checkpoints when it is run again with the same settings.
Several processes (RUN and DATASET on a file system that all of them see), each with
its own --process_id:

    python -m experiments.train --data=DATASET --workdir=RUN --parallel=jit_sharded
        --coordinator_address=HOST:PORT --num_processes=2 --process_id=0
"""

from pathlib import Path

from absl import flags

from experiments.common import floats, hidden_sizes, provenance, run
from rcirl_jax.data.joined import open_datasets
from rcirl_jax.data.preferences import read_preferences
from rcirl_jax.errors import InputError
from rcirl_jax.features import feature_map
from rcirl_jax.reward import LOSSES, RewardConfig
from rcirl_jax.reward.network import CONSTRAINTS
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.train.loop import train
from rcirl_jax.train.parallel import PARALLEL
from rcirl_jax.train.processes import is_first, join_processes
from rcirl_jax.train.running import Running
from rcirl_jax.train.state import POSITIVES, TrainConfig

_DATA = flags.DEFINE_list(
    "data", None, "dataset made by import_logs; several are joined", required=True
)
_WORKDIR = flags.DEFINE_string("workdir", None, "run folder", required=True)
_FEATURES = flags.DEFINE_string("features", "paper21", "preset in data_specs/features")
_MODE = flags.DEFINE_enum(
    "mode", "speed", ["speed", "path_speed"], "what the sampler varies"
)
_LOSS = flags.DEFINE_enum("loss", "rank", sorted(LOSSES), "loss on value differences")
_MARGINS = flags.DEFINE_list(
    "margins", ["0.2", "4", "2"], "hinge: per metre from the human, collision, rule"
)
_SOFT = flags.DEFINE_float("soft_distance", 1.0, "m, temperature of soft labels")
_LEAKY = flags.DEFINE_float("leaky_rate", 0.05, "a of the rank loss")
_HIDDEN = flags.DEFINE_list("hidden_size", ["15"], "units per layer; 0 is linear")
_ACTIVATION = flags.DEFINE_enum(
    "activation", "tanh", ["tanh", "relu", "leaky_relu"], "of the hidden layers"
)
_CONSTRAINT = flags.DEFINE_enum(
    "constraint", "none", CONSTRAINTS, "nonnegative costs (linear), monotone in safety"
)
_BY_CONTEXT = flags.DEFINE_bool(
    "by_context", False, "scale the features by what the scene is like at t = 0"
)
_PIN = flags.DEFINE_enum("pin", "unit", ["unit", "none"], "scale pinning")
_OPTIMIZER = flags.DEFINE_enum(
    "optimizer", "adam", ["sgd", "adam", "rmsprop"], "gradient method"
)
_RATE = flags.DEFINE_float("learning_rate", 3e-3, "step size")
_HALVE = flags.DEFINE_integer("halve_every", 0, "steps per halving; 0: never")
_DECAY = flags.DEFINE_float("weight_decay", 0.0, "L2 pull on the weights")
_BATCH = flags.DEFINE_integer("batch_size", 64, "scenes per step, all devices")
_EPOCHS = flags.DEFINE_integer("epochs", 20, "passes over the training scenes")
_POSITIVE = flags.DEFINE_enum(
    "positive",
    "human",
    POSITIVES,
    "ranked first: the human curve or its nearest candidate",
)
_HORIZON = flags.DEFINE_float("train_horizon", 8.0, "s that are compared")
_NEGATIVES = flags.DEFINE_integer("hard_negatives", 0, "near negatives per scene")
_POOL = flags.DEFINE_integer(
    "hard_pool", 1, "near negatives drawn for each that the present reward keeps"
)
_PREFERENCES = flags.DEFINE_string(
    "preferences", None, "JSON Lines: in a scene, A is better than B"
)
_PREFERENCE_WEIGHT = flags.DEFINE_float(
    "preference_weight", 1.0, "of their mean loss beside that of the demonstrations"
)
_SEED = flags.DEFINE_integer("seed", 0, "of initial weights, batches, candidates")
_PARALLEL = flags.DEFINE_enum("parallel", "jit", PARALLEL, "how the devices share")
_IN_MEMORY = flags.DEFINE_float(
    "in_memory_mb", 1024.0, "MiB up to which the split is loaded whole, else streamed"
)
_VERIFY = flags.DEFINE_bool(
    "verify", True, "read every byte of the data against its checksum first"
)
_PREFETCH = flags.DEFINE_integer("prefetch", 4, "batches read ahead")
_SAVE = flags.DEFINE_integer(
    "checkpoint_every", 0, "steps, besides the end of each epoch; 0: none"
)
_COORDINATOR = flags.DEFINE_string(
    "coordinator_address", None, "host:port of process 0, with several processes"
)
_PROCESSES = flags.DEFINE_integer("num_processes", None, "how many there are")
_PROCESS = flags.DEFINE_integer("process_id", None, "number of this one")


def main() -> None:
    """Flags -> one training run."""
    join_processes(_COORDINATOR.value, _PROCESSES.value, _PROCESS.value)
    if len(_MARGINS.value) != 3:
        raise InputError(f"--margins: {_MARGINS.value}: expected three numbers")
    margins = floats(_MARGINS.value, "margins")
    features = feature_map(_FEATURES.value)
    dataset = open_datasets(_DATA.value, verify=_VERIFY.value)
    judged = None
    if _PREFERENCES.value:
        judged = read_preferences(Path(_PREFERENCES.value), dataset)
    config = TrainConfig(
        features=_FEATURES.value,
        loss=_LOSS.value,
        leaky_rate=_LEAKY.value,
        margin_distance=margins[0],
        margin_collision=margins[1],
        margin_rule=margins[2],
        soft_distance=_SOFT.value,
        optimizer=_OPTIMIZER.value,
        learning_rate=_RATE.value,
        halve_every=_HALVE.value,
        weight_decay=_DECAY.value,
        batch_size=_BATCH.value,
        epochs=_EPOCHS.value,
        positive=_POSITIVE.value,
        train_horizon=_HORIZON.value,
        hard_negatives=_NEGATIVES.value,
        hard_pool=_POOL.value,
        preferences=judged.sha256 if judged else "",
        preference_weight=_PREFERENCE_WEIGHT.value,
        seed=_SEED.value,
        reward=RewardConfig(
            hidden=hidden_sizes(_HIDDEN.value),
            activation=_ACTIVATION.value,
            pin=_PIN.value,
            constraint=_CONSTRAINT.value,
            context=features.context if _BY_CONTEXT.value else (),
            signs=features.signs if _CONSTRAINT.value == "monotone" else (),
        ),
        sampler=SamplerConfig(mode=_MODE.value),
    )
    running = Running(
        parallel=_PARALLEL.value,
        in_memory_mb=_IN_MEMORY.value,
        prefetch=_PREFETCH.value,
        checkpoint_every=_SAVE.value,
    )
    result = train(
        dataset,
        Path(_WORKDIR.value),
        config,
        running=running,
        provenance=provenance(),
        preferences=judged,
    )
    if not is_first():
        return
    for epoch in result.epochs[-1:]:
        print(
            f"epoch {epoch['epoch']}: loss {epoch['loss']:.4f}, "
            f"pairs won {epoch['pair_accuracy']:.1%}"
        )
    rate = result.queries / max(result.seconds, 1e-9)
    waited = result.waited_s / max(result.seconds, 1e-9)
    print(
        f"{result.queries:,.0f} queries, {rate:,.0f} queries/s, "
        f"{waited:.1%} waiting for data; run: {_WORKDIR.value}"
    )


if __name__ == "__main__":
    run(main)
