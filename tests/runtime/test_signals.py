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
    ("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)]
)
def test_work_stops_where_it_is_and_cleans_up(number, status):
    code, out, err, seconds = told(ANYWHERE, number)
    assert (code, out) == (status, "cleaned\n")
    name = signal.Signals(number).name
    assert err == f"stopped by {name}: run the same command again to go on\n"
    assert seconds < 5.0


def test_who_asks_stops_at_a_moment_of_his_own():
    code, out, err, _ = told(ASKED, signal.SIGTERM)
    assert (code, out) == (143, "saved True\n")
    assert err.count("\n") == 1


def test_who_does_not_ask_is_stopped_at_the_end():
    code, out, _, _ = told(NEVER_ASKED, signal.SIGTERM)
    assert (code, out) == (143, "finished\n")


def test_a_second_signal_does_not_disturb_the_end():
    code, out, err, _ = told(ANYWHERE, *3 * [signal.SIGTERM])
    assert (code, out) == (143, "cleaned\n")
    assert err.count("\n") == 1


def test_a_deaf_call_is_given_its_time_and_no_more():
    """Another SIGTERM changes nothing; a second SIGINT ends it at once."""
    code, _, err, seconds = told(
        DEAF, signal.SIGTERM, signal.SIGTERM, arguments=["1.0"]
    )
    assert code == 143
    assert 0.5 < seconds < 5.0  # a second of grace; nothing else is waited for
    assert err.count("\n") == 1
    assert "while it computed" in err
    code, _, _, seconds = told(
        DEAF, signal.SIGINT, signal.SIGINT, arguments=["50.0"], pause=0.3
    )
    assert code == 130
    assert seconds < 8.0
