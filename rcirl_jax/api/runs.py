"""Ranks, drives and judges trained rewards, or goes through the whole loop."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rcirl_jax.api.logs import Place
from rcirl_jax.api.training import folders_of, training_of
from rcirl_jax.data.store.dataset import Dataset, Demonstrations, open_dataset
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.suite import (
    SuiteResult,
    write_suite,
)
from rcirl_jax.evaluation.closed_loop.summary import format_suite
from rcirl_jax.evaluation.gate.types import DRIVES, GateConfig, Verdict
from rcirl_jax.evaluation.gate.verdict import write_verdict
from rcirl_jax.evaluation.gate.words import format_verdict
from rcirl_jax.evaluation.ranking.evaluate import evaluate_ranking
from rcirl_jax.evaluation.ranking.report import RankingReport, format_table
from rcirl_jax.export.closed_loop import (
    SuiteJob,
    gate_baselines,
    gate_job,
    judged,
    run_job,
)
from rcirl_jax.export.loading import load_runs, open_reward
from rcirl_jax.runtime.executors import Executor, Serial
from rcirl_jax.runtime.pipeline import only_one
from rcirl_jax.runtime.provenance import provenance
from rcirl_jax.simulation.rows import BASELINES
from rcirl_jax.simulation.suite import case_duration, suite_refs
from rcirl_jax.train.loop import Running
from rcirl_jax.tuning.loop import tune as run_stages
from rcirl_jax.tuning.recipes import DEFAULT, load_recipe
from rcirl_jax.tuning.run import Run, TuneConfig
from rcirl_jax.tuning.stages import verdict_of


def rank(
    weights: Place | Sequence[Place],
    data: Place | Demonstrations,
    *,
    horizon_s: float = 5.0,
    split: str = "test",
    drop_collisions: bool = False,
    executor: Executor | None = None,
) -> RankingReport:
    """Rank the candidates of held-out scenes by rewards, beside all baselines.

    Args:
      weights: file, or files; those of one loss and shape are the seeds of one row, or
        a row each where two have the same seed.
      data: a dataset or its folder.
      horizon_s: s at which distances to the human are taken, up to 8.
      split: of the dataset.
      drop_collisions: rank only candidates that meet nothing, in every row.
      executor: where scenes are scored, of `rcirl_jax.runtime.executors`; None: here.

    Returns:
      The report: by row and metric an estimate with its 95 % interval, and paired
      differences. `format_report` makes a table of it.

    Raises:
      InputError: files that cannot be read or do not fit together, or no scene that is
        recorded so long.

    Examples:
        >>> report = rcirl_jax.rank("weights.msgpack", "data")
        >>> report.rows["oracle"]["top1_fde"].value < 10.0  # m
        True
    """
    if not 0.0 < horizon_s <= 8.0:
        raise InputError(f"horizon_s: {horizon_s}: expected above 0, at most 8 s")
    learned, setup = load_runs(_files(weights))
    setup = dataclasses.replace(
        setup, horizon_s=horizon_s, split=split, drop_collisions=drop_collisions
    )
    dataset = open_dataset(data) if isinstance(data, str | os.PathLike) else data
    return evaluate_ranking(dataset, learned, setup, executor)


def simulate(
    weights: Place | Sequence[Place],
    *,
    suite: str = "smoke",
    cases: int | None = None,
    duration_s: float | None = None,
    baselines: Sequence[str] = BASELINES,
    plan_every: int = 1,
    output: Place | None = None,
    executor: Executor | None = None,
) -> SuiteResult:
    """Drive rewards through the closed loop, beside baselines on the same cases.

    Args:
      weights: file, or files, a row each.
      suite: "smoke" (a case of each family), "full", or families with commas.
      cases: of each family; None: as declared.
      duration_s: s of a case; None: 120, of "smoke" 20.
      baselines: baseline rows; none are driven for ().
      plan_every: steps of 0.1 s between two plans.
      output: folder for table.txt, suite.json and cases.csv; None: nothing is written.
      executor: where cases are driven, of `rcirl_jax.runtime.executors`; None: here.

    Returns:
      The drives: `report` has rates with exact intervals by row, `runs` every metric of
      every case. `format_report` makes a table of it.

    Raises:
      InputError: files that cannot be read, or a suite, family or row that is unknown.

    Examples:
        >>> result = rcirl_jax.simulate(
        ...     "weights.msgpack", suite="stopped_lead", cases=2, duration_s=2.0,
        ...     baselines=(),
        ... )
        >>> result.cases.ids
        ('stopped_lead/000@0', 'stopped_lead/001@0')
    """
    job = SuiteJob(
        weights=tuple(_files(weights)),
        baselines=tuple(baselines),
        refs=suite_refs(suite, cases),
        duration_s=case_duration(suite, duration_s),
        plan_every=plan_every,
    )
    made_by = _made_by(job)
    result = run_job(job, executor or Serial())
    if output is not None:
        write_suite(result, Path(output), made_by)
    return result


def gate(
    candidate: Place,
    incumbent: Place = "hand-set",
    *,
    data: Place | Dataset | Sequence[Place | Dataset] = (),
    suite: str = "full",
    cases: int | None = None,
    duration_s: float | None = None,
    drives: int = DRIVES,
    margins: GateConfig | None = None,
    output: Place | None = None,
    executor: Executor | None = None,
) -> Verdict:
    """Judge whether a candidate may replace the incumbent.

    Both drive the same cases; no learned reward judges (docs/gate.md).

    Args:
      candidate: weights file, "FILE.py:FUNCTION" or "FILE.so" of an own cost, or
        "planner:COMMAND" of a program.
      incumbent: one of these, or a baseline's name.
      data: datasets whose held-out drives measure its distance to people; without
        any that is not measured, and nothing ships.
      suite: as `simulate`; nothing ships on a part of "full".
      cases: as `simulate`.
      duration_s: as `simulate`.
      drives: held-out drives in all.
      margins: what counts as a loss; None: those of docs/gate.md.
      output: JSON to write; None: nothing is written.
      executor: as `simulate`.

    Returns:
      The verdict: `decision` is "ship", "do not ship", "no difference" or "could not
      judge"; `sentence`, `reasons` and `look_at` (ids of cases) say why.

    Raises:
      InputError: files that cannot be read, or fewer than 30 cases.

    Examples:
        >>> verdict = rcirl_jax.gate(
        ...     "weights.msgpack", "constant V", suite="stopped_lead", cases=30,
        ...     duration_s=2.0,
        ... )
        >>> verdict.decision == "ship"  # on a part of the suite
        False
    """
    config = margins or GateConfig()
    job, row = gate_job(
        os.fspath(candidate),
        os.fspath(incumbent),
        suite=suite,
        cases=cases,
        duration_s=duration_s,
        catalogue_seed=0,
        plan_every=1,
        baselines=gate_baselines(os.fspath(candidate), config),
    )
    sources = [
        one if isinstance(one, Dataset) else open_dataset(one) for one in _each(data)
    ]
    found = judged(job, row, config, executor or Serial(), sources, drives)
    if output is not None:
        files = {"candidate": os.fspath(candidate), "incumbent": os.fspath(incumbent)}
        facts = {"files": files, **found.facts, "made_by": _made_by(job)}
        write_verdict(Path(output), found.verdict, config, facts)
    return found.verdict


def format_report(found: RankingReport | SuiteResult | Verdict) -> str:
    """Make a table to be printed of what `rank`, `simulate` or `gate` found.

    Examples:
        >>> report = rcirl_jax.rank("weights.msgpack", "data")
        >>> table = rcirl_jax.format_report(report)
        >>> "hand-set" in table, "oracle" in table
        (True, True)
    """
    if isinstance(found, Verdict):
        return format_verdict(found)
    if isinstance(found, SuiteResult):
        return format_suite(found.report)
    return format_table(found)


def _files(weights: Place | Sequence[Place]) -> list[str]:
    return [os.fspath(one) for one in _each(weights)]


def _each(given: object) -> list:
    """Returns a list; wraps a single value."""
    return list(given) if isinstance(given, list | tuple) else [given]


def _made_by(job: SuiteJob) -> dict:
    """Provenance of a suite, with the hashes of its rewards."""
    hashes = {file: open_reward(file).sha256 for file in job.weights}
    return {**provenance(), "weights_sha256": hashes}


def tune(
    data: Place | Sequence[Place],
    workdir: Place,
    *,
    recipe: str = DEFAULT,
    incumbent: Place = "hand-set",
    suite: str = "full",
    cases: int | None = None,
    duration_s: float | None = None,
    drives: int = DRIVES,
    executor: Executor | None = None,
    **settings: Any,  # noqa: ANN401
) -> Verdict:
    """Go through the whole loop: train, export, rank, drive, judge and report.

    The weights are WORKDIR/weights.msgpack, the page to open is WORKDIR/report.html.
    What is done is kept when it is called again. This is `rcirl autotune`.

    Args:
      data: folder of a dataset, or folders of several.
      workdir: folder of the run.
      recipe: as `train_reward`.
      incumbent: what drives today: a weights file, a baseline's name, or
        "FILE.py:FUNCTION" or "FILE.so" of an own cost.
      suite: cases of the closed loop: "full", "smoke", or families with commas.
      cases: of each family; None: as declared.
      duration_s: s of a case; None: 120, of "smoke" 20.
      drives: held-out recorded drives that measure its distance to people.
      executor: where pieces of work run, of `rcirl_jax.runtime.executors`; None: here.
      **settings: as `train_reward`.

    Returns:
      The verdict: `decision` is "ship", "do not ship", "no difference" or "could not
      judge", `sentence` says why.

    Raises:
      InputError: a setting that cannot be, or bad data.
      Interrupted: the process was told to end; what is done stays.
    """
    chosen = load_recipe(recipe)
    folders = folders_of(data) or []
    config = TuneConfig(
        train=training_of(recipe, 0, settings),
        gate=GateConfig(),
        incumbent=os.fspath(incumbent),
        simulated=chosen.simulated,
        gain=chosen.gain,
        recipe=chosen.name,
        seeds=chosen.seeds,
        drives=drives,
        suite=suite,
        cases=cases,
        duration_s=duration_s,
    )
    flags = {"data": folders, "recipe": recipe, "incumbent": config.incumbent}
    run = Run(
        folder=Path(workdir),
        config=config,
        executor=executor or Serial(),
        running=Running(),
        facts={"flags": {**flags, **settings}, **provenance()},
    )
    with only_one(run.folder):
        run_stages(run, folders)
    return verdict_of(run)
