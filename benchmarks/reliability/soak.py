"""A long night in one process: does anything grow, or come out differently?

    python -m benchmarks.reliability.soak --seconds=1200 --output=benchmarks/results

Every round works in a new folder: a few small logs are written and imported, a reward
is trained for an epoch, stopped after a checkpoint and resumed, exported, read again,
ranked, driven over two cases of every family, judged by the gate and reported, with
the page of the data. After each round: resident memory, what
malloc has in use of it, open files, threads, live arrays, blocks of Python's allocator,
programs compiled, seconds. The first quarter of the rounds is warm-up; after it memory
may not rise by more than 5 % or 50 MiB, whichever is more (`memory.growth`), what is in
use by `IN_USE_MB` a round, blocks by `BLOCKS` a round; of the system's threads no more
than `THREADS` may be kept, and nothing else may rise at all, not by one
(`memory.growth`; gc's objects, which are some of the blocks, and seconds are
noted only), and every round's outputs have to be the first round's to the bit. Ends
with 1 otherwise.

`--leak=MB` keeps so much of every round: this file has to say so and end with 1.
Writes soak.json after every tenth round and at the end.
"""

import contextlib
import dataclasses
import gc
import os
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import jax
import psutil
from absl import flags

from benchmarks.common import resident_mb, write
from benchmarks.reliability.jobs import Facts, jobs, write_logs
from benchmarks.reliability.memory import (
    WARM_UP,
    Growth,
    growth,
    in_use_mb,
    memory_growth,
)
from benchmarks.reliability.small import SHARD_SCENES
from rcirl_jax.autotune.config import TuneConfig
from rcirl_jax.autotune.loop import tune
from rcirl_jax.autotune.run import Run
from rcirl_jax.commands.flags.common import provenance, run
from rcirl_jax.data import importing
from rcirl_jax.data.importing import ImportConfig
from rcirl_jax.data.logs import Logs
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.evaluation.gate.types import GateConfig
from rcirl_jax.report.data.page import choose_rows, write_data_page
from rcirl_jax.runtime.executors import Here
from rcirl_jax.runtime.pipeline import file_sha256
from rcirl_jax.train.running import Running
from rcirl_jax.train.state import TrainConfig

_SECONDS = flags.DEFINE_float("seconds", 1200.0, "of the whole soak")
_LEAK = flags.DEFINE_float("leak", 0.0, "MiB kept of every round, to be found")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")

STRIDE_S = 2.0  # s between planning frames
BATCH, CHECKPOINT_EVERY, STOP_AT = 8, 3, 5  # the resume repeats two steps
CASES, DURATION_S = 2, 2.0  # of every family, and s of each; the gate wants 30
DRAWN = 1  # scenes of the page of the data
COMPILED = "/jax/core/compile/backend_compile_duration"
# a round; most of 1,490 that are kept are tensorstore's JSON that orbax asks for
BLOCKS = 3_000
# MiB a round. A fall of resident memory hides a leak, and this one does not fall
IN_USE_MB = 0.5
# kept over all rounds: an unnamed pool in C++ lets one of its threads go and starts it
# again, and fills up late; Python's own are counted by themselves
THREADS = 4
LEAST_ROUNDS = 6  # so that enough of them are left after the warm-up


class _Stopped(Exception):
    """The training was told to stop here."""


def look() -> dict[str, float]:
    """At this process, at the end of a round."""
    gc.collect()
    return {
        "rss_mb": round(resident_mb(), 1),
        "in_use_mb": round(in_use_mb(), 2),  # of malloc
        "open_files": psutil.Process().num_fds(),
        "threads": psutil.Process().num_threads(),  # of the system
        "python_threads": threading.active_count(),
        "live_arrays": len(jax.live_arrays()),
        "objects": len(gc.get_objects()),  # that gc lists
        "blocks": sys.getallocatedblocks(),  # also of all others
    }


@contextlib.contextmanager
def compiles() -> Iterator[list[str]]:
    """Names of the programs compiled inside the `with` block."""
    found: list[str] = []

    def listen(event: str, duration_secs: float, **kwargs: str | int) -> None:
        del duration_secs
        if event == COMPILED:
            found.append(str(kwargs.get("fun_name", "")))

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield found
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def _stop(step: int) -> None:
    if step == STOP_AT:
        raise _Stopped


def _run(facts: Mapping[str, object], running: Running) -> Run:
    """A run of the tuning loop in the present folder."""
    train = TrainConfig(batch_size=BATCH, epochs=1, positive="nearest")
    return Run(
        folder=Path("run"),
        config=TuneConfig(
            train=train,
            gate=GateConfig(),
            suite="smoke",
            cases=CASES,
            duration_s=DURATION_S,
        ),
        executor=Here(),
        running=running,
        facts=facts,
        say=lambda line: None,
    )


def _logs() -> Logs:
    collect = CollectConfig(stride_s=STRIDE_S)
    config = ImportConfig(format="csv", collect=collect)
    return Logs(format="csv", input=Path("logs"), source=None, config=config)


