"""Written signals against drivers."""

import dataclasses

import numpy as np
import pytest

from rcirl_jax.cli.flags import pooled_signals
from rcirl_jax.data.inputs import input_files
from rcirl_jax.data.scenes import signal_phases
from rcirl_jax.data.scenes.collect import Collector
from rcirl_jax.data.scenes.config import CollectConfig, SignalChecks, signal_checks
from rcirl_jax.data.scenes.lines import trusted_signals
from rcirl_jax.data.scenes.signal_phases import (
    check_events,
    check_written,
    first_stands,
    format_phases,
    line_events,
    period,
)
from rcirl_jax.runtime.executors import Processes, Serial
from rcirl_jax.types import Signal
from tests.helpers.roads import car, recording, road


def light(offset, until=200.0):
    """30 s green, 3 s yellow, 27 s red, from `offset` on."""
    cycles = np.arange(offset - 120.0, until, 60.0)
    starts = (cycles[:, None] + [0.0, 30.0, 33.0]).ravel()
    states = ("green", "yellow", "red") * cycles.size
    return Signal(id="light", start=starts, state=states, is_recorded=False)


def drives_of(number, written):
    """A car that crosses 2 to 6 s after the start, and one that waits or not.

    The file starts when its light has been green for 5 s (even numbers) or red
    for 5 s (odd ones); its clock, and thus the cycle's offset, is its own.
    """
    rng = np.random.default_rng(number)
    green = number % 2 == 0
    speed = rng.uniform(8.0, 12.0) if green else 0.0
    behind = rng.uniform(12.0, 20.0)
    tracks = [
        car(name, lambda t, at=at: at + speed * (t - 2.0), seconds=11.0)
        for name, at in (("ego", 130.0), ("behind", 130.0 - behind))
    ]
    made = recording(
        *tracks,
        lanes=road(160.0 if green else 134.25, ("light",), length=560.0),
        signals=(light((-5.0 if green else -38.0) + written),),
    )
    return dataclasses.replace(made, name=f"AAA_Place-1_{number}_T-1")


def checked(made):
    """The checks of all lines of these recordings, and of all together."""
    return check_events(map(line_events, made))


def test_a_true_phase_is_confirmed():
    checks = checked(drives_of(number, 0.0) for number in range(12))
    assert len(checks) == 2
    assert checks[0].verdict == "confirmed"
    assert (checks[0].crossings, checks[0].stands) == (12, 6)
    assert (checks[0].red_written, checks[0].stands_red_written) == (0.0, 1.0)
    assert checks[0].best_offset_s == 0.0
    assert "confirmed" in format_phases(checks)


def test_a_shifted_phase_is_rejected_and_one_that_means_nothing_not_confirmed():
    check = checked(drives_of(number, 25.0) for number in range(12))[0]
    assert check.verdict == "rejected"
    assert check.red_written > 0.9
    assert abs(check.best_offset_s - 35.0) <= 10.0
    assert check.red_best == 0.0
    rng = np.random.default_rng(1)  # a phase per file
    made = [drives_of(number, rng.uniform(0.0, 60.0)) for number in range(12)]
    assert checked(made)[0].verdict in ("rejected", "not contradicted")


def test_periods_and_who_stands_at_the_line():
    assert period(light(0.0)) == pytest.approx(60.0)
    always = Signal(id="s", start=np.array([0.0]), state=("red",))
    assert period(always) is None
    made = drives_of(1, 0.0)  # only the first of a queue does
    assert list(first_stands(made, made.lanes[1])) == [0]


def verdicts(made):
    """As an import takes them."""
    return signal_checks({check.name: check.verdict for check in checked(made)})


@pytest.mark.parametrize(("turned", "used"), [(0.0, 4), (25.0, 0)])
def test_an_import_takes_the_word_of_many_files(turned, used):
    """Two or three crossings a file prove nothing; twelve files do."""
    made = [drives_of(number, turned) for number in range(12)]
    config = CollectConfig(signal_checks=verdicts(made))
    alone = [Collector(one, CollectConfig()) for one in made[:4]]
    told = [Collector(one, config) for one in made[:4]]
    assert sum(len(one.signals) for one in alone) == 0
    assert sum(len(one.signals) for one in told) == used
    said = [note for one in told for note in one.signal_notes]
    assert sum("many files speak against it" in note for note in said) == 4 - used


def test_an_import_can_ask_all_files_itself(monkeypatch, capsys):
    """`--signals=pooled`."""
    made = [drives_of(number, 0.0) for number in range(12)]
    monkeypatch.setattr(signal_phases, "recordings_in", lambda one: [(None, one)])
    monkeypatch.setattr(signal_phases, "work_units", lambda parts, _: iter(parts))
    assert pooled_signals(made, Serial()) == verdicts(made)
    assert "confirmed" in capsys.readouterr().out


def test_a_verdict_on_a_line_comes_before_all_rules():
    one = drives_of(0, 0.0)
    words = {
        "AAA_Place-1/light": "rejected",
        "AAA_Place-1/other": "too few crossings",
        "all together": "not contradicted",
    }
    found = signal_checks(words)
    assert (found.used, found.unused) == ((), ("AAA_Place-1/light",))
    assert not trusted_signals(one, found)[0]
    both = SignalChecks(used=("AAA_Place-1/light",), unused=())
    assert list(trusted_signals(one, both)[0]) == ["light"]
    words["all together"] = "confirmed"
    assert signal_checks(words).used == ("AAA_Place-1/other",)


@pytest.mark.slow
@pytest.mark.dataset
def test_urban_signals(data_dir):
    """The written cycles fit the drivers, over all files; one file proves little."""
    folder = data_dir / "ngsim_urban_commonroad" / "xml"
    checks = check_written(input_files("commonroad", folder), executor=Processes(2))
    together = checks[-1]
    assert together.crossings > 150
    assert together.red_written < 0.1
    assert together.best_offset_s == 0.0
    assert together.verdict == "confirmed"
    assert sum(check.verdict == "confirmed" for check in checks[:-1]) >= 3
    assert sum(check.verdict == "rejected" for check in checks[:-1]) <= 4
