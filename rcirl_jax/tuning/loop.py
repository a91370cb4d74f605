"""The tuning loop: data -> rewards -> ranking -> simulation -> verdict -> report.

The order of the stages and what is printed; each stage's work is in `demonstrations`
and `stages`.

What is left is the work of the stages to come, counted in seconds of two usual cores,
times how much longer this machine took for the stages that it has done. Compiling,
which does not grow with the work, counts in neither.
"""

import dataclasses
import shlex
import textwrap
import time
from collections.abc import Iterator, Mapping, Sequence

from rcirl_jax.data.importing import Logs
from rcirl_jax.data.store.dataset import Dataset, Demonstrations, shares_of
from rcirl_jax.errors import InputError, extra_of
from rcirl_jax.evaluation.closed_loop.likeness import read_arrays
from rcirl_jax.evaluation.gate.types import CANDIDATE, DRIVES, Verdict
from rcirl_jax.evaluation.gate.verdict import MIN_CASES
from rcirl_jax.evaluation.gate.words import WIDTH
from rcirl_jax.export.closed_loop import SuiteJob, checked_sampler
from rcirl_jax.export.forms import terms_table
from rcirl_jax.export.loading import open_reward, prior_cost_words
from rcirl_jax.planner import own_cost
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
    compare_choices,
    dial_plan,
    gate,
    rank,
    report,
    simulate,
    suite_job,
    train_seeds,
    turn_dial,
    verdict_of,
    warnings_of,
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
    "demonstrate": "demonstrate",
    "train": "export",
    "rank": "rank recorded",
    "simulate": "likeness",
    "gate": "gate",
    "report": "report",
}
NO_REPORT = "no report: "  # begins the line on what it needs


def tune(run: Run, given: Sequence[str | Logs], last: str = STAGES[-1]) -> None:
    """Runs the stages in order and prints their results.

    Args:
      run: folder and settings.
      given: sources: datasets, or logs to import.
      last: the last stage, one of `STAGES`.
    """
    # what would fail only after hours of work
    job, _ = suite_job(run, tuned=False)
    names, made = [*STAGES[: STAGES.index(last) + 1]], Made()
    if run.config.simulated.expert == "none" and "demonstrate" in names:
        names.remove("demonstrate")
    if "gate" in names and len(job.refs) < MIN_CASES:
        raise InputError(
            f"cases: {len(job.refs)} in all: the gate expects at least {MIN_CASES}: "
            "give more cases of each family, or --until=simulate"
        )
    shares = shares_of(run.config.data_weights, len(given))
    _check_incumbent(run)
    if checked_sampler(run.config.train.sampler).own:
        run.say(f"candidates: {run.config.train.sampler.own}")
    if run.steers:
        run.say("mode: path_speed: paths are learned, planned and judged too")
    if run.own_cost:
        run.say(own_cost.words(run.own_cost))
    with compiles() as compiled:
        clock = Clock(run, names, compiled)
        for name in _stages(run, given, shares, made):
            if name in names:
                clock.begin(name, work_of(run, job, made.recorded))
            elif STAGES.index(name) > STAGES.index(last):
                break
    if made.verdict is not None:
        warned = warnings_of(run)
        run.say(_ending(run, made.verdict, made.page, job.refs[0].id, warned))
    elif "train" in names:
        run.say(f"weights: {run.weights}")


@dataclasses.dataclass
class Made:
    """The results of the stages so far."""

    recorded: Demonstrations | None = None  # what was imported
    verdict: Verdict | None = None
    page: str = ""  # a line on the report, if it was asked for


def _stages(
    run: Run, given: Sequence[str | Logs], shares: Sequence[float] | None, made: Made
) -> Iterator[str]:
    """Does the stages in order; yields the name of each before it begins."""
    yield "import"
    sources = [source(run, one, number) for number, one in enumerate(given)]
    made.recorded = recorded = as_one(sources, shares)
    yield "demonstrate"
    everything = with_simulated(run, sources, shares)
    yield "train"
    train_seeds(run, everything, sources)
    run.say(_said_of_weights(run))
    _warn(run, "training")
    yield "rank"
    rank(run, recorded)
    _warn(run, "ranking")
    yield "simulate"
    simulate(run, sources)
    yield "gate"
    made.verdict = gate(run)
    yield "report"
    turn_dial(run, sources)
    compare_choices(run, sources)
    made.page = _drawn(run, made.verdict, recorded, sources)


def _warn(run: Run, section: str) -> None:
    """Says what the run has to warn of in one section."""
    for said in warnings_of(run).get(section, ()):
        run.say(f"warning: {said}")


def _drawn(
    run: Run, verdict: Verdict, dataset: Demonstrations, sources: Sequence[Dataset]
) -> str:
    """Draws the page; returns where it is, or the extra that it needs."""
    try:
        report(run, verdict, dataset, sources)
    except ImportError as error:
        if (missing := extra_of(error)) is None:
            raise
        return f"{NO_REPORT}{missing}"
    return f"report to open: {run.page}"


