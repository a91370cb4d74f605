"""Experiments by their command: flags of different ones clash in one process."""

import os
import subprocess
import sys


def command(module, *flags):
    """The finished `python -m module *flags` on the CPU, with what it said."""
    return subprocess.run(
        [sys.executable, "-m", module, *flags],
        capture_output=True, text=True, check=False, timeout=900,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
    )  # fmt: skip
