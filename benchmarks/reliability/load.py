"""As much as a large release asks for: is memory bounded?

    python -m benchmarks.reliability.load --what=suite,import --output=DIR

suite: `--cases` closed-loop cases, the whole catalogue of as many seeds as that takes,
driven by `evaluation.closed_loop.suite.run_suite` as `experiments.simulate` does:
the four judges, IDM among them, then the hand-set cost, which plans 64 candidates a
step. `--duration` below 120 s makes it another suite than the paper's, and the JSON
says so.

import: `--scenes` scenes of one generated log (platoons in waves, 2 GB for 10 million)
by `experiments.import_logs` as a user would call it, with its usual filters and
stride, onto the disk, which has to have room for the log and the dataset.

A thread looks at resident memory every second, with all worker processes (what they
share counts in each). Bounded: the median over the last tenth of the work is at most
10 % or 200 MiB, whichever is more, above that over the second tenth, and no look sees
1,000 MiB more than both. The whole suite, its files written, may at no moment have held
1,000 MiB more than its first row, and the end of an import 600 more than its cutting
(`memory.py`). Ends with 1 otherwise. Writes load_suite.json and load_import.json.
"""

import dataclasses
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from absl import flags

from benchmarks.common import LANE_TOML, untrained, write
from benchmarks.reliability.memory import (
    BOUNDED,
    FINISHING_MB,
    PEAK_MB,
    Level,
    Sample,
    Watch,
    level,
    thinned,
    too_much,
)
from rcirl_jax.commands.flags.common import provenance, run
from rcirl_jax.data.store.files import MARK
from rcirl_jax.data.store.shards import shard_key
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.suite import (
    SuiteConfig,
    drive_here,
    run_suite,
    write_suite,
)
from rcirl_jax.planner.rank import RankConfig
from rcirl_jax.simulation.cases import STEP_S
from rcirl_jax.simulation.metrics import CaseMetrics
from rcirl_jax.simulation.rows import Row, baseline_row
from rcirl_jax.simulation.suite import (
    FULL_S,
    CaseRef,
    CaseSet,
    catalogue_set,
    suite_refs,
)

KINDS = ("suite", "import")
_WHAT = flags.DEFINE_list("what", list(KINDS), "suite, import")
_CASES = flags.DEFINE_integer("cases", 34_200, "of the suite", 1)
_ROWS = flags.DEFINE_list("rows", ["hand-set", "IDM"], "baselines that drive")
_DURATION = flags.DEFINE_float("duration", FULL_S, "s of a case")
_CHUNK = flags.DEFINE_integer("chunk", 180, "cases driven together", 1)
_SCENES = flags.DEFINE_integer("scenes", 10_000_000, "of the import", 1)
_CARS = flags.DEFINE_integer("cars", 100, "at any time in the imported log", 1)
_WORKERS = flags.DEFINE_integer("processes", 2, "workers of the import", 1)
_FOLDER = flags.DEFINE_string("folder", None, "where logs and datasets are written")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")

STAY_S = 60.0  # s that a car is seen
CAR_ROWS = 600
CAR_SCENES = 100  # about
LEAST_SHARDS = 11  # seen one after the other, so that every tenth of them is
# read in pieces from the first byte on, so that a slice is read as the whole is
TOML = "long_bytes = 1\n" + LANE_TOML


def whole(found: Level) -> dict:
    """A level with numbers of a readable length."""
    shown = {k: v for k, v in dataclasses.asdict(found).items() if k != "mb_per_unit"}
    return {k: round(v, 1) if isinstance(v, float) else v for k, v in shown.items()}


def refs_of(count: int) -> list[CaseRef]:
    """The first cases of the whole catalogue of seed 0, 1, ... in turn."""
    refs: list[CaseRef] = []
    while len(refs) < count:
        seed = refs[-1].seed + 1 if refs else 0
        refs += suite_refs("full", None, seed)
    return refs[:count]


