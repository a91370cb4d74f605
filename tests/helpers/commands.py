"""Experiments by their command: flags of different ones clash in one process."""

import functools
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import jax

# Compiled in half the time, to slower programs: commands are run on little data to
# see that they do what they say.
QUICKLY = "--xla_backend_optimization_level=0"
# later ones abort at a flag that they no longer have
if jax.__version_info__ < (0, 11):
    QUICKLY += " --xla_cpu_use_fusion_emitters=false"
LONGEST_S = 1800.0

# Has imported what commands import, but none of their flags and no backend. Becomes a
# command at the word, which saves the two seconds that importing takes; frozen, since
# a fork that collects garbage at its end copies every page that it touches. A command
# is over when nobody holds its stderr any more: what it left behind is waited for.
FORKING = """
import gc, json, os, runpy, shutil, sys
import matplotlib.pyplot
import rcirl_jax.data.importing, rcirl_jax.report.charts, rcirl_jax.tuning.loop

gc.freeze()
for line in sys.stdin:
    word = json.loads(line)
    said, stderr = os.pipe()
    child = os.fork()
    if not child:
        break
    os.close(stderr)
    print(child, flush=True)
    with os.fdopen(said, "rb") as source, open(word["err"], "wb") as file:
        shutil.copyfileobj(source, file)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
else:
    raise SystemExit
os.dup2(os.open(os.devnull, os.O_RDWR), 0)
os.dup2(os.open(word["out"], os.O_WRONLY | os.O_CREAT), 1)
os.dup2(stderr, 2)
os.closerange(said, stderr + 1)
os.chdir(word["folder"])
sys.argv[1:] = word["flags"]
runpy.run_module(word["module"], run_name="__main__", alter_sys=True)
"""


def command(module, *flags):
    """The finished `python -m module *flags` on the CPU, with what it said.

    It runs in a fork of a process that has imported JAX: what differs from one
    interpreter to the next, as the seed of hashes, is the same for all commands of a
    worker, and a main that sets JAX's environment before the import is too late.
    `fresh` starts Python anew.
    """
    with tempfile.TemporaryDirectory() as folder:
        out, err = Path(folder) / "out", Path(folder) / "err"
        word = {"module": module, "flags": flags, "folder": os.getcwd()}
        word |= {"out": str(out), "err": str(err)}
        try:
            status = _ask(_forking(tuple(sorted(_environment().items()))), word)
        except BaseException:
            _forking.cache_clear()  # it may still be busy with this one
            raise
        if status is None:
            raise subprocess.TimeoutExpired((module, *flags), LONGEST_S)
        said = out.read_text(), err.read_text()
        return subprocess.CompletedProcess((module, *flags), status, *said)


def succeeded(module, *flags):
    """The same, which has to end well."""
    done = command(module, *flags)
    assert done.returncode == 0, done.stdout[-500:] + done.stderr[-2000:]
    return done


def refused(module, *flags):
    """The one line of a command that ends with status 2."""
    done = command(module, *flags)
    assert done.returncode == 2, done.stdout[-500:] + done.stderr[-2000:]
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("error: ")
    return line


def fresh(module, *flags, compiler=QUICKLY):
    """The same in an interpreter of its own, its compiler with these flags."""
    return subprocess.run(
        [sys.executable, "-m", module, *flags], env=_environment(compiler),
        capture_output=True, text=True, check=False, timeout=LONGEST_S,
    )  # fmt: skip


def python(code, *arguments, **more):
    """A finished interpreter that ran this code, and what it said."""
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        **{"capture_output": True, "text": True, "check": False, **more},
    )


def _environment(compiler=QUICKLY):
    env = {**os.environ, "JAX_PLATFORMS": "cpu"}
    env.pop("PYTEST_CURRENT_TEST", None)
    return env | {"XLA_FLAGS": f"{compiler} {os.environ.get('XLA_FLAGS', '')}"}


@functools.cache
def _forking(env):
    return subprocess.Popen(
        [sys.executable, "-c", FORKING], env=dict(env), text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip


def _ask(forking, word):
    """Exit status of a command; None when it took too long."""
    forking.stdin.write(json.dumps(word) + "\n")
    forking.stdin.flush()
    child, late = int(forking.stdout.readline()), threading.Event()

    def end():
        late.set()
        os.kill(child, signal.SIGKILL)

    timer = threading.Timer(LONGEST_S, end)
    timer.start()
    try:
        status = int(forking.stdout.readline())
    except BaseException:
        os.kill(child, signal.SIGKILL)
        raise
    finally:
        timer.cancel()
    return None if late.is_set() else status


def count_and_peak(script, path):
    """Return the two numbers that a script prints of `path`, in its own process.

    The scripts print what they counted and the most memory they held.
    """
    done = subprocess.run(
        [sys.executable, "-c", script, str(path)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    counted, peak = map(int, done.stdout.split())
    return counted, peak
