"""What a run says of how far it is: the stages, the time so far and the time left."""

import types

from rcirl_jax.tuning import loop

NAMES = ("import", "demonstrate", "train", "rank")
WORK = {"demonstrate": 60.0, "train": 120.0, "rank": 60.0}


class Time:
    now = 100.0

    def monotonic(self):
        return self.now


def a_run(*finished):
    """What the clock reads of a run of which an earlier process has finished stages."""
    return types.SimpleNamespace(
        said=[],
        done=[],
        stages=types.SimpleNamespace(read=lambda: dict.fromkeys(finished)),
    )


def begun(run, monkeypatch):
    time = Time()
    monkeypatch.setattr(loop, "time", time)
    run.say = run.said.append
    run.compiled = []
    return time, loop.Clock(run, NAMES, run.compiled)


def test_the_time_left_grows_with_what_is_not_compiled(monkeypatch):
    run = a_run()
    time, clock = begun(run, monkeypatch)
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


def test_stages_of_an_earlier_run_take_no_time_until_something_changes(monkeypatch):
    run = a_run("demonstrate", "export")
    time, clock = begun(run, monkeypatch)
    clock.begin("demonstrate", WORK)
    assert " about 1 min left" in run.said[-1]
    time.now += WORK["demonstrate"]
    run.done.append("demonstrate learner 1")
    clock.begin("train", WORK)
    assert " about 3 min left" in run.said[-1]