class Watched:
    """`drive_here`, with somebody who looks at memory meanwhile."""

    def __init__(self) -> None:
        self.rows: dict[str, dict] = {}
        self.samples: dict[str, list[Sample]] = {}

    def __call__(self, row: Row, cases: CaseSet, config: SuiteConfig) -> CaseMetrics:
        """All cases with one row; its memory is in `rows`."""
        done, total = 0.0, len(cases.ids)
        watch, begin = Watch(os.getpid(), lambda: done), time.monotonic()

        def build(first: int, last: int) -> object:
            nonlocal done
            done = float(first)
            watch.look()
            return cases.build(first, last)

        with watch.every(1.0):
            made = drive_here(row, dataclasses.replace(cases, build=build), config)
        seconds, done = time.monotonic() - begin, float(total)
        watch.look()
        self.samples[row.name] = watch.samples
        self.rows[row.name] = {
            **whole(level(watch.samples, total)),
            "seconds": round(seconds, 1),
            "cases_per_s": round(total / seconds, 1),
            "plans": total * round(cases.duration_s / STEP_S),
        }
        print(f"{row.name}: {self.rows[row.name]}", flush=True)
        return made


def suite() -> list[str]:
    """Drive it; what grew."""
    if not 1.0 <= _DURATION.value <= FULL_S:
        raise InputError(f"--duration: {_DURATION.value}: expected 1 to {FULL_S:g} s")
    begin = time.monotonic()
    refs = refs_of(_CASES.value)
    cases = catalogue_set(refs, _DURATION.value)
    watched, config, planner = Watched(), SuiteConfig(chunk=_CHUNK.value), RankConfig()
    norm = untrained()[1]
    rows = [baseline_row(name, "paper21", norm, planner) for name in _ROWS.value]
    made = run_suite(rows, cases, config, watched)
    with tempfile.TemporaryDirectory(dir=_FOLDER.value) as folder:
        write_suite(made, Path(folder), provenance())
        files = {x.name: x.stat().st_size for x in Path(folder).iterdir()}
    result = {
        "cases": len(refs),
        "catalogue_seeds": 1 + refs[-1].seed,
        "duration_s": _DURATION.value,
        "seconds": round(time.monotonic() - begin, 1),
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10, 1),
        "rows": watched.rows,
        "result_sha256": made.facts["result_sha256"],
        "files_bytes": files,
        "series": {k: thinned(v, 60) for k, v in watched.samples.items()},
    }
    write("load_suite", result, _OUTPUT.value)
    odd = {k: x["outcome"] for k, x in watched.rows.items() if x["outcome"] != BOUNDED}
    first = next(iter(watched.rows.values()))["at_the_end"]
    return [
        *(f"suite: {name}: {outcome}" for name, outcome in odd.items()),
        *(f"suite: {x}" for x in too_much(result["peak_mb"], first + PEAK_MB)),
    ]


def write_log(path: Path, rows: int) -> int:
    """Rows of cars that enter one after the other; all drive the same waves.

    So nobody runs into another, and everybody's speed changes.
    """
    frame = written = 0
    with path.open("w") as file:
        file.write("t,id,x,y\n")
        cars, every_s = _CARS.value, STAY_S / _CARS.value
        while written < rows:
            lines = []
            for f in range(frame, frame + 100):
                t = 0.1 * f
                newest = int(t / every_s)
                car = np.arange(max(newest - cars + 1, 0), newest + 1)
                age = t - car * every_s
                x = 25.0 * age + 30.0 * np.sin(0.3 * age)
                lines += [
                    f"{t:.1f},vehicle-{c:08d},{a:.4f},0.1000\n"
                    for c, a in zip(car.tolist(), x.tolist(), strict=True)
                ]
            file.writelines(lines)
            written += len(lines)
            frame += 100
    return written


