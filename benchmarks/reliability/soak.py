"""A long night in one process: does anything grow, or come out differently?

    python -m benchmarks.reliability.soak --seconds=1200 --output=benchmarks/results

Every round works in a new folder: a few small logs are written and imported, a reward
is trained for an epoch, stopped after a checkpoint and resumed, exported, ranked,
driven, judged by the gate and reported. Every round's outputs have to be the first
round's to the bit, and what the process holds may not grow beyond `Limit`s after the
warm-up (the first quarter of the rounds). Ends with 1 otherwise.

`--leak=MB` keeps so much of every round: this file has to say so and end with 1.
Writes soak.json.
"""

import contextlib
import gc
import os
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np
import psutil
from absl import flags

from benchmarks.common import resident_mb, write
from benchmarks.reliability.jobs import Facts, different, jobs, write_logs
from benchmarks.reliability.memory import in_use_mb, kept, rise, watched
from benchmarks.reliability.small import SHARD_SCENES
from rcirl_jax.cli.running import provenance, run
from rcirl_jax.data import importing
from rcirl_jax.data.importing import ImportConfig, Logs
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.evaluation.gate.types import GateConfig
from rcirl_jax.runtime.compiling import compiles
from rcirl_jax.runtime.executors import Serial
from rcirl_jax.train.loop import Running
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.tuning.loop import tune
from rcirl_jax.tuning.run import Run, TuneConfig

_SECONDS = flags.DEFINE_float("seconds", 1200.0, "of the whole soak")
_LEAK = flags.DEFINE_float("leak", 0.0, "MiB kept of every round, to be found")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")

STRIDE_S = 2.0  # s between planning frames
BATCH, CHECKPOINT_EVERY, STOP_AT = 8, 3, 5  # the resume repeats two steps
CASES, DURATION_S = 2, 2.0  # of every family, and s of each; the gate wants 30
LEAST_ROUNDS = 6  # so that enough of them are left after the warm-up
# rise allowed: a share of resident memory, or so many MiB; a round for the others.
# A fall of resident memory hides a leak, what malloc has in use does not fall.
RSS_SHARE, RSS_MB = 0.05, 50.0
IN_USE_MB = 0.5
BLOCKS = 3_000  # most of 1,490 that are kept are tensorstore's, which orbax asks for
# things that may be kept over all rounds: an unnamed pool in C++ lets one of its
# threads go and starts it again; Python's own are counted by themselves
KEPT = {
    **{"threads": 4, "python_threads": 0, "open_files": 0},
    **{"live_arrays": 0, "compiled": 0},
}


class _Stopped(Exception):
    """The training was told to stop here."""


def look() -> dict[str, float]:
    """At this process, at the end of a round."""
    gc.collect()
    return {
        "rss_mb": round(resident_mb(), 1),
        "in_use_mb": round(in_use_mb(), 2),  # of malloc
        "blocks": sys.getallocatedblocks(),  # of Python's allocator
        "open_files": psutil.Process().num_fds(),
        "threads": psutil.Process().num_threads(),  # of the system
        "python_threads": threading.active_count(),
        "live_arrays": len(jax.live_arrays()),
    }


def _stop(step: int) -> None:
    if step == STOP_AT:
        raise _Stopped


def _run(facts: Mapping[str, object], running: Running) -> Run:
    """A run of the tuning loop in the present folder."""
    return Run(
        folder=Path("run"),
        config=TuneConfig(
            train=TrainConfig(batch_size=BATCH, epochs=1, positive="nearest"),
            gate=GateConfig(),
            suite="smoke",
            cases=CASES,
            duration_s=DURATION_S,
        ),
        executor=Serial(),
        running=running,
        facts=facts,
        say=lambda line: None,
    )


def _work(facts: Mapping[str, object]) -> Facts:
    """One round in the present folder: the digests of what came out."""
    write_logs(Path("logs"))
    config = ImportConfig(format="csv", collect=CollectConfig(stride_s=STRIDE_S))
    logs = [Logs(format="csv", input=Path("logs"), source=None, config=config)]
    # told to stop after a checkpoint, then again by the same command
    with contextlib.suppress(_Stopped):
        stopping = Running(checkpoint_every=CHECKPOINT_EVERY, on_step=_stop)
        tune(_run(facts, stopping), logs, "train")
    if not list(Path("run").glob("train-*/seed-0/checkpoints/*/sha256.json")):
        raise ValueError("the training was to stop after a checkpoint")
    tune(_run(facts, Running()), logs)
    return jobs(Path())["autotune"].outcome(Path())


def problems(series: Mapping[str, Sequence[float]]) -> list[str]:
    """Returns what has grown by more than is allowed."""
    resident = watched(series["rss_mb"])
    limits = {
        "rss_mb": max(RSS_SHARE * float(np.median(resident)), RSS_MB),
        "in_use_mb": IN_USE_MB * (resident.size - 1),
        "blocks": BLOCKS * (resident.size - 1),
    }
    grown = {name: rise(series[name]) - limit for name, limit in limits.items()}
    grown |= {name: kept(series[name]) - limit for name, limit in KEPT.items()}
    return [
        f"{name} grew by {over:.1f} more than is allowed"
        for name, over in grown.items()
        if over > 0.0
    ]


def main() -> None:
    """Rounds until the time is over."""
    importing.SHARD_SCENES = SHARD_SCENES  # several shards a dataset
    facts, end = provenance(), time.monotonic() + _SECONDS.value
    series: dict[str, list[float]] = {}
    first, found, leaked = {}, [], []
    rounds = 0
    while rounds < LEAST_ROUNDS or time.monotonic() < end:
        new = tempfile.TemporaryDirectory(prefix="rcirl-soak-")
        with compiles() as programs, new as folder, contextlib.chdir(folder):
            made = _work(facts)
        leaked.append(os.urandom(int(_LEAK.value * 2**20)))
        first, rounds = first or made, rounds + 1
        odd = different(made, first)
        found += [f"round {rounds}: different: {name}" for name in odd[:3]]
        seen = {**look(), "compiled": len(programs)}
        for name, value in seen.items():
            series.setdefault(name, []).append(value)
        print(f"round {rounds}: {seen}", flush=True)
    found += problems(series)
    result = {
        "rounds": rounds,
        "outputs_compared": len(first),
        "problems": found,
        "rise": {name: round(rise(values), 2) for name, values in series.items()},
        "series": series,
    }
    write("soak", result, _OUTPUT.value)
    print("\n".join(found) or f"{rounds} rounds within the limits", flush=True)
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    run(main)
