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
    growth,
    in_use_mb,
    level,
    memory_growth,
    peak_problems,
    thinned,
)
from tests.helpers.commands import fresh as command

ROUNDS = 80


def noise(seed, size=ROUNDS, spread=15.0):
    """A process around 1 GiB whose memory goes up and down."""
    return 1024.0 + spread * np.random.default_rng(seed).standard_normal(size)


def one_spike(series):
    """The same with one round of three times the memory."""
    made = series.copy()
    made[-3] *= 3.0
    return made


@pytest.mark.parametrize("seed", range(20))
def test_noise_and_a_spike_are_no_growth(seed):
    series = noise(seed)
    assert not memory_growth(series).grows
    assert not memory_growth(one_spike(series)).grows


@pytest.mark.parametrize("seed", range(20))
def test_growth_below_the_noise_of_a_round_is_found(seed):
    """2 MiB a round amid 15 MiB of noise, also beside a spike."""
    series = noise(seed) + 2.0 * np.arange(ROUNDS)
    for grown in (series, one_spike(series)):
        found = memory_growth(grown)
        assert found.grows
        assert found.low > 1.0
        assert found.by == pytest.approx(120.0, abs=30.0)


def test_memory_in_use_falls_when_it_is_given_back():
    before = in_use_mb()
    kept = bytearray(64 * 2**20)
    assert in_use_mb() - before == pytest.approx(64.0, abs=2.0)
    del kept
    assert in_use_mb() - before == pytest.approx(0.0, abs=2.0)