class Committed:
    """How many scenes lie in shards that are whole; each is read once."""

    def __init__(self, data: Path) -> None:
        self._data, self.counts = data, []

    def __call__(self) -> float:
        """Now."""
        while (mark := self._mark(len(self.counts))).is_file():
            self.counts.append(int(json.loads(mark.read_text())["count"]))
        return float(sum(self.counts))

    def _mark(self, number: int) -> Path:
        return self._data / shard_key(number) / MARK


def imports() -> list[str]:
    """Write a log and import it, watched; what grew.

    Raises:
      InputError: the import failed, or was too small to be watched.
    """
    with tempfile.TemporaryDirectory(dir=_FOLDER.value) as place:
        folder = Path(place)
        log, toml, data = folder / "log.csv", folder / "log.toml", folder / "data"
        toml.write_text(TOML)
        rows = write_log(log, int(1.02 * _SCENES.value * CAR_ROWS / CAR_SCENES))
        words = [sys.executable, "-m", "experiments.import_logs", "--format=csv"]
        words += [f"--input={log}", f"--source={toml}", f"--output={data}"]
        words += [f"--workers={_WORKERS.value}"]
        env = {**os.environ, "TMPDIR": place, "JAX_PLATFORMS": "cpu"}
        begin, process = time.monotonic(), subprocess.Popen(words, env=env)
        written = Committed(data)
        watch = Watch(process.pid, written)
        with watch.every(0.1 if rows < 1_000_000 else 1.0):
            status = process.wait()
        seconds = time.monotonic() - begin
        if status != 0:
            raise InputError(f"import: exit status {status}: expected a dataset")
        quality = json.loads((data / "manifest.json").read_text())["quality"]
        files = [x.stat().st_size for x in data.rglob("*") if x.is_file()]
        log_bytes = log.stat().st_size
    shards = sorted({sample.done for sample in watch.samples})
    if len(shards) < LEAST_SHARDS:
        raise InputError(
            f"import: {quality['scenes']} scenes, {len(shards)} shards seen: expected "
            f"{LEAST_SHARDS} at least: more scenes"
        )
    # the last shard is written when everything has been cut
    last = next(x.seconds for x in watch.samples if x.done >= shards[-2])
    cutting = [x for x in watch.samples if x.seconds <= last]
    finishing = watch.samples[len(cutting) :]
    found = level(cutting, cutting[-1].done)
    at_the_end = max((sample.all_mb for sample in finishing), default=0.0)
    result = {
        "scenes": quality["scenes"],
        "shards": len(written.counts),
        "rows": rows,
        "log_bytes": log_bytes,
        "dataset_bytes": sum(files),
        "bytes_per_scene": round(sum(files) / quality["scenes"]),
        "workers": _WORKERS.value,
        "seconds": round(seconds, 1),
        "scenes_per_s": round(quality["scenes"] / seconds, 1),
        "cutting": whole(found),
        "main_process_mb_at_most": round(max(x.mb for x in cutting), 1),
        "finishing_mb_at_most": round(at_the_end, 1),
        "finishing_seconds": round(seconds - last, 1),
        "dropped": quality["dropped"],
        "series": thinned(watch.samples),
    }
    write("load_import", result, _OUTPUT.value)
    print({k: v for k, v in result.items() if k != "series"}, flush=True)
    grown = [] if found.outcome == BOUNDED else [found.outcome]
    held = too_much(at_the_end, found.at_the_end + FINISHING_MB)
    return [f"import: {x}" for x in (*grown, *held)]


def main() -> None:
    """What is asked for; status 1 where memory grew."""
    works = {"suite": suite, "import": imports}
    for name in _WHAT.value:
        if name not in works:
            raise InputError(f"--what: {name}: expected some of {', '.join(KINDS)}")
    problems = [text for name in _WHAT.value for text in works[name]()]
    print("\n".join(problems) or BOUNDED, flush=True)
    if problems:
        sys.exit(1)


if __name__ == "__main__":
    run(main)
