"""Kills at random moments: do the commands come to what they come to undisturbed?

    python -m benchmarks.reliability.faults --kills=50 --output=benchmarks/results

import, train, sweep and autotune run on small synthetic data. Each runs twice
undisturbed; then it is killed at random moments, started by the same command each
time, and when it has ended by itself its outputs are compared to the bit. Half of the
moments are uniform over the whole run, half as soon as some but not all of its things
are finished (shards, checkpoints, shapes of a sweep, stages).
`--signal=TERM` also holds the seconds to the end and the exit status against what is
promised. `--broken_resume` has trainings forget where in the data they were: this file
has to say so and end with 1. Writes faults_SIGNAL.json, one row per command.
"""

import dataclasses
import itertools
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from absl import flags

from benchmarks.common import write
from benchmarks.reliability.jobs import Facts, Job, different, jobs, write_logs
from benchmarks.reliability.small import BROKEN
from rcirl_jax.cli.running import run
from rcirl_jax.errors import InputError

SHARES = {"import": 15, "train": 15, "sweep": 10, "autotune": 10}  # of 50 kills
_KILLS = flags.DEFINE_integer("kills", 50, "over all commands", 1)
_JOBS = flags.DEFINE_multi_enum("command", list(SHARES), list(SHARES), "which of them")
_SIGNAL = flags.DEFINE_enum("signal", "KILL", ("KILL", "TERM"), "that ends them")
_SEED = flags.DEFINE_integer("seed", 0, "of the moments")
_BROKEN = flags.DEFINE_bool("broken_resume", False, "break the resume of trainings")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")

WRAPPER = "benchmarks.reliability.small"
ROOT = Path(__file__).resolve().parents[2]
MOST_S = 1800.0  # s after which a command counts as hanging
PROMISED_S = 10.0  # s from a signal to the end
IN_A_ROW = 2  # kills before a command may end
# of the kills in turn: once something is finished, or at any moment
WAITS = (True, False, False, True)
LOOK_S = 0.005  # s between two looks at what is finished
FINISHED = "holds a finished dataset"  # killed between its last file and its end


@dataclasses.dataclass(kw_only=True)
class Row:
    """The outcome of one command."""

    command: str
    undisturbed_s: float = 0.0
    things: int = 0  # that the undisturbed run finished
    count: int = 0  # kills that met a running command
    comparisons: int = 0
    problems: list[str] = dataclasses.field(default_factory=list)
    # things that were finished at each kill: shards, checkpoints, shapes, stages
    progress_at_kill: list[int] = dataclasses.field(default_factory=list)
    seconds_to_end: list[float] = dataclasses.field(default_factory=list)


def start(job: Job, folder: Path) -> subprocess.Popen:
    """The command in a process group of its own; what it says goes to said.txt."""
    folder.mkdir(exist_ok=True)
    cache = os.environ.get("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".jax_cache"))
    env = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": cache,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1",
    }
    words = [sys.executable, "-m", WRAPPER, job.module, *job.flags]
    with (folder / "said.txt").open("a") as said:
        return subprocess.Popen(
            words, cwd=folder, env=env, stdout=said, stderr=said, start_new_session=True
        )


def ended(process: subprocess.Popen, seconds: float) -> int | None:
    """Exit status after so many seconds at most; None while it runs."""
    try:
        return process.wait(seconds)
    except subprocess.TimeoutExpired:
        return None


def to_the_end(job: Job, folder: Path) -> float:
    """Run it undisturbed; seconds to the end.

    Raises:
      InputError: it failed or did not end.
    """
    begin = time.monotonic()
    process = start(job, folder)
    status = ended(process, MOST_S)
    if status is None:
        os.killpg(process.pid, signal.SIGKILL)
        raise InputError(f"{job.name}: no end after {MOST_S:.0f} s")
    last = (folder / "said.txt").read_text().strip().splitlines()[-1:]
    if status != 0 and not (last and FINISHED in last[0]):
        raise InputError(f"{job.name}: exit status {status}: {last}")
    return time.monotonic() - begin


