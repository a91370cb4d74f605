"""Kills at random moments: do the commands come to what they come to undisturbed?

    python -m benchmarks.reliability.faults --kills=50 --output=benchmarks/results

import, train, sweep and autotune run on small synthetic data. Each runs once
undisturbed; then it is killed at random moments, again and again, started by the same
command each time, and when it has ended by itself its outputs are compared to the bit.
Half of the moments are uniform over the whole run. The others are, in turn, as soon as
some but not all of its things are
finished (shards, checkpoints, shapes of a sweep, stages), and uniform over the time
after the first (`--work`: all are). A command that no kill found so half done is a
problem.
`--signal=TERM` (to the process, as a cluster does) and `INT` (to its group, as a
terminal does) also hold the seconds to the end and the exit status against what is
promised. `--broken_resume` has trainings
forget where in the data they were: this file has to say so and end with 1.

Writes faults_SIGNAL.json after every comparison, one row per command.
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
from benchmarks.reliability.jobs import Facts, Job, jobs, write_logs
from benchmarks.reliability.small import BROKEN
from rcirl_jax.commands.flags.common import run
from rcirl_jax.errors import InputError

SIGNALS = ("KILL", "TERM", "INT")
SHARES = {"import": 15, "train": 15, "sweep": 10, "autotune": 10}  # of 50 kills
_KILLS = flags.DEFINE_integer("kills", 50, "over all commands", 1)
_JOBS = flags.DEFINE_list("commands", list(SHARES), "which of them")
_SIGNAL = flags.DEFINE_enum("signal", "KILL", SIGNALS, "that ends them")
_WORK = flags.DEFINE_bool("work", False, "all moments once something is finished")
_SEED = flags.DEFINE_integer("seed", 0, "of the moments")
_BROKEN = flags.DEFINE_bool("broken_resume", False, "break the resume of trainings")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")

WRAPPER = "benchmarks.reliability.small"
ROOT = Path(__file__).resolve().parents[2]
MOST_S = 1800.0  # s after which a command counts as hanging
PROMISED_S = 10.0  # s from a signal to the end
IN_A_ROW = 4  # kills before a command may end
LOOK_S = 0.005  # s between two looks at what is finished
FINISHED = "holds a finished dataset"  # killed between its last file and its end


@dataclasses.dataclass(kw_only=True)
class Row:
    """What came of one command."""

    fault: str
    command: str
    undisturbed_s: float
    first_finished_s: float  # when the undisturbed run had finished something
    things: int  # that the undisturbed run finished
    count: int = 0  # kills that met a running command
    comparisons: int = 0
    outcome: str = "not compared"
    problems: list[str] = dataclasses.field(default_factory=list)
    killed_at_s: list[float] = dataclasses.field(default_factory=list)
    # things that were finished at each kill: shards, checkpoints, shapes, stages
    progress_at_kill: list[int] = dataclasses.field(default_factory=list)
    seconds_to_end: list[float] = dataclasses.field(default_factory=list)


def start(job: Job, folder: Path) -> subprocess.Popen:
    """The command in a process group of its own; what it says goes to said.txt."""
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


def until_finished(
    job: Job, folder: Path, process: subprocess.Popen, count: int = 1
) -> float:
    """Wait until so many things are finished, or the process has ended; seconds."""
    begin = time.monotonic()
    while process.poll() is None and job.finished(folder) < count:
        if time.monotonic() - begin > MOST_S:
            break
        time.sleep(LOOK_S)
    return time.monotonic() - begin


def to_the_end(job: Job, folder: Path) -> tuple[float, float]:
    """Run it undisturbed; seconds to the end, and until something was finished.

    Raises:
      InputError: it failed or did not end.
    """
    begin = time.monotonic()
    process = start(job, folder)
    first_s = until_finished(job, folder, process)
    try:
        status = process.wait(MOST_S)
    except subprocess.TimeoutExpired as error:
        os.killpg(process.pid, signal.SIGKILL)
        raise InputError(f"{job.name}: no end after {MOST_S:.0f} s") from error
    last = (folder / "said.txt").read_text().strip().splitlines()[-1:]
    if status != 0 and not (last and FINISHED in last[0]):
        raise InputError(f"{job.name}: exit status {status}: {last}")
    return time.monotonic() - begin, first_s


def killed(job: Job, folder: Path, share: float, row: Row, moment: str) -> bool:
    """Start it and end it at a moment; False if it ended before.

    "run": after a share of its time. "after": once something is finished, after a
    share of the rest. "between": once a share of the first half of its things is
    finished. In a folder where they are, after a share of all its time.
    """
    number = signal.Signals[f"SIG{_SIGNAL.value}"]
    process = start(job, folder)
    begin = time.monotonic()
    half = max(row.things // 2, 1)
    count = {"run": 0, "after": 1, "between": 1 + int(share * half)}[moment]
    wait_s = share * row.undisturbed_s
    waits = job.finished(folder) < count  # then this process has finished one
    if waits:
        until_finished(job, folder, process, count)
        rest_s = row.undisturbed_s - row.first_finished_s
        wait_s = share * rest_s if moment == "after" else 0.0
    try:
        process.wait(wait_s)
        return False
    except subprocess.TimeoutExpired:
        pass
    row.killed_at_s.append(round(time.monotonic() - begin, 2))
    row.progress_at_kill.append(job.finished(folder))
    sent = time.monotonic()
    if number == signal.SIGTERM:
        process.send_signal(number)
    else:
        os.killpg(process.pid, number)
    try:
        status = process.wait(3.0 * PROMISED_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        status = process.wait()
    seconds = time.monotonic() - sent
    row.seconds_to_end.append(round(seconds, 2))
    # before Python hears signals they end it as they end any process; an end of
    # its own may come between the last look and the signal
    early = [] if waits else [-number]
    if number != signal.SIGKILL and status not in (128 + number, 0, *early):
        row.problems.append(f"exit status {status} after SIG{_SIGNAL.value}")
    if seconds > PROMISED_S:
        row.problems.append(f"{seconds:.1f} s to the end")
    return True


def _moments(count: int) -> list[str]:
    """Of so many kills: half, rounded up, or all wait for what is finished."""
    work = count if _WORK.value else (count + 1) // 2
    waiting = itertools.islice(itertools.cycle(("between", "after")), work)
    return [*waiting, *["run"] * (count - work)]


def disturbed(job: Job, root: Path, count: int, row: Row, expected: Facts) -> None:
    """Kill it `count` times in all, in as many folders as that takes."""
    # a generator for each command, so that one can be run again alone
    rng = np.random.default_rng([_SEED.value, list(SHARES).index(job.name)])
    moments = rng.permutation(_moments(count))
    while row.count < count:
        folder = root / f"{job.name}-{row.comparisons}"
        folder.mkdir()
        for number in range(min(IN_A_ROW, count - row.count)):
            if number and moments[row.count] == "between":
                break  # in a new folder, where nothing is finished
            share = float(rng.uniform())
            if not killed(job, folder, share, row, moments[row.count]):
                break
            row.count += 1
        try:
            to_the_end(job, folder)
            found = job.outcome(folder)
            names = sorted(found.keys() | expected.keys())
            different = [x for x in names if found.get(x) != expected.get(x)]
            if different:
                row.problems.append(f"different: {', '.join(different[:5])}")
        except InputError as error:
            row.problems.append(str(error))
        row.comparisons += 1
        half_done = any(0 < x < row.things for x in row.progress_at_kill)
        if row.count >= count and "between" in moments and not half_done:
            row.problems.append(f"no kill with some of {row.things} finished")
        row.outcome = "as undisturbed" if not row.problems else row.problems[0]
        print(f"{job.name}: {row.count} of {count} {row.fault}: {row.outcome}")
        save(row)
        if not row.problems:
            shutil.rmtree(folder)


_ROWS: dict[str, Row] = {}


def save(row: Row) -> None:
    """Write all rows so far."""
    _ROWS[row.command] = row
    result = {"seed": _SEED.value, "rows": list(_ROWS.values())}
    write(f"faults_{_SIGNAL.value.lower()}", result, _OUTPUT.value)


def main() -> None:
    """Undisturbed runs, disturbed runs, rows."""
    unknown = set(_JOBS.value) - set(SHARES)
    if unknown:
        raise InputError(f"--commands: {unknown}: expected some of {list(SHARES)}")
    root = Path(tempfile.mkdtemp(prefix="rcirl-faults-"))
    write_logs(root / "logs")
    known = jobs(root)
    if _BROKEN.value:
        os.environ[BROKEN] = "1"
    # a dataset for the others to work on, and programs in the cache
    to_the_end(known["import"], root)
    total = sum(SHARES[name] for name in _JOBS.value)
    for name in _JOBS.value:
        job, folder = known[name], root / f"{name}-undisturbed"
        folder.mkdir()
        warm = root / f"{name}-warm"
        warm.mkdir()
        to_the_end(job, warm)
        seconds, first_s = to_the_end(job, folder)
        expected, again = job.outcome(folder), job.outcome(warm)
        row = Row(
            fault=f"SIG{_SIGNAL.value}",
            command=f"{job.module} {' '.join(job.flags)}".replace(str(root), "ROOT"),
            undisturbed_s=round(seconds, 2),
            first_finished_s=round(first_s, 2),
            things=job.finished(folder),
        )
        if again != expected:
            odd = [x for x in expected if again.get(x) != expected[x]]
            row.problems.append(f"two undisturbed runs differ: {odd[:5]}")
        count = max(round(_KILLS.value * SHARES[name] / total), 1)
        disturbed(job, root, count, row, expected)
    if problems := sum(len(row.problems) for row in _ROWS.values()):
        print(f"{problems} problems; what was left: {root}")
        sys.exit(1)
    shutil.rmtree(root)


if __name__ == "__main__":
    run(main)
