"""Experiments by their command: flags of different ones clash in one process."""

import os
import subprocess
import sys

# Compiled in half the time, to slower programs: commands are run on little data to
# see that they do what they say. Tests in process have the compiler as users have it.
QUICKLY = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"


def command(module, *flags):
    """The finished `python -m module *flags` on the CPU, with what it said."""
    return subprocess.run(
        [sys.executable, "-m", module, *flags],
        capture_output=True, text=True, check=False, timeout=1800,
        env={
            **os.environ,
            "JAX_PLATFORMS": "cpu",
            "XLA_FLAGS": f"{QUICKLY} {os.environ.get('XLA_FLAGS', '')}",
        },
    )  # fmt: skip


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
