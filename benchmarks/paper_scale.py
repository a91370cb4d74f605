"""The paper's amount of training: 718 million frames, 2.8 billion queries, 2 epochs.

    python -m benchmarks.paper_scale --data=DATASET          # a slice of 60 s
    python -m benchmarks.paper_scale --data=DATASET --full   # all, on accelerators

Each frame is a stored scene, cycled (frame f shows scene f mod n; n is printed),
whose ego starts a little faster or slower by f, with candidates drawn for that
frame and epoch alone: sampling and features are computed anew every time, and
nothing but the n scenes is kept. With 718 million frames the paper's 2.8 billion
queries are four per frame, so the sampler is cut to a few candidates of every
family; queries (feasible pairs) are counted, not assumed. The loss and the share of
pairs the human wins are kept over the run. Without --full, the rate of a slice is
extrapolated, and the result says so.
"""

import functools
import time

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags

from benchmarks.common import write
from experiments.common import run
from rcirl_jax.data.store import open_dataset
from rcirl_jax.errors import InputError
from rcirl_jax.features import feature_map
from rcirl_jax.sampling import SamplerConfig, num_candidates
from rcirl_jax.train.loop import fit_normaliser_on
from rcirl_jax.train.parallel import parallelise
from rcirl_jax.train.state import Batch, TrainConfig, TrainState
from rcirl_jax.train.step import init_state, make_train_step
from rcirl_jax.types import Demonstration

_DATA = flags.DEFINE_string(
    "data", None, "dataset whose scenes are cycled", required=True
)
_FULL = flags.DEFINE_bool("full", False, "run everything instead of a slice")
_SECONDS = flags.DEFINE_float("seconds", 60.0, "length of the slice")
_BATCH = flags.DEFINE_integer("batch_size", 0, "frames; 0: 256, accelerators 65536")
_HOW = flags.DEFINE_string("parallel", "jit", "jit, pmap, shard_map or jit_sharded")
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
    stop_brakings=(1.5,),
    envelopes=((0.965, 1.3, 0.8, 2.5),),
    emergency_brakings=(4.0,),
    num_random=1,
)
CURVE_POINTS = 200  # points kept of loss and pairs won
SPEED_SPREAD = 0.02  # 1, by which frames of one stored scene differ in speed


def batch_of(rows: Demonstration, first: jax.Array, size: int) -> Batch:
    """Frames `first` to `first + size` made from the stored scenes."""
    frame = first + jnp.arange(size, dtype=jnp.int32)
    taken = jax.tree.map(lambda x: x[frame % x.shape[0]], rows)
    # multiples of the golden ratio, mod 1: spread evenly over any run of frames; whole
    # numbers, as float32 cannot tell late frames apart
    turn = frame.astype(jnp.uint32) * jnp.uint32(round(2**32 * 0.6180339887))
    share = turn.astype(jnp.float32) / 2.0**32 - 0.5
    scene, ego = taken.scene, taken.scene.ego
    speed = ego.v * (1.0 + SPEED_SPREAD * share)
    taken = taken.replace(scene=scene.replace(ego=ego.replace(v=speed)))
    return Batch(demonstrations=taken, weight=jnp.ones(size), index=frame)


def main() -> None:
    """Train until the frames, or the time, are used up; report."""
    on_cpu = jax.default_backend() == "cpu"
    if _FULL.value and on_cpu:
        raise InputError("--full: cpu: expected an accelerator; it would take days")
    size = _BATCH.value or (256 if on_cpu else 65536)
    config = TrainConfig(batch_size=size, sampler=FEW, learning_rate=1e-3)
    dataset = open_dataset(_DATA.value)
    features = feature_map(config.features)
    normaliser = fit_normaliser_on(dataset, config, features)
    rows = jax.tree.map(jnp.asarray, dataset.load("train"))
    make = jax.jit(functools.partial(batch_of, size=size))
    parallel = parallelise(make_train_step(config), _HOW.value, size)
    step = parallel.step
    state: TrainState = parallel.replicate(init_state(config, normaliser))
    per_epoch = -(-FRAMES // size)
    total = per_epoch * EPOCHS if _FULL.value else None
    state, _ = step(state, make(rows, jnp.int32(0)))  # compiles
    begin, done, sums = time.perf_counter(), 0, []
    while done < total if total else time.perf_counter() - begin < _SECONDS.value:
        first = jnp.int32(size * (done % per_epoch))
        state, metrics = step(state, make(rows, first))
        sums.append(jnp.stack([metrics.loss_sum, metrics.wins, metrics.pairs]))
        done += 1
        if done % 64 == 0:
            jax.block_until_ready(state)
    jax.block_until_ready(state)
    seconds = time.perf_counter() - begin
    found = np.asarray(jnp.stack(sums), np.float64)
    parts = np.array_split(found, min(CURVE_POINTS, done))
    loss, wins, pairs = np.array([part.sum(axis=0) for part in parts]).T
    frames, queries = done * size, found[:, 2].sum()
    result = {
        "frames": frames,
        "queries": queries,
        "seconds": seconds,
        "frames_per_s": frames / seconds,
        "queries_per_s": queries / seconds,
        "candidates_per_frame": num_candidates(FEW),
        "stored_scenes_cycled": int(rows.vehicle.shape[0]),
        "batch_size": size,
        "parallel": _HOW.value,
        "devices": jax.local_device_count(),
        "complete": bool(total),
        "loss_curve": (loss / pairs).tolist(),
        "pairs_won_curve": (wins / pairs).tolist(),
    }
    needed = EPOCHS * max(FRAMES / (frames / seconds), QUERIES / (queries / seconds))
    print(f"{frames:,} frames, {queries:,.0f} queries in {seconds:.1f} s")
    print(f"pairs won {wins[0] / pairs[0]:.1%} -> {wins[-1] / pairs[-1]:.1%}")
    if not total:
        result["extrapolated_seconds_of_the_full_run"] = needed
        print(f"extrapolated, not run: {needed / 3600:.1f} h for the full amount")
    print(f"written: {write('paper_scale', result, _OUTPUT.value)}")


if __name__ == "__main__":
    run(main)
