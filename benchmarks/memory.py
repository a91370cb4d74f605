"""Memory over a long training: flat, or something is kept that should not be.

    python -m benchmarks.memory

The whole training loop, streaming its scenes, with metrics and a checkpoint every
epoch; resident memory every hundred steps.
"""

import tempfile
from pathlib import Path

import jax
import numpy as np
from absl import app, flags, logging

from benchmarks.common import resident_mb, stored_scenes, write
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.train.loop import train
from rcirl_jax.train.running import Running
from rcirl_jax.train.state import TrainConfig
from tests.helpers.scenes import demonstration

_STEPS = flags.DEFINE_integer("steps", 10_000, "training steps, a multiple of 100")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")

PER_EPOCH = 100  # steps
BATCH = 4
SMALL = SamplerConfig(num_random=4, cruise_times=(4.0,), edge_times=(4.0,))


def main(_: list[str]) -> None:
    """Train and watch."""
    logging.set_verbosity(logging.WARNING)  # orbax says much at every checkpoint
    made = [demonstration(seed) for seed in range(64)]
    rows = jax.tree.map(lambda *x: np.stack(x), *made)
    seen: dict[int, float] = {}

    def on_step(step: int) -> None:
        if step % 100 == 0:
            seen[step] = resident_mb()

    epochs = _STEPS.value // PER_EPOCH
    config = TrainConfig(batch_size=BATCH, epochs=epochs, sampler=SMALL)
    with tempfile.TemporaryDirectory() as folder:
        dataset = stored_scenes(Path(folder) / "d", rows, BATCH * PER_EPOCH)
        running = Running(in_memory_mb=0.0, on_step=on_step)
        done = train(dataset, Path(folder) / "run", config, running=running)
    late = {step: mb for step, mb in seen.items() if step > _STEPS.value // 10}
    slope = np.polyfit(list(late), list(late.values()), 1)[0]
    result = {
        "steps": int(done.state.step),
        "seconds": round(done.seconds, 1),
        "rss_mb_after_a_tenth": round(seen[max(_STEPS.value // 1000, 1) * 100], 1),
        "rss_mb_at_the_end": round(seen[max(seen)], 1),
        "rss_mb_every_tenth": [
            round(seen[step], 1) for step in sorted(seen)[9 :: max(len(seen) // 10, 1)]
        ],
        "rss_mb_max": round(max(seen.values()), 1),
        "growth_kb_per_step_after_a_tenth": round(float(slope) * 1024, 3),
    }
    print(result)
    print(f"written: {write('memory', result, _OUTPUT.value)}")


if __name__ == "__main__":
    app.run(main)
