"""Experiments by their command: flags of different ones clash in one process."""

import atexit
import contextlib
import functools
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

# Compiled in half the time, to slower programs: commands are run on little data to
# see that they do what they say. Tests in process have the compiler as users have it.
QUICKLY = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
LONGEST_S = 1800.0

# Has imported what commands import, but none of their flags and no backend. Becomes a
# command at the word, which saves the two seconds that importing takes; frozen, since
# a fork that collects garbage at its end copies every page that it touches.
FORKING = """
import gc, json, os, runpy, sys
import matplotlib.pyplot
import rcirl_jax.evaluation.evaluate, rcirl_jax.evaluation.learners
import rcirl_jax.report.intervals, rcirl_jax.simulation.suite

gc.freeze()
for line in sys.stdin:
    word = json.loads(line)
    child = os.fork()
    if not child:
        break
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
else:
    raise SystemExit
for number, path in enumerate((os.devnull, word["out"], word["err"])):
    os.dup2(os.open(path, os.O_RDWR), number)
os.chdir(word["folder"])
sys.argv[1:] = word["flags"]
runpy.run_module(word["module"], run_name="__main__", alter_sys=True)
"""


def command(module, *flags):
    """The finished `python -m module *flags` on the CPU, with what it said.

    It runs in a fork of a process that has imported JAX; `fresh` starts Python anew.
    """
    with tempfile.TemporaryDirectory() as folder:
        out, err = Path(folder) / "out", Path(folder) / "err"
        out.touch()
        err.touch()
        word = {"module": module, "flags": flags, "folder": os.getcwd()}
        word |= {"out": str(out), "err": str(err)}
        status = _forking(tuple(sorted(_environment().items())))(word)
        if status is None:
            raise subprocess.TimeoutExpired((module, *flags), LONGEST_S)
        said = out.read_text(), err.read_text()
        return subprocess.CompletedProcess((module, *flags), status, *said)


def fresh(module, *flags):
    """The same in an interpreter of its own."""
    return subprocess.run(
        [sys.executable, "-m", module, *flags], env=_environment(),
        capture_output=True, text=True, check=False, timeout=LONGEST_S,
    )  # fmt: skip


def _environment():
    env = {**os.environ, "JAX_PLATFORMS": "cpu"}
    env.pop("PYTEST_CURRENT_TEST", None)
    return env | {"XLA_FLAGS": f"{QUICKLY} {os.environ.get('XLA_FLAGS', '')}"}


@functools.cache
def _forking(env):
    """A function from the word to the exit status, or None when it took too long."""
    process = subprocess.Popen(
        [sys.executable, "-c", FORKING], env=dict(env), text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip

    def end():
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)

    def ask(word):
        late = threading.Timer(LONGEST_S, end)
        late.start()
        try:
            process.stdin.write(json.dumps(word) + "\n")
            process.stdin.flush()
            status = process.stdout.readline()
        finally:
            late.cancel()
        return int(status) if status else None

    atexit.register(end)
    return ask


def count_and_peak(script, path):
    """What a script that reads `path` in a process of its own prints: two numbers.

    The scripts print what they counted and the most memory they held.
    """
    done = subprocess.run(
        [sys.executable, "-c", script, str(path)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    counted, peak = map(int, done.stdout.split())
    return counted, peak
