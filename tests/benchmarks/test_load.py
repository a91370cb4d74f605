"""Load and soak: what counts as growth, and both programs as small as they go."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.reliability.memory import (
    FINISHING_MB,
    Sample,
    Watch,
    count_growth,
    finishing_problems,
    level,
    memory_growth,
    peak_problems,
)
from tests.helpers.commands import fresh as command

ROUNDS = 80


@pytest.mark.parametrize("seed", range(5))
def test_growth_below_the_noise_of_a_round_is_found_and_a_spike_is_none(seed):
    """2 MiB a round amid 15 MiB of noise around 1 GiB."""
    noise = 1024.0 + 15.0 * np.random.default_rng(seed).standard_normal(ROUNDS)
    spike = np.where(np.arange(ROUNDS) == ROUNDS - 3, 3.0, 1.0)
    for steady in (noise, spike * noise, np.linspace(3000.0, 1000.0, ROUNDS)):
        assert not memory_growth(steady).grows
    series = noise + 2.0 * np.arange(ROUNDS)
    for grown in (series, spike * series):
        found = memory_growth(grown)
        assert found.grows
        assert found.by == pytest.approx(120.0, abs=30.0)


@pytest.mark.parametrize("at", [18, 57])
def test_one_thing_kept_is_growth(at):
    steady = np.array([30, 31, 30, 30, 32, 30] * 10)
    assert not count_growth(steady).grows
    assert count_growth(steady + np.arange(60) // 5).grows
    kept = (np.arange(60) >= at).astype(int)
    assert count_growth(30 + kept).grows
    assert not count_growth(30 + kept, allowed=1).grows


def phase(mb, grown=0.0):
    """Samples of a phase of 1,000 units; the first tenth holds less."""
    done = np.linspace(0.0, 1000.0, 400)
    held = np.where(done < 100.0, 0.5 * mb, mb) + grown * done / 1000.0
    return [
        Sample(seconds=float(i), mb=1.0, all_mb=float(m), done=float(d))
        for i, (m, d) in enumerate(zip(held, done, strict=True))
    ]


def test_a_phase_is_judged_from_its_second_tenth_on():
    """By the larger of 10 % and 200 MiB, by its highest moment, and by its end."""
    assert level(phase(1000.0, grown=150.0), 1000.0).outcome == "bounded"
    assert level(phase(1000.0, grown=400.0), 1000.0).outcome.startswith("grew by 3")
    assert level(phase(8000.0, grown=800.0), 1000.0).outcome == "bounded"
    samples = phase(1000.0)
    samples[390] = Sample(seconds=390.0, mb=1.0, all_mb=2001.0, done=samples[390].done)
    assert level(samples, 1000.0).outcome.startswith("held 2001 MiB")
    cutting = level(phase(1000.0), 1000.0)
    for over in (-1.0, 1.0):
        told = finishing_problems(cutting, 1000.0 + FINISHING_MB + over)
        assert len(told) == len(peak_problems(1000.0, 2000.0 + over)) == (over > 0.0)
    with pytest.raises(ValueError, match="2 looks at memory"):
        level(samples[:2], 1000.0)


def test_a_watch_sees_a_process_and_what_it_started():
    hold = "import subprocess, sys; subprocess.run([sys.executable, '-c', {!r}])"
    child = "import time; kept = bytearray(b'1') * (64 * 2**20); time.sleep(60)"
    process = subprocess.Popen(
        [sys.executable, "-c", hold.format(child)], start_new_session=True
    )
    watch = Watch(process.pid, lambda: 0.0, every_s=0.05)
    watch.start()
    try:
        while not (watch.samples and watch.samples[-1].all_mb > 64.0):
            assert process.poll() is None
        assert watch.samples[-1].mb < 64.0
    finally:
        os.killpg(process.pid, 9)
        process.wait()
        watch.stop()


@pytest.mark.slow
@pytest.mark.multiprocess
@pytest.mark.parametrize(
    ("what", "flags"),
    [
        ("suite", ("--cases=300", "--chunk=30", "--duration=1", "--rows=IDM")),
        ("import", ("--seconds=1", "--cars=20", "--probe=20000")),
    ],
)
def test_a_short_load_is_bounded_and_says_what_it_was(what, flags, tmp_path):
    places = (f"--folder={tmp_path}", f"--output={tmp_path / 'out'}")
    told = (f"--what={what}", *flags, *places)
    done = command("benchmarks.reliability.load", *told)
    assert done.returncode == 0, done.stderr[-2000:]
    made = json.loads((tmp_path / "out" / f"load_{what}.json").read_text())
    assert "1 s" in made["is"]
    for row in made.get("rows", {"all": made.get("cutting")}).values():
        assert row["outcome"] == "bounded"
        assert 0.0 < row["after_a_tenth"] <= row["at_most"]
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
