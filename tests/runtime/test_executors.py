"""Executors: order, errors, and pieces that are lost with their process."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.executors import Processes, Serial


def twice(item):
    yield item
    yield -item


def fails(item):
    if item == 3:
        raise InputError("three.csv: x: 3: expected another number")
    yield item


def dies_once(marked):
    """Kills its own process the first time."""
    if not marked.exists():
        marked.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    yield marked.name


def slow_or_deadly(item):
    if item == "killer":
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.5)
    yield item


def own_number(item):
    time.sleep(0.3)  # for the other worker to take the other item
    yield os.getpid()


# a parent that says who works for it and then hangs
HANGS = """
import time
from rcirl_jax.runtime.executors import Processes
from tests.runtime.test_executors import own_number
if __name__ == "__main__":
    pool = Processes(2)
    print(*pool.stream(own_number, range(4)), flush=True)
    time.sleep(600)
"""


def lives(number):
    """Whether a process runs; one that nobody has waited for does not."""
    try:
        return (
            Path(f"/proc/{number}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
        )
    except OSError:
        return False


@pytest.mark.multiprocess
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_workers_end_with_a_parent_that_is_killed(tmp_path):
    file = tmp_path / "hangs.py"
    file.write_text(HANGS)
    root = str(Path(__file__).resolve().parents[2])
    parent = subprocess.Popen(
        [sys.executable, file], stdout=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": root},
    )  # fmt: skip
    try:
        workers = {int(number) for number in parent.stdout.readline().split()}
        assert workers
        assert all(lives(number) for number in workers)
    finally:
        parent.kill()
        parent.wait()
        parent.stdout.close()
    deadline = time.monotonic() + 30.0
    while any(lives(number) for number in workers):
        assert time.monotonic() < deadline, "a worker outlives its parent"
        time.sleep(0.1)


@pytest.mark.parametrize("make", [Serial, lambda: Processes(2)], ids=["here", "two"])
def test_results_and_errors_come_as_they_are_in_the_order_of_the_items(make):
    got = list(make().stream(twice, range(1, 9)))
    assert got == [x for item in range(1, 9) for x in (item, -item)]
    results = make().stream(fails, range(6))
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(InputError, match=r"^three\.csv: x: 3"):
        next(results)


def test_a_piece_lost_with_its_process_is_done_again(tmp_path):
    items = [tmp_path / name for name in ("a", "b", "c")]
    for item in items[::2]:
        item.touch()  # these live
    assert list(Processes(2).stream(dies_once, items)) == ["a", "b", "c"]


def test_a_piece_that_always_kills_its_process_is_named_and_the_others_are_done():
    results = Processes(2).stream(slow_or_deadly, ["healthy", "killer", "later"])
    assert next(results) == "healthy"
    with pytest.raises(InputError, match=r"^killer: its process was killed 3 times: "):
        next(results)
