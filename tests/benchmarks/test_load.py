"""Load and soak: growth is seen, and both programs as small as they go."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.reliability.memory import held_mb, kept, level, looking, rise
from tests.helpers.commands import fresh as command


def test_growth_below_the_noise_of_a_round_is_found_and_a_spike_is_none():
    """2 MiB a round amid 15 MiB of noise around 1 GiB; one thing kept of many."""
    rounds = np.arange(80)
    noise = 1024.0 + 15.0 * np.random.default_rng(0).standard_normal(rounds.size)
    spike = np.where(rounds == 77, 3.0, 1.0)
    assert abs(rise(spike * noise)) < 20.0
    assert rise(spike * (noise + 2.0 * rounds)) == pytest.approx(118.0, abs=20.0)
    assert kept([30, 31, 30, 30, 32, 30] * 10) <= 0.0
    assert kept(30 + (np.arange(60) >= 57)) == 1.0


@pytest.mark.parametrize(
    ("grown", "peak", "problem"),
    [(150.0, 0.0, ""), (400.0, 0.0, "grew by 2"), (0.0, 2001.0, "held 2001 MiB")],
)
def test_a_phase_is_judged_between_its_second_tenth_and_its_ninth(grown, peak, problem):
    done = np.linspace(0.0, 1.0, 400)
    held = np.where(done < 0.1, 500.0, 1000.0) + grown * done
    held[390] = max(held[390], peak)
    problems = level(held.tolist())[1]
    assert [text.startswith(problem) for text in problems] == [True] * bool(problem)


def test_a_process_and_what_it_started_are_seen():
    hold = "import subprocess, sys; subprocess.run([sys.executable, '-c', {!r}])"
    child = "kept = bytearray(b'1') * (64 * 2**20); print(1, flush=True); input()"
    words = [sys.executable, "-c", hold.format(child)]
    pipe = subprocess.PIPE
    with subprocess.Popen(words, stdin=pipe, stdout=pipe) as process:
        process.stdout.readline()
        assert held_mb(process.pid) > 64.0
        process.stdin.close()
    assert held_mb(process.pid) == 0.0
    with looking(os.getpid(), 0.01) as held:
        while len(held) < 3:
            pass
    assert min(held) > 20.0


@pytest.mark.slow
@pytest.mark.multiprocess
@pytest.mark.parametrize(
    ("what", "flags"),
    [
        ("suite", ("--cases=300", "--chunk=30", "--duration=1", "--rows=IDM")),
        ("import", ("--scenes=60000", "--cars=20")),
    ],
)
def test_a_short_load_is_bounded(what, flags, tmp_path):
    places = (f"--folder={tmp_path}", f"--output={tmp_path / 'out'}", "--every=0.05")
    done = command("benchmarks.reliability.load", f"--what={what}", *flags, *places)
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    made = json.loads((tmp_path / "out" / f"load_{what}.json").read_text())
    for row in made.get("rows", {"all": made.get("memory")}).values():
        assert 0.0 < row["early_mb"] <= row["at_most_mb"]
    assert [x.name for x in tmp_path.iterdir()] == ["out"]


@pytest.mark.slow
def test_a_soak_repeats_to_the_bit_and_finds_a_leak(tmp_path):
    flags = ("--seconds=1", "--leak=60", f"--output={tmp_path}")  # the least rounds
    done = command("benchmarks.reliability.soak", *flags)
    assert done.returncode == 1, done.stderr[-2000:]
    made = json.loads((tmp_path / "soak.json").read_text())
    assert any(x.startswith("in_use_mb grew by ") for x in made["problems"])
    assert made["outputs_compared"] > 10
    assert not [x for x in made["problems"] if "different" in x]
