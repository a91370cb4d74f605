"""As much as a large release asks for: is memory bounded?

    python -m benchmarks.reliability.load --what=suite --what=import

suite: `--cases` closed-loop cases, the whole catalogue of as many seeds as that takes,
driven as `rcirl simulate` drives them: the four judges, then the baselines of
`--rows`. `--duration` below 120 s makes it another suite than the paper's.

import: `--scenes` scenes of one generated log (2 GB for 10 million) by
`rcirl import` as a user calls it, onto the disk, which has to have room for
the log and the dataset.

Resident memory with all worker processes is looked at every second; its limits are
those of `memory.level`. Writes load_suite.json and load_import.json; ends with 1 where
memory grew.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from absl import flags

from benchmarks.common import LANE_TOML, untrained, write
from benchmarks.reliability.memory import level, looking
from rcirl_jax.cli.running import run
from rcirl_jax.data.store.dataset import shard_key
from rcirl_jax.data.store.files import MARK
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.suite import SuiteConfig, drive_here, run_suite
from rcirl_jax.planner.rank import RankConfig
from rcirl_jax.simulation.metrics import CaseMetrics
from rcirl_jax.simulation.rows import Row, baseline_row
from rcirl_jax.simulation.suite import (
    FULL_S,
    CaseRef,
    CaseSet,
    catalogue_set,
    suite_refs,
)

_WHAT = flags.DEFINE_multi_enum("what", ["suite", "import"], ["suite", "import"], "")
_CASES = flags.DEFINE_integer("cases", 34_200, "of the suite", 1)
_ROWS = flags.DEFINE_list("rows", ["hand-set", "IDM"], "baselines that drive")
_DURATION = flags.DEFINE_float("duration", FULL_S, "s of a case", 1.0, FULL_S)
_CHUNK = flags.DEFINE_integer("chunk", 180, "cases driven together", 1)
_SCENES = flags.DEFINE_integer("scenes", 10_000_000, "of the import", 1)
_CARS = flags.DEFINE_integer("cars", 100, "at any time in the imported log", 1)
_WORKERS = flags.DEFINE_integer("processes", 2, "workers of the import", 1)
_FOLDER = flags.DEFINE_string("folder", None, "where logs and datasets are written")
_EVERY = flags.DEFINE_float("every", 1.0, "s between two looks at memory")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")

STAY_S = 60.0  # s that a car is seen
CAR_ROWS, CAR_SCENES = 600, 100  # of each car, the scenes about
LOOK_S = 0.05  # s between two looks for the first shard
# read in pieces from the first byte on, so that a slice is read as the whole is
TOML = "long_bytes = 1\n" + LANE_TOML


def refs_of(count: int) -> list[CaseRef]:
    """The first cases of the whole catalogue of seed 0, 1, ... in turn."""
    refs: list[CaseRef] = []
    while len(refs) < count:
        seed = refs[-1].seed + 1 if refs else 0
        refs += suite_refs("full", None, seed)
    return refs[:count]


def suite() -> list[str]:
    """Drive it; what grew."""
    cases, found, problems = refs_of(_CASES.value), {}, []

    def drive(row: Row, cases: CaseSet, config: SuiteConfig) -> CaseMetrics:
        with looking(os.getpid(), _EVERY.value) as held:
            made = drive_here(row, cases, config)
        found[row.name], wrong = level(held)
        problems.extend(f"suite: {row.name}: {text}" for text in wrong)
        print(f"{row.name}: {found[row.name]}", flush=True)
        return made

    weights = untrained()
    rows = [
        baseline_row(name, "paper21", weights, RankConfig()) for name in _ROWS.value
    ]
    begin, config = time.monotonic(), SuiteConfig(chunk=_CHUNK.value)
    run_suite(rows, catalogue_set(cases, _DURATION.value), config, drive)
    result = {
        "cases": len(cases),
        "duration_s": _DURATION.value,
        "seconds": round(time.monotonic() - begin, 1),
        "rows": found,
    }
    write("load_suite", result, _OUTPUT.value)
    return problems


def write_log(path: Path, rows: int) -> None:
    """Rows of cars that enter one after the other; all drive the same waves.

    So nobody runs into another, and everybody's speed changes.
    """
    cars, every_s = _CARS.value, STAY_S / _CARS.value
    frame = written = 0
    with path.open("w") as file:
        file.write("t,id,x,y\n")
        while written < rows:
            t = 0.1 * frame
            newest = int(t / every_s)
            car = np.arange(max(newest - cars + 1, 0), newest + 1)
            age = t - car * every_s
            x = 25.0 * age + 30.0 * np.sin(0.3 * age)
            file.writelines(
                f"{t:.1f},vehicle-{c:08d},{a:.4f},0.1000\n"
                for c, a in zip(car.tolist(), x.tolist(), strict=True)
            )
            written += car.size
            frame += 1


def imports() -> list[str]:
    """Write a log and import it, watched from its first shard on; what grew.

    Raises:
      InputError: the import failed.
    """
    with tempfile.TemporaryDirectory(dir=_FOLDER.value) as place:
        log, toml, data = (Path(place) / name for name in ("log.csv", "log.toml", "d"))
        toml.write_text(TOML)
        write_log(log, int(1.02 * _SCENES.value * CAR_ROWS / CAR_SCENES))
        words = [sys.executable, "-m", "rcirl_jax", "import", "--format=csv"]
        words += [f"--input={log}", f"--source={toml}", f"--output={data}"]
        words += [f"--workers={_WORKERS.value}"]
        env = {**os.environ, "TMPDIR": place, "JAX_PLATFORMS": "cpu"}
        begin, process = time.monotonic(), subprocess.Popen(words, env=env)
        while process.poll() is None and not (data / shard_key(0) / MARK).is_file():
            time.sleep(LOOK_S)
        with looking(process.pid, _EVERY.value) as held:
            status = process.wait()
        seconds = time.monotonic() - begin
        if status != 0:
            raise InputError(f"import: exit status {status}: expected a dataset")
        quality = json.loads((data / "manifest.json").read_text())["quality"]
        files = [x.stat().st_size for x in data.rglob("*") if x.is_file()]
    found, problems = level(held)
    result = {
        "scenes": quality["scenes"],
        "dataset_bytes": sum(files),
        "workers": _WORKERS.value,
        "seconds": round(seconds, 1),
        "scenes_per_s": round(quality["scenes"] / seconds, 1),
        "memory": found,
    }
    write("load_import", result, _OUTPUT.value)
    print(result, flush=True)
    return [f"import: {text}" for text in problems]


def main() -> None:
    """Runs what is asked for; status 1 where memory grew."""
    works = {"suite": suite, "import": imports}
    problems = [text for name in _WHAT.value for text in works[name]()]
    print("\n".join(problems) or "bounded", flush=True)
    sys.exit(1 if problems else 0)


if __name__ == "__main__":
    run(main)
