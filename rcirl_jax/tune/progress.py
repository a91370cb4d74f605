"""Progress of a run: its stage, the time so far, and about the time left.

What is left is the work of the stages to come, counted in seconds of two usual cores,
times how much longer this machine took for the stages that it has done. Compiling,
which does not grow with the work, counts in neither.
"""

import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.export.spread import SuiteJob
from rcirl_jax.runtime.compiling import compiles
from rcirl_jax.simulation.suite import suite_refs
from rcirl_jax.tune.run import Run

# s of two usual cores (docs/results.md): for a scene in an epoch, for a second that a
# row drives, for a scene that is ranked, and for what hardly depends on the data
TRAINED_S, DRIVEN_S, RANKED_S = 5e-4, 4.5e-4, 3e-3
SEARCH_S, GATE_S, PAGE_S = 20.0, 2.0, 30.0
DRIVE_S = 8.0  # of a held-out drive
# s that count as work done at the usual speed, before there is any: short stages say
# little of how fast a machine is
USUAL_S = 60.0
# the last part of each stage, by the names of stages.json
LAST = {
    "train": "export",
    "rank": "rank recorded",
    "simulate": "likeness",
    "gate": "gate",
    "report": "report",
}


def work_of(
    run: Run, job: SuiteJob, dataset: Demonstrations | None
) -> dict[str, float] | None:
    """Seconds on two usual cores of each stage but import; None before the import.

    Args:
      run: its settings.
      job: what the suite drives.
      dataset: what was imported.
    """
    if dataset is None:
        return None
    config, plan = run.config, run.config.rehearsal
    counts = {name: dataset.indices(name).size for name in ("train", "test")}
    learned = TRAINED_S * counts["train"] * config.train.epochs
    rows = len(job.weights) + len(job.baselines) + 3  # tuned IDM and two who judge
    cases = plan.cases + plan.rounds * plan.takeover_cases if plan.datasets else 0
    rehearsed = DRIVEN_S * len(suite_refs("full", 1)) * cases * plan.duration_s
    driven = len(job.refs) * job.duration_s + config.drives * DRIVE_S
    return {
        "rehearse": rehearsed + (plan.rounds * learned if plan.datasets else 0.0),
        "train": config.seeds * learned,
        "rank": SEARCH_S + 2.0 * RANKED_S * counts["test"],
        "simulate": DRIVEN_S * rows * driven,
        "gate": GATE_S,
        "report": PAGE_S,
    }


class Clock:
    """Announces each stage.

    Args:
      run: whose stages they are.
      names: of all stages, in their order.
      compiled: s of each compilation so far; grows (`runtime.compiling`).
    """

    def __init__(
        self, run: Run, names: Sequence[str], compiled: Sequence[float]
    ) -> None:
        self._run, self._names, self._compiled = run, names, compiled
        self._begin = time.monotonic()
        self._worked, self._took = 0.0, 0.0  # s, of usual cores and of this machine
        self._known = {*run.stages.read()}  # stages of an earlier run

    @contextlib.contextmanager
    def stage(self, name: str, work: Mapping[str, float] | None) -> Iterator[None]:
        """Say that a stage begins, do it, and learn from how long it took.

        Args:
          name: of the stage.
          work: of every stage (`work_of`).
        """
        self._run.say(self.line(name, work))
        begin, compiled = time.monotonic(), sum(self._compiled)
        done = len(self._run.done)
        yield
        expected = (work or {}).get(name, 0.0)
        if len(self._run.done) > done and expected:
            took = time.monotonic() - begin - (sum(self._compiled) - compiled)
            self._worked += expected
            self._took += max(took, 0.0)

    def line(self, name: str, work: Mapping[str, float] | None) -> str:
        """The line printed when a stage begins."""
        number, count = self._names.index(name) + 1, len(self._names)
        so_far = f"{in_words(time.monotonic() - self._begin)} so far"
        text = f"stage {number} of {count}: {name}; {so_far}"
        if work is None:
            return text
        left = sum(work.get(one, 0.0) for one in self._to_do(self._names[number - 1 :]))
        left *= (self._took + USUAL_S) / (self._worked + USUAL_S)
        return f"{text}, about {in_words(left)} left, compiling not counted"

    def _to_do(self, names: Sequence[str]) -> list[str]:
        """Stages that will not be kept, as far as can be known.

        While nothing has changed, what an earlier run has finished will be kept.
        """
        if self._run.done:
            return [*names]
        last = f"rehearse {self._run.config.rehearsal.datasets - 1}"
        ends = {"rehearse": last, **LAST}
        return [name for name in names if ends.get(name) not in self._known]


@contextlib.contextmanager
def clock(run: Run, names: Sequence[str]) -> Iterator[Clock]:
    """A clock of a run; arguments as of `Clock`."""
    with compiles() as compiled:
        yield Clock(run, names, compiled)


def in_words(seconds: float) -> str:
    """A duration: "40 s", "12 min", "1 h 05 min"."""
    if seconds < 59.5:
        return f"{seconds:.0f} s"
    hours, minutes = divmod(round(seconds / 60.0), 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min"