def _work(facts: Mapping[str, object]) -> Facts:
    """One round in the present folder: the digests of what came out."""
    write_logs(Path("logs"))
    # told to stop after a checkpoint, then again by the same command
    with contextlib.suppress(_Stopped):
        stopping = Running(checkpoint_every=CHECKPOINT_EVERY, on_step=_stop)
        tune(_run(facts, stopping), [_logs()], "train")
    if not list(Path("run").glob("train-*/seed-0/checkpoints/*/sha256.json")):
        raise ValueError("the training was to stop after a checkpoint")
    tune(_run(facts, Running()), [_logs()])
    (data,) = Path("run").glob("dataset-*")
    dataset, page = open_dataset(data), Path("data/index.html")
    rows = choose_rows(dataset.column("scene.tags"), DRAWN)
    write_data_page(page, dataset, rows, "a night's data", {})
    outcome = jobs(Path())["autotune"].outcome(Path())
    return {**outcome, str(page): file_sha256(page)}


@dataclasses.dataclass(kw_only=True)
class Soak:
    """What came of it so far."""

    series: dict[str, list[float]] = dataclasses.field(default_factory=dict)
    first: Facts = dataclasses.field(default_factory=dict)
    # round -> outputs that were not the first round's
    different: dict[int, list[str]] = dataclasses.field(default_factory=dict)
    late_programs: list[str] = dataclasses.field(default_factory=list)
    kept: list[bytearray] = dataclasses.field(default_factory=list)  # of --leak

    @property
    def rounds(self) -> int:
        """That are finished."""
        return len(self.series.get("seconds", []))

    def round(self, facts: Mapping[str, object]) -> None:
        """One more, in a new folder, which is removed."""
        begin, new = time.monotonic(), tempfile.TemporaryDirectory(prefix="rcirl-soak-")
        with compiles() as programs, new as folder, contextlib.chdir(folder):
            made = _work(facts)
        if _LEAK.value:
            self.kept.append(bytearray(os.urandom(int(_LEAK.value * 2**20))))
        self.first = self.first or made
        names = sorted(made.keys() | self.first.keys())
        odd = [name for name in names if made.get(name) != self.first.get(name)]
        if odd:
            self.different[self.rounds + 1] = odd
            print(f"different from the first round: {', '.join(odd)}", flush=True)
        self.late_programs, seen = programs, look()
        seen |= {"compiled": len(programs), "seconds": time.monotonic() - begin}
        for name, value in seen.items():
            self.series.setdefault(name, []).append(round(value, 2))
        print(f"round {self.rounds}: {seen}", flush=True)

    def growths(self) -> dict[str, Growth]:
        """Of every series that may not grow."""
        series = self.series
        rises = self.rounds - int(WARM_UP * self.rounds) - 1  # from round to round
        counted = ("open_files", "python_threads", "live_arrays", "compiled")
        return {
            "rss_mb": memory_growth(series["rss_mb"]),
            "in_use_mb": growth(series["in_use_mb"], IN_USE_MB * rises),
            "blocks": growth(series["blocks"], BLOCKS * rises),
            "threads": growth(series["threads"], THREADS, counted=True),
            **{n: growth(series[n], counted=True) for n in counted},
        }

    def problems(self) -> list[str]:
        """What a night must not do; nothing is good."""
        found = [
            f"{name} grew by {x.by:.1f} over {x.rounds} rounds"
            for name, x in self.growths().items()
            if x.grows
        ]
        return found + [
            f"round {number}: different: {', '.join(names[:3])}"
            for number, names in self.different.items()
        ]


def within(growths: Mapping[str, Growth]) -> str:
    """What a run without problems has shown: slopes within limits, not none."""
    watched = {name: growths[name] for name in ("rss_mb", "in_use_mb", "blocks")}
    return "within the limit: " + ", ".join(
        f"{name} {x.per_round:,.2f} a round [{x.low:,.2f}, {x.high:,.2f}], {x.by:,.1f} "
        f"in all (limit {x.allowed:,.1f})"
        for name, x in watched.items()
    )


def save(soak: Soak) -> list[str]:
    """Write soak.json; the problems."""
    growths, problems = soak.growths(), soak.problems()
    seconds = soak.series["seconds"]
    result = {
        "rounds": soak.rounds,
        "seconds": round(sum(seconds), 1),
        "warm_up_share": WARM_UP,
        "outputs_compared": len(soak.first),
        "outcome": problems[0] if problems else within(growths),
        "problems": problems,
        "growth": growths,
        "programs_of_the_last_round": soak.late_programs,
        "series": soak.series,
    }
    write("soak", result, _OUTPUT.value)
    return problems


def main() -> None:
    """Rounds until the time is over."""
    importing.SHARD_SCENES = SHARD_SCENES  # several shards a dataset
    facts, soak = provenance(), Soak()
    end = time.monotonic() + _SECONDS.value
    while soak.rounds < LEAST_ROUNDS or time.monotonic() < end:
        soak.round(facts)
        if soak.rounds % 10 == 0:
            save(soak)
    problems = save(soak)
    print("\n".join(problems) or within(soak.growths()), flush=True)
    if problems:
        sys.exit(1)


if __name__ == "__main__":
    run(main)
