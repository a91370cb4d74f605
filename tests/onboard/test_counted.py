"""What `make fuzz` says at its end."""

import subprocess
import sys

import pytest

from tests.conftest import REPO

DONE = "#2097152\tpulse  cov: 9\nDone 4259000 runs in 721 second(s)\nstat::a: 1\n"


@pytest.mark.multiprocess
@pytest.mark.parametrize(
    ("said", "status", "out", "ends"),
    [
        (DONE + "INFO: Done 3 runs\nDone 727 runs in 1 second(s)\n", 0,
         "fuzz: 4,259,727 inputs, no crash\n", 0),
        (DONE, 77, "", 77),
        (DONE.replace("4259000", "3999"), 0, "", 1),
    ],
)  # fmt: skip
def test_the_last_line(said, status, out, ends):
    program = f"import sys; sys.stderr.write({said!r}); sys.exit({status})"
    counted = [sys.executable, "-m", "onboard.fuzz.counted", "4000"]
    done = subprocess.run(
        [*counted, sys.executable, "-c", program],
        cwd=REPO, text=True, capture_output=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (ends, out)
    assert done.stderr.startswith(said)
