"""SIGTERM and SIGINT: where work stops, how fast, with which exit status."""

import os
import signal
import subprocess
import sys
import time

import pytest

from tests.conftest import REPO

pytestmark = pytest.mark.multiprocess

HEAD = """
import hashlib, sys, time
from rcirl_jax.runtime import signals as interrupts

def command(work):
    try:
        work()
    except interrupts.Interrupted as stop:
        interrupts.leave(stop.number)
interrupts.install()
"""
ANYWHERE = """
def work():
    try:
        print("ready", flush=True)
        time.sleep(60)
    finally:
        print("cleaned")
command(work)
"""
ASKED = """
def work():
    with interrupts.asked() as told:
        print("ready", flush=True)
        for step in range(100):
            time.sleep(0.1)
            if told():
                print(f"saved {told() > 0}")
                raise interrupts.Interrupted(told())
command(work)
"""
NEVER_ASKED = """
def work():
    with interrupts.asked():
        print("ready", flush=True)
        time.sleep(1.0)
        print("finished")
    print("not reached")
command(work)
"""
# one call that hears no signal for a minute, as a compilation does
DEAF = """
interrupts.GRACE_S = float(sys.argv[1])
def work():
    print("ready", flush=True)
    hashlib.pbkdf2_hmac("sha512", b"a", b"b", 100_000_000)
command(work)
"""


def told(script, *signals, arguments=(), pause=0.0):
    """(exit status, stdout, stderr, seconds) of a script once it is ready."""
    process = subprocess.Popen(
        [sys.executable, "-c", HEAD + script, *arguments],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=REPO,
    )  # fmt: skip
    assert process.stdout.readline() == "ready\n"
    time.sleep(0.3)  # until it is in what it does next
    begin = time.monotonic()
    for number in signals:
        os.kill(process.pid, number)
        time.sleep(pause)
    out, err = process.communicate(timeout=60)
    return process.returncode, out, err, time.monotonic() - begin


@pytest.mark.parametrize(
    ("number", "times", "status"),
    [(signal.SIGINT, 1, 130), (signal.SIGTERM, 3, 143)],
)
def test_work_stops_where_it_is_and_cleans_up(number, times, status):
    """Signals after the first do not disturb the end."""
    code, out, err, seconds = told(ANYWHERE, *times * [number])
    assert (code, out) == (status, "cleaned\n")
    (line,) = err.splitlines()
    assert line.startswith(f"stopped by {signal.Signals(number).name}: ")
    assert seconds < 5.0


@pytest.mark.parametrize(
    ("script", "said"), [(ASKED, "saved True\n"), (NEVER_ASKED, "finished\n")]
)
def test_who_asks_stops_at_a_moment_of_his_own_and_at_the_end_at_last(script, said):
    code, out, err, _ = told(script, signal.SIGTERM)
    assert (code, out, err.count("\n")) == (143, said, 1)


@pytest.mark.parametrize(
    ("number", "grace", "status"),
    [(signal.SIGTERM, "1.0", 143), (signal.SIGINT, "50.0", 130)],
)
def test_a_deaf_call_is_given_its_time_and_no_more(number, grace, status):
    """Another SIGTERM changes nothing; a second SIGINT ends it at once."""
    code, _, err, seconds = told(DEAF, number, number, arguments=[grace], pause=0.3)
    assert code == status
    assert 0.5 < seconds < 5.0  # nothing else is waited for
    assert err.count("\n") == 1