def killed(job: Job, folder: Path, share: float, row: Row, *, waits: bool) -> bool:
    """Start it and end it at a moment; False if it ended before.

    The moment is a share of its time, or, if it waits, as soon as a share of the first
    half of its things is finished. In a folder where they are: a share of its time.
    """
    number = signal.Signals[f"SIG{_SIGNAL.value}"]
    process, begin = start(job, folder), time.monotonic()
    count = 1 + int(share * max(row.things // 2, 1))
    waits = waits and job.finished(folder) < count
    if waits:
        while process.poll() is None and job.finished(folder) < count:
            time.sleep(LOOK_S)
            if time.monotonic() - begin > MOST_S:
                break
    if ended(process, 0.0 if waits else share * row.undisturbed_s) is not None:
        return False
    row.progress_at_kill.append(job.finished(folder))
    sent = time.monotonic()
    if number == signal.SIGTERM:  # to the process, as a cluster does
        process.send_signal(number)
    else:
        os.killpg(process.pid, number)
    status = ended(process, 3.0 * PROMISED_S)
    if status is None:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    row.seconds_to_end.append(round(time.monotonic() - sent, 2))
    # before Python hears signals they end it as they end any process; an end of its
    # own may come between the last look and the signal
    fine = (128 + number, 0) if waits else (128 + number, 0, -number)
    if number != signal.SIGKILL and status not in fine:
        row.problems.append(f"exit status {status} after SIG{_SIGNAL.value}")
    if row.seconds_to_end[-1] > PROMISED_S:
        row.problems.append(f"{row.seconds_to_end[-1]} s to the end")
    return True


def disturbed(job: Job, root: Path, count: int, row: Row, expected: Facts) -> None:
    """Kill it `count` times in all, in as many folders as that takes."""
    # a generator for each command, so that one can be run again alone
    rng = np.random.default_rng([_SEED.value, list(SHARES).index(job.name)])
    turns = itertools.cycle(WAITS)
    while row.count < count:
        folder = root / f"{job.name}-{row.comparisons}"
        for _ in range(min(IN_A_ROW, count - row.count)):
            share = float(rng.uniform())
            if not killed(job, folder, share, row, waits=next(turns)):
                break
            row.count += 1
        to_the_end(job, folder)
        if odd := different(job.outcome(folder), expected):
            row.problems.append(f"different: {', '.join(odd[:5])}")
        row.comparisons += 1
        print(f"{job.name}: {row.count} of {count}: {row.problems or 'as undisturbed'}")
        if not row.problems:
            shutil.rmtree(folder)
    if not any(0 < done < row.things for done in row.progress_at_kill):
        row.problems.append(f"no kill with some of {row.things} finished")


def main() -> None:
    """Undisturbed runs, disturbed runs, rows."""
    root = Path(tempfile.mkdtemp(prefix="rcirl-faults-"))
    write_logs(root / "logs")
    known = jobs(root)
    if _BROKEN.value:
        os.environ[BROKEN] = "1"
    # a dataset for the others to work on, and programs in the cache
    to_the_end(known["import"], root)
    total = sum(SHARES[name] for name in _JOBS.value)
    rows = []
    for job in (known[name] for name in _JOBS.value):
        first, again = root / f"{job.name}-first", root / f"{job.name}-again"
        text = f"{job.module} {' '.join(job.flags)}".replace(str(root), "ROOT")
        rows.append(row := Row(command=text))
        try:
            to_the_end(job, first)
            row.undisturbed_s = round(to_the_end(job, again), 2)
            row.things, expected = job.finished(again), job.outcome(again)
            if odd := different(job.outcome(first), expected):
                row.problems.append(f"two undisturbed runs differ: {odd[:5]}")
            count = max(round(_KILLS.value * SHARES[job.name] / total), 1)
            disturbed(job, root, count, row, expected)
        except InputError as error:
            row.problems.append(str(error))
        result = {"seed": _SEED.value, "rows": rows}
        write(f"faults_{_SIGNAL.value.lower()}", result, _OUTPUT.value)
    if problems := [text for row in rows for text in row.problems]:
        print(f"{len(problems)} problems; what was left: {root}: {problems}")
        sys.exit(1)
    shutil.rmtree(root)


if __name__ == "__main__":
    run(main)
