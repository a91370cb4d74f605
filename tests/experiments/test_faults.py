"""An error that nobody foresaw: one line, status 70, and a file to report.

A package of an extra that is not installed is named with its extra, status 2.
"""

import re
import subprocess
import sys
from pathlib import Path

MAIN = """
from rcirl_jax.cli.flags.common import run
def main():
    raise ZeroDivisionError("scene\\n7")
run(main)
"""


def test_a_fault_is_one_line_and_leaves_its_traceback_in_a_file():
    done = subprocess.run(
        [sys.executable, "-c", MAIN], capture_output=True, text=True, check=False
    )
    assert done.returncode == 70
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ZeroDivisionError: scene 7 (<string>:4)")
    report = Path(re.search(r"\S+rcirl-jax-fault-\S+\.txt", line)[0])
    text = report.read_text()
    report.unlink()
    assert "Traceback" in text
    assert 'raise ZeroDivisionError("scene' in text or "in main" in text


WITHOUT = """
from rcirl_jax.cli.flags.common import run
def main():
    raise ModuleNotFoundError("none", name="matplotlib.axes")
run(main)
"""


def test_a_missing_extra_is_one_line_that_names_it():
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    line = "error: matplotlib: not installed: expected pip install 'rcirl-jax[report]'"
    assert done.stderr.strip() == line