def test_a_fall_hides_growth_of_what_is_resident_and_not_of_what_is_in_use():
    """3 MiB a round, and 660 given back in the middle."""
    rounds = np.arange(ROUNDS)
    used = 1024.0 + 3.0 * rounds
    resident = used + np.where(rounds < ROUNDS // 2, 1320.0, 660.0)
    assert not memory_growth(resident).grows
    found = growth(used, 0.5 * ROUNDS)
    assert found.grows
    assert found.low == pytest.approx(3.0)


def test_the_interval_of_a_slope_covers_it_as_often_as_it_says():
    found = [memory_growth(noise(seed) + np.arange(ROUNDS)) for seed in range(200)]
    covered = np.mean([x.low < 1.0 < x.high for x in found])
    assert 0.91 < covered < 0.99  # 95 %, 2.6 standard errors to either side


def test_the_warm_up_does_not_count():
    series = np.concatenate([np.linspace(200.0, 1024.0, ROUNDS // 4), noise(0, 60)])
    assert not memory_growth(series).grows
    assert memory_growth(series).rounds == 60


def test_what_is_allowed_is_the_larger_of_share_and_size():
    steps = np.arange(60.0)
    assert not memory_growth(200.0 + 0.8 * steps).grows  # 36 of 50 MiB
    assert memory_growth(200.0 + 1.2 * steps).grows
    assert not memory_growth(4000.0 + 3.0 * steps).grows  # 132 of 200 MiB
    assert memory_growth(4000.0 + 6.0 * steps).grows


def test_one_more_open_file_a_few_rounds_is_growth():
    steady = np.array([30, 31, 30, 30, 32, 30] * 10)
    assert not count_growth(steady).grows
    assert not count_growth(np.full(60, 30)).grows
    assert count_growth(steady + np.arange(60) // 5).grows
    assert count_growth(30 + np.arange(60) // 20).grows


@pytest.mark.parametrize("at", [18, 20, 40, 57])
def test_one_thing_kept_once_is_growth(at):
    """After the first rounds that are watched; a slope alone does not see it."""
    kept = (np.arange(60) >= at).astype(int)
    assert not growth(30 + kept, 0.5).grows
    assert count_growth(30 + kept).grows
    assert not count_growth(30 + kept, allowed=1).grows
    found = count_growth(30 + 2 * kept, allowed=1)
    assert found.grows
    assert found.by >= 2.0


def test_writing_the_index_is_judged_as_well():
    cutting = level(phase(1000.0), 1000.0)
    assert finishing_problems(cutting, 1000.0 + FINISHING_MB - 1.0) == []
    (line,) = finishing_problems(cutting, 1000.0 + FINISHING_MB + 1.0)
    assert line == "finishing held 1601 MiB, expected 1600 at most"


def test_a_fall_is_no_growth_and_few_rounds_are_refused():
    assert not memory_growth(3000.0 - 10.0 * np.arange(60.0)).grows
    with pytest.raises(ValueError, match="expected 4 after the warm-up"):
        growth([1.0, 2.0, 3.0], 0.0)


def phase(mb, share=0.0, grown=0.0):
    """Samples of a phase of 1,000 units; the first tenth holds less."""
    done = np.linspace(0.0, 1000.0, 400)
    level_mb = np.where(done < 100.0, 0.5 * mb, mb) + grown * done / 1000.0
    level_mb = level_mb + share * mb * np.sin(np.arange(400))
    return [
        Sample(seconds=float(i), mb=float(m), all_mb=float(m), done=float(d))
        for i, (m, d) in enumerate(zip(level_mb, done, strict=True))
    ]


def test_a_phase_is_judged_from_its_second_tenth_on():
    assert level(phase(1000.0, share=0.05), 1000.0).outcome == "bounded"
    assert level(phase(1000.0, grown=150.0), 1000.0).outcome == "bounded"
    found = level(phase(1000.0, share=0.05, grown=400.0), 1000.0)
    assert found.outcome.startswith("grew by ")
    assert found.grown == pytest.approx(320.0, abs=20.0)
    low, high = found.mb_per_unit[1:]
    assert low < 0.4 < high
    # the larger of 10 % and 200 MiB
    assert level(phase(8000.0, grown=800.0), 1000.0).outcome == "bounded"
    assert level(phase(8000.0, grown=1200.0), 1000.0).outcome != "bounded"


@pytest.mark.parametrize(
    ("mb", "outcome"),
    [
        (2000.0, "bounded"),
        (2001.0, "held 2001 MiB, expected 2000 at most"),
        (5000.0, "held 5000 MiB, expected 2000 at most"),
    ],
)
def test_a_spike_in_a_phase_is_its_most_and_no_growth(mb, outcome):
    samples = phase(1000.0)
    spike = samples[390]
    samples[390] = Sample(seconds=390.0, mb=1.0, all_mb=mb, done=spike.done)
    found = level(samples, 1000.0)
    assert (found.outcome, found.at_most, found.grown) == (outcome, mb, 0.0)


def test_rows_one_after_the_other_are_judged_together():
    assert peak_problems(1000.0, 2000.0) == []
    assert peak_problems(1000.0, 2001.0) == ["held 2001 MiB, expected 2000 at most"]


def test_too_few_looks_are_refused():
    with pytest.raises(ValueError, match="2 looks at memory"):
        level(phase(1000.0)[:2], 1000.0)
    assert thinned([]) == []
    assert len(thinned(phase(1.0), 50)) == 50


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
def test_a_short_suite_is_bounded_and_says_what_it_was(tmp_path):
    done = command(
        "benchmarks.reliability.load", "--what=suite", "--cases=300", "--chunk=30",
        "--duration=1", "--rows=IDM", f"--output={tmp_path}",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    made = json.loads((tmp_path / "load_suite.json").read_text())
    assert made["cases"] == 300
    assert made["is"] == "cases of 1 s instead of 120 s"
    assert set(made["rows"]) == {"CC", "FSM", "IDM", "constant speed"}
    for row in made["rows"].values():
        assert row["outcome"] == "bounded"
        assert 0.0 < row["after_a_tenth"] <= row["at_most"]
    assert made["result_sha256"].keys() == {"IDM"}


@pytest.mark.slow
@pytest.mark.multiprocess
def test_a_slice_of_an_import_says_what_the_whole_would_take(tmp_path):
    done = command(
        "benchmarks.reliability.load", "--what=import", "--seconds=1", "--cars=20",
        "--probe=20000", f"--folder={tmp_path}", f"--output={tmp_path / 'out'}",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    made = json.loads((tmp_path / "out" / "load_import.json").read_text())
    assert made["is"] == "a slice of 1 s"
    assert made["shards"] >= 14
    assert made["cutting"]["outcome"] == "bounded"
    assert made["cutting"]["at_most"] > made["main_process_mb_at_most"]
    assert made["extrapolated"]["scenes"] == 10_000_000
    assert made["extrapolated"]["hours"] > 0.0
    assert [x.name for x in tmp_path.iterdir()] == ["out"]


@pytest.mark.slow
def test_a_soak_repeats_to_the_bit_and_finds_a_leak(tmp_path):
    flags = ("--seconds=1", "--leak=60", f"--output={tmp_path}")  # the least rounds
    done = command("benchmarks.reliability.soak", *flags)
    assert done.returncode == 1, done.stderr[-2000:]
    made = json.loads((tmp_path / "soak.json").read_text())
    assert made["outcome"].startswith("rss_mb grew by ")
    assert any(x.startswith("in_use_mb grew by ") for x in made["problems"])
    assert made["rounds"] == 6
    assert all(len(values) == 6 for values in made["series"].values())
    assert made["outputs_compared"] > 10
    assert not [x for x in made["problems"] if "different" in x]
