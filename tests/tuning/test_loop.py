"""What a run says of how far it is: the stages, the time so far and the time left."""

import types

import pytest

from rcirl_jax.tuning import loop

NAMES = ("import", "demonstrate", "train", "rank")
WORK = {"demonstrate": 60.0, "train": 120.0, "rank": 60.0}


@pytest.fixture
def time(monkeypatch):
    """The clock of the loop, which stands still."""
    made = types.SimpleNamespace(now=100.0)
    made.monotonic = lambda: made.now
    monkeypatch.setattr(loop, "time", made)
    return made


def clock_of(*finished):
    """A run of which an earlier process has finished stages, and its clock."""
    run = types.SimpleNamespace(said=[], done=[], compiled=[])
    run.say = run.said.append
    run.stages = types.SimpleNamespace(read=lambda: dict.fromkeys(finished))
    return run, loop.Clock(run, NAMES, run.compiled)


def test_the_time_left_grows_with_what_is_not_compiled(time):
    run, clock = clock_of()
    for name, work, took, compiled in (
        ("import", None, 30.0, 0.0),
        ("demonstrate", WORK, 300.0, 120.0),  # of the rest 60 s are usual, 120 s more
        ("train", WORK, 240.0, 0.0),
    ):
        clock.begin(name, work)
        time.now += took
        run.compiled.append(compiled)
        run.done.append(f"{name} 0")
    clock.begin("rank", WORK)
    left = "left, compiling not counted"
    assert run.said == [
        "stage 1 of 4: import; 0 s so far",
        f"stage 2 of 4: demonstrate; 30 s so far, about 4 min {left}",
        f"stage 3 of 4: train; 6 min so far, about 6 min {left}",
        f"stage 4 of 4: rank; 10 min so far, about 2 min {left}",
    ]


def test_stages_of_an_earlier_run_take_no_time_until_something_changes(time):
    run, clock = clock_of("demonstrate", "export")
    clock.begin("demonstrate", WORK)
    assert " about 1 min left" in run.said[-1]
    time.now += WORK["demonstrate"]
    run.done.append("demonstrate learner 1")
    clock.begin("train", WORK)
    assert " about 3 min left" in run.said[-1]
