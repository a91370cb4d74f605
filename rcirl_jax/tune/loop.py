"""The tuning loop: data -> rewards -> ranking -> simulation -> verdict -> report.

The order of the stages and what is printed; each stage's work is in `demonstrations`,
`rewards`, `evidence` and `report`, the time that is left in `progress`.
"""

import functools
import textwrap
from collections.abc import Callable, Sequence

from rcirl_jax.data.logs import Logs
from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.data.store.joined import Demonstrations, JoinedDatasets, shares_of
from rcirl_jax.errors import InputError, extra_of
from rcirl_jax.evaluation.gate.runs import CANDIDATE
from rcirl_jax.evaluation.gate.types import Verdict
from rcirl_jax.evaluation.gate.words import WIDTH
from rcirl_jax.export.loading import open_reward, prior_cost_words
from rcirl_jax.tune.demonstrations import kept_source, source, with_rehearsal
from rcirl_jax.tune.evidence import (
    gate,
    likeness,
    rank,
    simulate,
    suite_job,
    verdict_of,
)
from rcirl_jax.tune.progress import clock, work_of
from rcirl_jax.tune.report import report
from rcirl_jax.tune.rewards import train_seeds
from rcirl_jax.tune.run import Run

STAGES = ("import", "rehearse", "train", "rank", "simulate", "gate", "report")

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
    everything: list[Demonstrations] = []  # what was imported; that with the rehearsal
    verdict = functools.cache(lambda: verdict_of(run))  # once, where it is asked for
    page: list[str] = []

    def imported() -> None:
        sources.extend(source(run, one, number) for number, one in enumerate(given))
        everything.append(_joined(sources, shares))

    def trained() -> None:
        train_seeds(run, everything[-1])
        run.say(_said_of_weights(run))

    steps: dict[str, Callable[[], object]] = {
        "import": imported,
        "rehearse": lambda: everything.append(with_rehearsal(run, sources, shares)),
        "train": trained,
        "rank": lambda: rank(run, everything[0]),
        "simulate": lambda: (simulate(run), likeness(run, sources)),
        "gate": lambda: gate(run, verdict),
        "report": lambda: page.append(_drawn(run, verdict, everything[0], sources)),
    }
    names = STAGES[: STAGES.index(last) + 1]
    with clock(run, names) as time:
        for name in names:
            known = everything[0] if everything else None
            with time.stage(name, work_of(run, job, known)):
                steps[name]()
    if last in ("gate", "report"):
        run.say(_ending(run, verdict(), page, job.refs[0].id))
    elif last not in ("import", "rehearse"):
        run.say(f"weights: {run.weights}")


def _joined(
    sources: Sequence[Dataset], shares: Sequence[float] | None
) -> Demonstrations:
    """The sources as one."""
    return sources[0] if len(sources) == 1 else JoinedDatasets(sources, shares)


def _drawn(
    run: Run,
    verdict: Callable[[], Verdict],
    dataset: Demonstrations,
    sources: Sequence[Dataset],
) -> str:
    """Draw the page; one line on where it is, or on what it needs and is not there."""
    try:
        report(run, verdict, dataset, sources)
    except ImportError as error:
        if (missing := extra_of(error)) is None:
            raise
        return f"{NO_REPORT}{missing}"
    return f"report to open: {run.page}"


def _ending(run: Run, verdict: Verdict, page: Sequence[str], first: str) -> str:
    """The verdict, why, where all of it is, what to do next; about eight lines.

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
    dataset = _joined(sources, shares)
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
            f"--incumbent: {known.file}: preset and mode {found}: expected {wanted}"
        )


def _said_of_weights(run: Run) -> str:
    """Features that the training never saw vary; gains of a prior cost; one a line."""
    reward = open_reward(str(run.weights))
    silent = "features without effect, for they never vary in the training data: "
    silent += ", ".join(reward.unsupported) or "none"
    prior = prior_cost_words(CANDIDATE, reward)
    return "\n".join(filter(None, (silent, prior)))
