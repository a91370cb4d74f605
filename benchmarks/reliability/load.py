"""As much as a large release asks for: is memory bounded?

    python -m benchmarks.reliability.load --what=suite,import --output=DIR

suite: `--cases` closed-loop cases, the whole catalogue of as many seeds as that takes,
driven by `evaluation.closed_loop.suite.run_suite` as `experiments.simulate` does:
the four judges, IDM among them, then the hand-set cost, which plans 64 candidates a
step. `--duration` below 120 s makes it another suite than the paper's, and the JSON
says so.

import: `--scenes` scenes of one generated log (platoons in waves, 2 GB for 10 million)
by `experiments.import_logs` as a user would call it, with its usual filters and
stride, onto the disk. `--seconds=N` imports a slice instead, as many scenes as a small
first import says that take N seconds; what 10 million take is then extrapolated.

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
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from absl import flags

from benchmarks.common import LANE_TOML, resident_mb, untrained, write
from benchmarks.reliability.memory import (
    Level,
    Sample,
    Watch,
    finishing_problems,
    level,
    peak_problems,
    thinned,
)
from experiments.flags.common import provenance, run
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
_SECONDS = flags.DEFINE_float("seconds", 0.0, "of a slice of the import; 0: all of it")
_CARS = flags.DEFINE_integer("cars", 100, "at any time in the imported log", 1)
_PROBE = flags.DEFINE_integer("probe", 40_000, "scenes of the small first import", 1)
_WORKERS = flags.DEFINE_integer("processes", 2, "workers of the import", 1)
_FOLDER = flags.DEFINE_string("folder", None, "where logs and datasets are written")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")

STAY_S = 60.0  # s that a car is seen
CAR_ROWS = 600
CAR_SCENES = 100  # about; the small first import says how many
LEAST_SHARDS = 3  # seen one after the other, so that there is a rate
SLICE_SHARDS = 15  # at least, so that every tenth of a slice is seen
BOUNDED = "bounded"
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
        watch = Watch(os.getpid(), lambda: done)

        def build(first: int, last: int) -> object:
            nonlocal done
            done = float(first)
            watch.look()
            return cases.build(first, last)

        begin = time.monotonic()
        watch.start()
        try:
            made = drive_here(row, dataclasses.replace(cases, build=build), config)
        finally:
            watch.stop()
        seconds = time.monotonic() - begin
        done = float(total)
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


def rows_of(names: Sequence[str]) -> list[Row]:
    """The baselines that drive."""
    config = RankConfig()
    return [baseline_row(name, "paper21", untrained()[1], config) for name in names]


def suite() -> list[str]:
    """Drive it; what grew."""
    if not 1.0 <= _DURATION.value <= FULL_S:
        raise InputError(f"--duration: {_DURATION.value}: expected 1 to {FULL_S:g} s")
    before, begin = resident_mb(), time.monotonic()
    refs = refs_of(_CASES.value)
    cases = catalogue_set(refs, _DURATION.value)
    named = resident_mb()
    watched, config = Watched(), SuiteConfig(chunk=_CHUNK.value)
    made = run_suite(rows_of(_ROWS.value), cases, config, watched)
    driven = resident_mb()
    with tempfile.TemporaryDirectory(dir=_FOLDER.value) as folder:
        write_suite(made, Path(folder), provenance())
        files = {x.name: x.stat().st_size for x in Path(folder).iterdir()}
    short = _DURATION.value < FULL_S
    result = {
        "cases": len(refs),
        "catalogue_seeds": 1 + refs[-1].seed,
        "duration_s": _DURATION.value,
        "is": f"cases of {_DURATION.value:g} s instead of {FULL_S:g} s"
        if short
        else "cases of full length",
        "seconds": round(time.monotonic() - begin, 1),
        "rss_mb": {
            "before": round(before, 1),
            "with_names_and_parameters": round(named, 1),
            "driven": round(driven, 1),
            "summarised_and_written": round(resident_mb(), 1),
        },
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
        *(f"suite: {line}" for line in peak_problems(first, result["peak_mb"])),
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Imported:
    """One import by its command."""

    rows: int
    log_bytes: int
    scenes: int
    shards: int
    dataset_bytes: int
    seconds: float
    scenes_per_s: float  # while shards are written, without start and checks
    cutting: list[Sample]  # up to the last full shard
    finishing: list[Sample]  # the rest, manifest, checks, oracle floor
    quality: dict


def import_rows(folder: Path, rows: int) -> Imported:
    """Write a log and import it, watched.

    Raises:
      InputError: the import failed, or was too small to be watched.
    """
    log, toml, data = folder / "log.csv", folder / "log.toml", folder / "data"
    toml.write_text(TOML)
    written = write_log(log, rows)
    words = [sys.executable, "-m", "experiments.import_logs", "--format=csv"]
    words += [f"--input={log}", f"--source={toml}", f"--output={data}"]
    words += [f"--workers={_WORKERS.value}"]
    env = {**os.environ, "TMPDIR": str(folder), "JAX_PLATFORMS": "cpu"}
    begin = time.monotonic()
    process = subprocess.Popen(words, env=env)
    written_scenes = Committed(data)
    watch = Watch(process.pid, written_scenes, every_s=_every(rows))
    watch.start()
    status = process.wait()
    seconds = time.monotonic() - begin
    watch.stop()
    if status != 0:
        raise InputError(f"import: exit status {status}: expected a finished dataset")
    quality = json.loads((data / "manifest.json").read_text())["quality"]
    # a look at a process that has just ended
    samples = [sample for sample in watch.samples if sample.mb]
    shards = sorted({sample.done for sample in samples})
    if len(shards) < LEAST_SHARDS:
        raise InputError(
            f"import: {quality['scenes']} scenes, {len(shards)} shards seen: expected "
            f"{LEAST_SHARDS} at least: more scenes"
        )
    # the last shard is written when everything has been cut
    last = next(x.seconds for x in samples if x.done >= shards[-2])
    cutting = [x for x in samples if x.seconds <= last]
    first = next(x for x in samples if x.done)
    made = Imported(
        rows=written,
        log_bytes=log.stat().st_size,
        scenes=quality["scenes"],
        shards=len(written_scenes.counts),
        dataset_bytes=sum(x.stat().st_size for x in data.rglob("*") if x.is_file()),
        seconds=seconds,
        scenes_per_s=(cutting[-1].done - first.done) / (last - first.seconds),
        cutting=cutting,
        finishing=samples[len(cutting) :],
        quality=quality,
    )
    shutil.rmtree(data)
    log.unlink()
    return made


def _every(rows: int) -> float:
    """Seconds between two looks: often in a short import."""
    return 0.1 if rows < 1_000_000 else 1.0


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


def _fits(folder: Path, scenes: float, probe: Imported) -> None:
    """Refuse what the disk has no room for: the log twice, and the dataset."""
    each = (2 * probe.log_bytes + probe.dataset_bytes) / probe.scenes
    needed, free = scenes * each, shutil.disk_usage(folder).free
    if needed > 0.9 * free:
        raise InputError(
            f"--scenes: {scenes:,.0f}: {needed / 2**30:.1f} GiB: expected 90 % of "
            f"the {free / 2**30:.1f} GiB that are free at most; see --seconds"
        )


def imports() -> list[str]:
    """A small one, then the slice or all of it; what grew."""
    with tempfile.TemporaryDirectory(dir=_FOLDER.value) as place:
        folder = Path(place)
        probe = import_rows(folder, _PROBE.value * CAR_ROWS // CAR_SCENES)
        scenes = float(_SCENES.value)
        if _SECONDS.value:
            least = SLICE_SHARDS * probe.scenes / probe.shards
            scenes = min(scenes, max(_SECONDS.value * probe.scenes_per_s, least))
        print(f"{probe.scenes_per_s:,.0f} scenes/s: {scenes:,.0f} scenes", flush=True)
        _fits(folder, scenes, probe)
        made = import_rows(folder, int(1.01 * scenes * probe.rows / probe.scenes))
    found = level(made.cutting, made.cutting[-1].done)
    at_the_end = max((sample.all_mb for sample in made.finishing), default=0.0)
    result = {
        "is": f"a slice of {_SECONDS.value:g} s" if _SECONDS.value else "all of it",
        "scenes": made.scenes,
        "shards": made.shards,
        "rows": made.rows,
        "log_bytes": made.log_bytes,
        "dataset_bytes": made.dataset_bytes,
        "bytes_per_scene": round(made.dataset_bytes / made.scenes),
        "workers": _WORKERS.value,
        "seconds": round(made.seconds, 1),
        "scenes_per_s": round(made.scenes / made.seconds, 1),
        "scenes_per_s_while_cutting": round(made.scenes_per_s, 1),
        "cutting": whole(found),
        "main_process_mb_at_most": round(max(x.mb for x in made.cutting), 1),
        "finishing_mb_at_most": round(at_the_end, 1),
        "finishing_seconds": round(made.seconds - made.cutting[-1].seconds, 1),
        **_extrapolated(made, found),
        "dropped": made.quality["dropped"],
        "first_import": {
            "scenes": probe.scenes,
            "seconds": round(probe.seconds, 1),
            "scenes_per_s_while_cutting": round(probe.scenes_per_s, 1),
        },
        "series": thinned([*made.cutting, *made.finishing]),
    }
    write("load_import", result, _OUTPUT.value)
    print({k: v for k, v in result.items() if k != "series"}, flush=True)
    grown = [] if found.outcome == BOUNDED else [found.outcome]
    return [f"import: {x}" for x in (*grown, *finishing_problems(found, at_the_end))]


def _extrapolated(made: Imported, found: Level) -> dict:
    """What `--scenes` would take at this rate and slope, if this was a slice."""
    if made.scenes >= _SCENES.value:
        return {}
    factor, more = _SCENES.value / made.scenes, _SCENES.value - made.scenes
    mb = [round(found.at_the_end + more * slope) for slope in found.mb_per_unit]
    return {
        "extrapolated": {
            "scenes": _SCENES.value,
            "hours": round(factor * made.seconds / 3600.0, 2),
            "dataset_gib": round(factor * made.dataset_bytes / 2**30, 1),
            "log_gib": round(factor * made.log_bytes / 2**30, 2),
            "mb_while_cutting": mb[0],
            "mb_while_cutting_interval": mb[1:],
        }
    }


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