def _ending(
    run: Run,
    verdict: Verdict,
    page: str,
    first: str,
    warned: Mapping[str, Sequence[str]],
) -> str:
    """Returns the last lines: verdict, reason, files, next command; about eight.

    Args:
      run: whose verdict it is.
      verdict: of the gate.
      page: a line on the report, if it was asked for.
      first: case to look at where the verdict names none.
      warned: of `warnings_of`.
    """
    lines = ["", f"verdict: {verdict.decision.upper()}"]
    lines += textwrap.wrap(verdict.sentence, WIDTH)
    if count := sum(map(len, warned.values())):
        where = ", ".join(warned)
        lines.append(f"warnings: {count}, said above and in the report: {where}")
    lines += [f"weights: {run.weights}", f"all tables: {run.tables}"]
    lines += [page] if page else []
    case = (*verdict.look_at, first)[0]
    weights, folder = (shlex.quote(str(x)) for x in (run.weights, run.folder))
    step = f"rcirl replay --weights={weights} --case={case} --output={folder}/case"
    if page.startswith(NO_REPORT):
        step = f"install it, then rcirl report --run={folder}"
    if verdict.part and verdict.decision == "could not judge":
        usual = {"suite": "full", "cases": None, "duration_s": None, "drives": DRIVES}
        config = dataclasses.replace(run.config, **usual)
        job, _ = suite_job(dataclasses.replace(run, config=config))
        there = read_arrays(run.folder / "likeness.npz").available
        drives = min(config.drives, there)
        driven = len(job.refs) * job.duration_s + drives * DRIVE_S
        lines.append(
            "for a verdict that can ship: the same command without --suite, --cases, "
            "--duration and --drives, about "
            f"{in_words(DRIVEN_S * rows_of(job) * driven)} more on two usual cores"
        )
    return "\n".join([*lines, f"next: {step}"])


def draw_again(run: Run, given: Sequence[str | Logs]) -> None:
    """Draws the report alone, of a run that has its verdict.

    Args:
      run: folder and settings.
      given: sources, as in `tune`; what was imported is in the folder.
    """
    shares = shares_of(run.config.data_weights, len(given))
    sources = [kept_source(run, one, number) for number, one in enumerate(given)]
    dataset = as_one(sources, shares)
    report(run, verdict_of(run), dataset, sources)
    run.say(f"report to open: {run.page}")


def _check_incumbent(run: Run) -> None:
    """Refuses an incumbent of other features or sampler: it could not be ranked."""
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
    """Says which features never vary in training, and a prior cost's gains.

    Of own terms, the tuned weights.
    """
    reward = open_reward(str(run.weights))
    if run.config.train.reward.today:
        return terms_table(reward)
    silent = "features without effect, for they never vary in the training data: "
    silent += ", ".join(reward.unsupported) or "none"
    prior = prior_cost_words(CANDIDATE, reward)
    return "\n".join(filter(None, (silent, prior)))


def rows_of(job: SuiteJob) -> int:
    """Counts who drives: rewards, baselines, the tuned IDM and two who judge."""
    learned, planners = len(job.weights), len(job.planners)
    return learned + planners + len(job.baselines) + 3


def work_of(
    run: Run, job: SuiteJob, dataset: Demonstrations | None
) -> dict[str, float] | None:
    """Returns seconds on two usual cores of each stage but import; None before it.

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
    cases = 0 if plan.expert == "none" else plan.cases
    demonstrated = DRIVEN_S * len(suite_refs("full", 1)) * cases * plan.duration_s
    recorded = min(config.drives, counts["test"]) * DRIVE_S
    driven = len(job.refs) * job.duration_s + recorded
    settings, cases = dial_plan(job)
    some = len(cases) * job.duration_s + recorded  # s
    turned = 2.0 * some  # of `compare_choices`, then the settings of the dial
    if config.gain or config.train.residual_on:
        turned += (len(settings) - 2) * some
    return {
        "demonstrate": demonstrated,
        "train": config.seeds * learned,
        "rank": SEARCH_S + 2.0 * RANKED_S * counts["test"],
        "simulate": DRIVEN_S * rows_of(job) * driven,
        "gate": GATE_S,
        "report": PAGE_S + DRIVEN_S * turned,
    }


class Clock:
    """Announces each stage, and learns from how long they took.

    Args:
      run: whose stages they are.
      names: of all stages, in their order.
      compiled: s of each compilation so far; grows (`runtime.compiling`).
    """

    def __init__(
        self, run: Run, names: Sequence[str], compiled: Sequence[float]
    ) -> None:
        self._run, self._names, self._compiled = run, names, compiled
        self._start = self._begin = time.monotonic()
        self._worked, self._took = 0.0, 0.0  # s, of usual cores and of this machine
        self._known = {*run.stages.read()}  # stages of an earlier run
        # of the stage that is at work: s expected, s compiled before, stages done
        self._expected, self._before, self._done = 0.0, 0.0, 0

    def begin(self, name: str, work: Mapping[str, float] | None) -> None:
        """Says that a stage begins, so that the one before it has ended.

        Args:
          name: of the stage.
          work: of every stage (`work_of`).
        """
        now, compiled, done = time.monotonic(), sum(self._compiled), len(self._run.done)
        if self._expected and done > self._done:
            took = now - self._begin - (compiled - self._before)
            self._worked += self._expected
            self._took += max(took, 0.0)
        self._begin, self._before, self._done = now, compiled, done
        self._expected = (work or {}).get(name, 0.0)
        number = self._names.index(name)
        text = f"stage {number + 1} of {len(self._names)}: {name}; "
        text += f"{in_words(now - self._start)} so far"
        if work is not None:
            # what an earlier run has finished will be kept, unless something changed
            ends = {} if done else LAST
            to_do = [n for n in self._names[number:] if ends.get(n) not in self._known]
            left = sum(work.get(one, 0.0) for one in to_do)
            left *= (self._took + USUAL_S) / (self._worked + USUAL_S)
            text += f", about {in_words(left)} left, compiling not counted"
        self._run.say(text)


def in_words(seconds: float) -> str:
    """Formats a duration: "40 s", "12 min", "1 h 05 min"."""
    if seconds < 59.5:
        return f"{seconds:.0f} s"
    hours, minutes = divmod(round(seconds / 60.0), 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min"
