"""One process of a training that a test starts: `python -m tests.train.worker JSON`."""

import json
import os
import signal
import sys
import time
from pathlib import Path
from unittest import mock

import jax

from rcirl_jax.data.store import batches
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.runtime.signals import Interrupted
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.train.loop import Running, train
from rcirl_jax.train.parallel import join_processes
from rcirl_jax.train.state import TrainConfig

# plain gradient steps: Adam would hide a wrong scale of the gradient
CONFIG = TrainConfig(
    batch_size=8,
    epochs=2,
    optimizer="sgd",
    learning_rate=0.1,
    sampler=SamplerConfig(num_random=4, cruise_times=(4.0,), edge_times=(4.0,)),
)


def trained(dataset, workdir, **running):
    """The result of a training whose rows slide through a window of half of them."""
    with mock.patch.object(batches, "WINDOW_BLOCKS", 2):
        return train(dataset, workdir, CONFIG, running=Running(**running))


def main():
    job = json.loads(sys.argv[1])
    number, workdir = job["process_id"] or 0, Path(job["workdir"])
    saved = workdir / "checkpoints" / str(job["kill_after"])
    join_processes(job["address"], job["num_processes"], job["process_id"])
    taken = []

    def on_step(step):
        taken.append(step)
        time.sleep(job["pause_s"])
        (workdir / f"step_{number}").write_text(str(step))
        if step == job["kill_after"] + 1 and number in job["victims"]:
            while not saved.exists():  # it is being written while the steps go on
                time.sleep(0.02)
            os.kill(os.getpid(), signal.SIGKILL)

    try:
        result = trained(
            open_dataset(job["data"]), workdir, parallel=job["parallel"],
            in_memory_mb=job["in_memory_mb"], checkpoint_every=2, on_step=on_step,
        )  # fmt: skip
    except Interrupted as stop:
        sys.exit(128 + stop.number)
    seen = {
        "steps": len(taken),
        "loss": [epoch["loss"] for epoch in result.epochs],
        "pairs": [epoch["pairs"] for epoch in result.epochs],
        "devices": jax.device_count(),
    }
    (workdir / f"process_{number}.json").write_text(json.dumps(seen))


if __name__ == "__main__":
    main()
