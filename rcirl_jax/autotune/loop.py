"""The tuning loop: data -> rewards -> ranking -> simulation -> verdict -> report.

The order of the stages and what is printed; each stage's work is in `demonstrations`,
`rewards`, `evidence` and `report`.
"""

import functools
import textwrap
from collections.abc import Callable, Sequence

from rcirl_jax.autotune.demonstrations import kept_source, source, with_rehearsal
from rcirl_jax.autotune.evidence import (
    gate,
    likeness,
    rank,
    simulate,
    suite_job,
    verdict_of,
)
from rcirl_jax.autotune.report import report
from rcirl_jax.autotune.rewards import train_seeds
from rcirl_jax.autotune.run import Run
from rcirl_jax.data.logs import Logs
from rcirl_jax.data.store.joined import Demonstrations, JoinedDatasets, shares_of
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.gate.runs import CANDIDATE
from rcirl_jax.evaluation.gate.types import Verdict
from rcirl_jax.evaluation.gate.words import WIDTH
from rcirl_jax.export.loading import open_reward
from rcirl_jax.report.tuning.features import anchor_words

STAGES = ("import", "rehearse", "train", "rank", "simulate", "gate", "report")


def tune(run: Run, given: Sequence[str | Logs], last: str = STAGES[-1]) -> None:
    """Run the stages in order and say what comes of it.

    Args:
      run: folder and settings.
      given: sources: datasets, or logs to import.
      last: the last stage, one of `STAGES`.
    """
    # what would fail only after hours of work
    suite_job(run, tuned=False)
    shares = shares_of(run.config.data_weights, len(given))
    _check_incumbent(run)
    sources = [source(run, one, number) for number, one in enumerate(given)]
    dataset = sources[0] if len(sources) == 1 else JoinedDatasets(sources, shares)
    everything: list[Demonstrations] = [dataset]
    verdict = functools.cache(lambda: verdict_of(run))  # once, where it is asked for
    steps: dict[str, Callable[[], object]] = {
        "import": lambda: None,
        "rehearse": lambda: everything.append(with_rehearsal(run, sources, shares)),
        "train": lambda: train_seeds(run, everything[-1]),
        "rank": lambda: rank(run, dataset),
        "simulate": lambda: (simulate(run), likeness(run, sources)),
        "gate": lambda: gate(run, verdict),
        "report": lambda: report(run, verdict, dataset, sources),
    }
    for name in STAGES[: STAGES.index(last) + 1]:
        steps[name]()
    if last in ("gate", "report"):
        run.say(_ending(run, verdict()))
    if last not in ("import", "rehearse"):
        run.say(_said_of_weights(run))
        run.say(f"weights: {run.weights}")
    if last == "report":
        run.say(f"report to open: {run.page}")


def _ending(run: Run, verdict: Verdict) -> str:
    """The verdict, why, where the tables are, and what to look at; a few lines."""
    lines = ["", f"verdict: {verdict.decision.upper()}"]
    lines += textwrap.wrap(verdict.sentence, WIDTH)
    lines.append(f"all tables: {run.tables}")
    if verdict.look_at:
        lines.append(
            f"replay: python -m experiments.replay --weights={run.weights} "
            f"--case={verdict.look_at[0]} --output={run.folder / 'case'}"
        )
    return "\n".join(lines)


def draw_again(run: Run, given: Sequence[str | Logs]) -> None:
    """The stage report alone, of a run that has its verdict.

    Args:
      run: folder and settings.
      given: sources, as in `tune`; what was imported is in the folder.
    """
    shares = shares_of(run.config.data_weights, len(given))
    sources = [kept_source(run, one, number) for number, one in enumerate(given)]
    dataset = sources[0] if len(sources) == 1 else JoinedDatasets(sources, shares)
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
    """Features that the training never saw vary; gains, if anchored; one a line."""
    reward = open_reward(str(run.weights))
    silent = "features without effect, for they never vary in the training data: "
    silent += ", ".join(reward.unsupported) or "none"
    anchored = anchor_words(CANDIDATE, reward)
    return "\n".join(filter(None, (silent, anchored)))
