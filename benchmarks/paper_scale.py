"""The paper's amount of training: 718 million frames, 2.8 billion queries, 2 epochs.

    python -m benchmarks.paper_scale [--data=DATASET]          # a slice of 60 s
    python -m benchmarks.paper_scale [--data=DATASET] --full   # all, on accelerators

Each frame is a scene of the dataset (default: synthetic traffic), cycled (frame f
shows scene f mod n; n is printed), whose ego starts a little faster or slower by f,
with candidates drawn for that frame and epoch alone: sampling and features are
computed anew every time, and nothing but the n scenes is kept, on every device. A
call of the compiled program makes the frames of several steps and takes the steps;
nothing else moves between host and device. With 718 million frames the paper's 2.8
billion queries are four per frame: the sampler is cut to one candidate of each of its
eight families, which makes 5.6 queries on US-101. They are counted, not assumed, and
a run is complete only when frames and queries both are.
The loss and the share of pairs the human wins are kept over the run. Without --full,
the rate of a slice is extrapolated, and the result says so.
"""

import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags

from benchmarks.common import dataset_or_synthetic, write
from rcirl_jax.cli.running import run
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.errors import InputError
from rcirl_jax.features import feature_map
from rcirl_jax.reward import fit_normaliser
from rcirl_jax.sampling import SamplerConfig, num_candidates
from rcirl_jax.train.featurise import normaliser_rows
from rcirl_jax.train.parallel import parallelise
from rcirl_jax.train.state import Batch, TrainConfig, TrainState
from rcirl_jax.train.step import init_state, make_train_step
from rcirl_jax.types import Demonstration

_DATA = flags.DEFINE_string("data", None, "scenes to cycle (default: synthetic)")
_FULL = flags.DEFINE_bool("full", False, "run everything instead of a slice")
_SECONDS = flags.DEFINE_float("seconds", 60.0, "length of the slice")
_BATCH = flags.DEFINE_integer("batch_size", 0, "frames; 0: 256, accelerators 65536")
_HOW = flags.DEFINE_string("parallel", "jit", "jit, pmap or shard_map")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")

FRAMES, QUERIES, EPOCHS = 718_000_000, 2_800_000_000, 2
FEW = SamplerConfig(
    cruise_times=(4.0,),
    cruise_levels=(0.12,),
    edge_times=(4.0,),
    num_followed=1,
    follow_headways=(1.3,),
    stop_times=(5.0,),
    stop_gaps=(0.5,),
    stop_brakings=(),
    envelopes=((0.965, 1.3, 0.8, 2.5),),
    emergency_brakings=(4.0,),
    num_random=1,
)
STEPS = 16  # of one call on an accelerator; a CPU's take long enough one by one
CURVE_POINTS = 200  # points kept of loss and pairs won
SPEED_SPREAD = 0.02  # 1, by which frames of one stored scene differ in speed


def batch_of(rows: Demonstration, frame: jax.Array) -> Batch:
    """Frames [B] made from the stored scenes."""
    taken = jax.tree.map(lambda x: x[frame % x.shape[0]], rows)
    # multiples of the golden ratio, mod 1: spread evenly over any run of frames; whole
    # numbers, as float32 cannot tell late frames apart
    turn = frame.astype(jnp.uint32) * jnp.uint32(round(2**32 * 0.6180339887))
    share = turn.astype(jnp.float32) / 2.0**32 - 0.5
    scene, ego = taken.scene, taken.scene.ego
    speed = ego.v * (1.0 + SPEED_SPREAD * share)
    taken = taken.replace(scene=scene.replace(ego=ego.replace(v=speed)))
    weight = jnp.ones(frame.shape, jnp.float32)
    return Batch(demonstrations=taken, weight=weight, index=frame)


