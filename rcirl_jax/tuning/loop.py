"""The tuning loop: data -> rewards -> ranking -> simulation -> verdict -> report.

The order of the stages and what is printed; each stage's work is in `demonstrations`
and `stages`.

What is left is the work of the stages to come, counted in seconds of two usual cores,
times how much longer this machine took for the stages that it has done. Compiling,
which does not grow with the work, counts in neither.
"""

import contextlib
import functools
import textwrap
import time
from collections.abc import Callable, Iterator, Mapping, Sequence

from rcirl_jax.data.importing import Logs
from rcirl_jax.data.store.dataset import Dataset, Demonstrations, shares_of
from rcirl_jax.errors import InputError, extra_of
from rcirl_jax.evaluation.gate.types import CANDIDATE, Verdict
from rcirl_jax.evaluation.gate.words import WIDTH
from rcirl_jax.export.closed_loop import SuiteJob
from rcirl_jax.export.loading import open_reward, prior_cost_words
from rcirl_jax.runtime.compiling import compiles
from rcirl_jax.simulation.suite import suite_refs
from rcirl_jax.tuning.demonstrations import (
    as_one,
    kept_source,
    source,
    with_simulated,
)
from rcirl_jax.tuning.run import Run
from rcirl_jax.tuning.stages import (
    gate,
    rank,
    report,
    simulate,
    suite_job,
    train_seeds,
    verdict_of,
)

STAGES = ("import", "demonstrate", "train", "rank", "simulate", "gate", "report")
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
NO_REPORT = "no report: "  # begins the line on what it needs


def tune(run: Run, given: Sequence[str | Logs], last: str = STAGES[-1]) -> None:
    """Run the stages in order and print their results.

    Args:
      run: folder and settings.
      given: sources: datasets, or logs to import.
      last: the last stage, one of `STAGES`.
    """
    # what would fail only after hours of work
    job, _ = suite_job(run, tuned=False)
    shares = shares_of(run.config.data_weights, len(given))
    _check_incumbent(run)
    sources: list[Dataset] = []
    everything: list[Demonstrations] = []  # what was imported; and that with simulated
    verdict = functools.cache(lambda: verdict_of(run))  # once, where it is asked for
    page: list[str] = []

    def imported() -> None:
        sources.extend(source(run, one, number) for number, one in enumerate(given))
        everything.append(as_one(sources, shares))

    def trained() -> None:
        train_seeds(run, everything[-1])
        run.say(_said_of_weights(run))

    steps: dict[str, Callable[[], object]] = {
        "import": imported,
        "demonstrate": lambda: everything.append(with_simulated(run, sources, shares)),
        "train": trained,
        "rank": lambda: rank(run, everything[0]),
        "simulate": lambda: simulate(run, sources),
        "gate": lambda: gate(run, verdict),
        "report": lambda: page.append(_drawn(run, verdict, everything[0], sources)),
    }
    names = STAGES[: STAGES.index(last) + 1]
    with compiles() as compiled:
        watch = Clock(run, names, compiled)
        for name in names:
            known = everything[0] if everything else None
            with watch.stage(name, work_of(run, job, known)):
                steps[name]()
    if last in ("gate", "report"):
        run.say(_ending(run, verdict(), page, job.refs[0].id))
    elif last not in ("import", "demonstrate"):
        run.say(f"weights: {run.weights}")


def _drawn(
    run: Run,
    verdict: Callable[[], Verdict],
    dataset: Demonstrations,
    sources: Sequence[Dataset],
) -> str:
    """Draws the page; returns where it is, or the extra that it needs."""
    try:
        report(run, verdict, dataset, sources)
    except ImportError as error:
        if (missing := extra_of(error)) is None:
            raise
        return f"{NO_REPORT}{missing}"
    return f"report to open: {run.page}"


def _ending(run: Run, verdict: Verdict, page: Sequence[str], first: str) -> str:
    """The last lines: verdict, reason, files, next command; about eight.

    Args:
      run: whose verdict it is.
      verdict: of the gate.
      page: a line on the report, if it was asked for.
      first: case to look at where the verdict names none.
    """
    lines = ["", f"verdict: {verdict.decision.upper()}"]
    lines += textwrap.wrap(verdict.sentence, WIDTH)
    lines += [f"weights: {run.weights}", f"all tables: {run.tables}", *page]
    case = (*verdict.look_at, first)[0]
    step = f"rcirl replay --weights={run.weights} --case={case}"
    step += f" --output={run.folder / 'case'}"
    if any(line.startswith(NO_REPORT) for line in page):
        step = f"install it, then rcirl report --run={run.folder}"
    return "\n".join([*lines, f"next: {step}"])


def draw_again(run: Run, given: Sequence[str | Logs]) -> None:
    """The stage report alone, of a run that has its verdict.

    Args:
      run: folder and settings.
      given: sources, as in `tune`; what was imported is in the folder.
    """
    shares = shares_of(run.config.data_weights, len(given))
    sources = [kept_source(run, one, number) for number, one in enumerate(given)]
    dataset = as_one(sources, shares)
    report(run, functools.cache(lambda: verdict_of(run)), dataset, sources)
    run.say(f"report to open: {run.page}")


def _check_incumbent(run: Run) -> None:
    """An incumbent of other features or sampler could not be ranked beside."""
    known = run.incumbent_reward()
    if known is None:
        return
    found = (str(known.preset), str(known.provenance.get("mode", "speed")))
    wanted = (run.config.train.features, run.config.train.sampler.mode)
    if found != wanted:
        raise InputError(
            f"incumbent: {known.file}: preset and mode {found}: expected {wanted}"
        )


def _said_of_weights(run: Run) -> str:
    """Features that the training never saw vary; gains of a prior cost; one a line."""
    reward = open_reward(str(run.weights))
    silent = "features without effect, for they never vary in the training data: "
    silent += ", ".join(reward.unsupported) or "none"
    prior = prior_cost_words(CANDIDATE, reward)
    return "\n".join(filter(None, (silent, prior)))


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
    config, plan = run.config, run.config.simulated
    counts = {name: dataset.indices(name).size for name in ("train", "test")}
    learned = TRAINED_S * counts["train"] * config.train.epochs
    rows = len(job.weights) + len(job.baselines) + 3  # tuned IDM and two who judge
    cases = plan.cases + plan.rounds * plan.takeover_cases if plan.datasets else 0
    demonstrated = DRIVEN_S * len(suite_refs("full", 1)) * cases * plan.duration_s
    driven = len(job.refs) * job.duration_s + config.drives * DRIVE_S
    return {
        "demonstrate": demonstrated + (plan.rounds * learned if plan.datasets else 0.0),
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
        last = f"demonstrate {self._run.config.simulated.datasets - 1}"
        ends = {"demonstrate": last, **LAST}
        return [name for name in names if ends.get(name) not in self._known]


def in_words(seconds: float) -> str:
    """A duration: "40 s", "12 min", "1 h 05 min"."""
    if seconds < 59.5:
        return f"{seconds:.0f} s"
    hours, minutes = divmod(round(seconds / 60.0), 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min"
