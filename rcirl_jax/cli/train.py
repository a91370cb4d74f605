"""Train the Siamese value network on a dataset.

    rcirl train --data=DATASET --output=RUN

Resumes from RUN/checkpoints when it is run again with the same settings, to the same
bits. SIGTERM and SIGINT (Ctrl-C) save the step it is in and end within ten seconds,
with exit status 143 and 130. A damaged checkpoint is named and the one before it taken.
Several processes (RUN and DATASET on a file system that all of them see), each with
its own --process_id:

    rcirl train --data=DATASET --output=RUN --parallel=shard_map
        --coordinator_address=HOST:PORT --num_processes=2 --process_id=0
"""

from pathlib import Path

from absl import flags

from rcirl_jax.cli import flags as shared
from rcirl_jax.cli.running import provenance
from rcirl_jax.data.store.dataset import open_datasets
from rcirl_jax.data.store.splits import with_tags
from rcirl_jax.export.closed_loop import checked_sampler
from rcirl_jax.train.loop import Running, train
from rcirl_jax.train.parallel import PARALLEL, is_first, join_processes, share_cores

USUAL = (
    *("data", "output", "recipe", "seed", "tags", "epochs", "loss", "positive"),
    *("learning_rate", "hidden_size", "data_weights", "parallel"),
)
_DATA = flags.DEFINE_list(
    "data", None, "datasets of `rcirl import`, with commas", required=True
)
_TAGS = flags.DEFINE_list(
    "tags", [], "only scenes with one of these tags, e.g. lane_change,cut_in"
)
_OUTPUT = flags.DEFINE_string("output", None, shared.OUTPUT, required=True)
_SEED = flags.DEFINE_integer(
    "seed",
    0,
    "of initial weights, batches, candidates: train several to see the spread",
)
_PARALLEL = flags.DEFINE_enum(
    "parallel", "auto", PARALLEL, "how devices share a batch; auto: all that are there"
)
_IN_MEMORY = flags.DEFINE_float(
    "in_memory_mb", 1024.0, "MiB up to which the split is loaded whole, else streamed"
)
_SAVE = flags.DEFINE_integer(
    "checkpoint_every", 0, "steps, besides the end of each epoch; 0: none"
)
_COORDINATOR = flags.DEFINE_string(
    "coordinator_address", None, "host:port of process 0, with several processes"
)
_PROCESSES = flags.DEFINE_integer("num_processes", None, "how many there are")
_PROCESS = flags.DEFINE_integer("process_id", None, "number of this one")
_TRAINING = shared.training()
_TRACKERS = shared.trackers()


def main() -> None:
    """Flags -> one training run."""
    join_processes(_COORDINATOR.value, _PROCESSES.value, _PROCESS.value)
    config = _TRAINING.config(seed=_SEED.value)
    if _PARALLEL.value == "auto" and _PROCESSES.value is None:
        share_cores(config.batch_size)
    checked_sampler(config.sampler)
    dataset = open_datasets(_DATA.value, weights=_TRAINING.data_weights)
    dataset = with_tags(dataset, _TAGS.value)
    running = Running(
        parallel=_PARALLEL.value,
        in_memory_mb=_IN_MEMORY.value,
        checkpoint_every=_SAVE.value,
        trackers=_TRACKERS(),
    )
    result = train(
        dataset,
        Path(_OUTPUT.value),
        config,
        running=running,
        provenance=provenance(),
    )
    if not is_first():
        return
    for epoch in result.epochs[-1:]:
        print(
            f"epoch {epoch['epoch']}: loss {epoch['loss']:.4f}, "
            f"pairs won {epoch['pair_accuracy']:.1%}"
        )
    for said in result.warnings:
        print(f"warning: {said}")
    rate = result.queries / max(result.seconds, 1e-9)
    waited = result.waited_s / max(result.seconds, 1e-9)
    print(
        f"{result.queries:,.0f} queries, {rate:,.0f} queries/s, "
        f"{waited:.1%} waiting for data; run: {_OUTPUT.value}"
    )