def make_steps(config: TrainConfig, how: str, steps: int) -> Callable:
    """((state, rows), frames of the first step [B]) -> the same and sums [steps, 3].

    The sums are loss, pairs won and pairs. A step that the last one of an epoch
    follows takes the epoch's next frames: frame numbers are modulo FRAMES.
    """
    train_step = make_train_step(config)

    def run(held: tuple, first: jax.Array, *, axis_name: str | None = None) -> tuple:
        rows = held[1]

        def one(state: TrainState, number: jax.Array) -> tuple:
            frame = (first + number * config.batch_size) % FRAMES
            state, metrics = train_step(
                state, batch_of(rows, frame), axis_name=axis_name
            )
            sums = metrics.loss_sum, metrics.wins, metrics.pairs
            return state, jnp.stack(sums)

        state, sums = jax.lax.scan(one, held[0], jnp.arange(steps))
        return (state, rows), sums

    return run


def main() -> None:
    """Train until the work, or the time, is used up; report."""
    on_cpu = jax.default_backend() == "cpu"
    if _FULL.value and on_cpu:
        raise InputError("--full: cpu: expected an accelerator; it would take days")
    size = _BATCH.value or (256 if on_cpu else 65536)
    steps = 1 if on_cpu else STEPS
    config = TrainConfig(batch_size=size, sampler=FEW, learning_rate=1e-3)
    with dataset_or_synthetic(_DATA.value) as path:
        dataset = open_dataset(path)
        features = feature_map(config.features)
        normaliser = fit_normaliser(normaliser_rows(dataset, config), features)
        rows = dataset.load("train")
    parallel = parallelise(make_steps(config, _HOW.value, steps), _HOW.value, size)
    held = parallel.replicate((init_state(config, normaliser), rows))

    def take(held: tuple, call: int) -> tuple:
        first = (call * steps * size + np.arange(size, dtype=np.int64)) % FRAMES
        return parallel.step(held, parallel.place(first.astype(np.int32)))

    held, sums = jax.block_until_ready(take(held, 0))  # compiles
    begin, done, kept, queries = time.perf_counter(), 0, [], 0.0
    while True:
        held, sums = take(held, done)
        done += 1
        kept.append(sums)
        if done % 8 == 0:  # a few calls are in flight
            queries += float(np.sum([np.asarray(x)[:, 2] for x in kept[-8:]]))
            seconds = time.perf_counter() - begin
            enough = done * steps * size >= EPOCHS * FRAMES and (
                queries >= EPOCHS * QUERIES
            )
            if enough if _FULL.value else seconds >= _SECONDS.value:
                break
    found = np.concatenate([np.asarray(x, np.float64) for x in kept])
    parts = np.array_split(found, min(CURVE_POINTS, len(found)))
    loss, wins, pairs = np.array([part.sum(axis=0) for part in parts]).T
    frames = done * steps * size
    result = {
        "frames": frames,
        "queries": queries,
        "queries_per_frame": queries / frames,
        "seconds": seconds,
        "frames_per_s": frames / seconds,
        "queries_per_s": queries / seconds,
        "candidates_per_frame": num_candidates(FEW),
        "scenes": Path(_DATA.value or "synthetic traffic").name,
        "stored_scenes_cycled": int(rows.vehicle.shape[0]),
        "batch_size": size,
        "parallel": _HOW.value,
        "devices_used": 1 if _HOW.value == "jit" else jax.device_count(),
        "complete": frames >= EPOCHS * FRAMES and queries >= EPOCHS * QUERIES,
        "loss_curve": (loss / pairs).tolist(),
        "pairs_won_curve": (wins / pairs).tolist(),
    }
    needed = EPOCHS * max(FRAMES / (frames / seconds), QUERIES / (queries / seconds))
    print(f"{frames:,} frames, {queries:,.0f} queries in {seconds:.1f} s")
    print(f"pairs won {wins[0] / pairs[0]:.1%} -> {wins[-1] / pairs[-1]:.1%}")
    if not result["complete"]:
        result["extrapolated_seconds_of_the_full_run"] = needed
        print(f"extrapolated, not run: {needed / 3600:.1f} h for the full amount")
    write("paper_scale", result, _OUTPUT.value, data=_DATA.value)


if __name__ == "__main__":
    run(main)
