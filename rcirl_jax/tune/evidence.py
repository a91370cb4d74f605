"""Evidence about the candidate: the stages rank, simulate and gate.

Baselines are tuned on the same training scenes; held-out scenes and drives, the closed
loop's cases and the margins are those of `evaluation`.
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.evaluation.baselines.tuned import tune_idm
from rcirl_jax.evaluation.closed_loop.files import (
    SuiteRuns,
    read_runs,
    runs_of,
    write_runs,
)
from rcirl_jax.evaluation.closed_loop.likeness import (
    held_out_likeness,
    read_arrays,
    write_arrays,
)
from rcirl_jax.evaluation.closed_loop.suite import write_suite
from rcirl_jax.evaluation.gate.decision import judge
from rcirl_jax.evaluation.gate.output import format_verdict, write_verdict
from rcirl_jax.evaluation.gate.runs import CANDIDATE, INCUMBENT, pair_of
from rcirl_jax.evaluation.gate.types import Verdict
from rcirl_jax.evaluation.ranking.evaluate import RankingSetup, evaluate_ranking
from rcirl_jax.evaluation.ranking.format import format_table
from rcirl_jax.evaluation.ranking.table import to_json
from rcirl_jax.export.gate_job import drive_job, gate_job, left_out
from rcirl_jax.export.loading import open_reward, scorer_of
from rcirl_jax.export.spread import SuiteJob
from rcirl_jax.export.tuned_idm import read_tuned_idm, write_tuned_idm
from rcirl_jax.planner.baselines import TUNED_IDM_ROW
from rcirl_jax.runtime.atomic_files import write_json, write_whole
from rcirl_jax.runtime.pipeline import digest, file_sha256
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.simulation.recorded.scenes import held_out
from rcirl_jax.simulation.rows import TRIVIAL_BASELINES
from rcirl_jax.train.state import FUTURES
from rcirl_jax.tune.run import Run

BASELINES = ("hand-set", "IDM", "random weights", *TRIVIAL_BASELINES)
IDM_EVALUATIONS = 300  # of the search for the tuned IDM


def rank(run: Run, dataset: Demonstrations) -> None:
    """Held-out scenes in both forms, all seeds beside incumbent and baselines."""
    _tune_idm(run, dataset)
    for futures in FUTURES:
        _rank(run, dataset, futures)


def _tune_idm(run: Run, dataset: Demonstrations) -> None:
    """The IDM tuned on the same training scenes, the strongest simple baseline."""
    path = run.tuned_idm
    setup = RankingSetup(horizon_s=run.config.horizon_s)
    search = run.config.search
    inputs = {
        "dataset": dataset.hash,
        "evaluations": IDM_EVALUATIONS,
        "search": search,
    }

    def work() -> None:
        write_tuned_idm(path, tune_idm(dataset, setup, IDM_EVALUATIONS, search))

    run.stage("tune", inputs, [path], work)


def _rank(run: Run, dataset: Demonstrations, futures: str) -> None:
    """Held-out scenes with the others' `futures` (one of `FUTURES`)."""
    config, tuned = run.config, read_tuned_idm(run.tuned_idm)
    stem = "ranking" if futures == "predicted" else f"ranking_{futures}"
    path, text = run.folder / f"{stem}.json", run.folder / f"{stem}.txt"
    inputs = {
        "dataset": dataset.hash,
        "seeds": [file_sha256(file) for file in run.seed_files],
        "incumbent": run.incumbent_hash(),
        "horizon_s": config.horizon_s,
        "futures": futures,
        "tuned_idm": dataclasses.asdict(tuned),
    }

    def work() -> None:
        rewards = [open_reward(str(file)) for file in run.seed_files]
        learned = {CANDIDATE: [scorer_of(reward) for reward in rewards]}
        known = run.incumbent_reward()
        if known is not None:
            learned[INCUMBENT] = [scorer_of(known)]
        setup = RankingSetup(
            preset=str(rewards[0].preset),
            sampler=SamplerConfig(mode=config.train.sampler.mode),
            horizon_s=config.horizon_s,
            futures=futures,
            tuned={TUNED_IDM_ROW: [tuned]},
        )
        own = [INCUMBENT] if known else []
        references = [*own, "hand-set", TUNED_IDM_ROW, "random"]
        report = evaluate_ranking(dataset, learned, setup, run.executor, references)
        write_whole(text, format_table(report, 118) + "\n")
        made_by = {**run.provenance(), "data_hash": dataset.hash}
        write_json(path, {**to_json(report), "made_by": made_by})

    run.stage(f"rank {futures}", inputs, [path, text], work)


def suite_job(run: Run, *, tuned: bool = True) -> tuple[SuiteJob, str]:
    """What the suite drives, and the incumbent's row.

    Without the tuned IDM (`tuned` false) before there is one.
    """
    config = run.config
    return gate_job(
        str(run.weights),
        config.incumbent,
        suite=config.suite,
        cases=config.cases,
        duration_s=config.duration_s,
        catalogue_seed=config.catalogue_seed,
        plan_every=config.plan_every,
        baselines=BASELINES,
        tuned_idm=read_tuned_idm(run.tuned_idm) if tuned else None,
    )


def _inputs(job: SuiteJob) -> dict:
    """What decides a suite."""
    return {
        **dataclasses.asdict(job),
        "refs": digest([ref.id for ref in job.refs]),
        "weights": [file_sha256(Path(file)) for file in job.weights],
    }


def simulate(run: Run) -> None:
    """Candidate, incumbent and baselines on the same closed-loop cases."""
    job, _ = suite_job(run)
    folder = run.folder / "suite"

    def work() -> None:
        result = drive_job(job, run.executor)
        write_suite(result, folder, run.provenance())
        write_runs(folder / "metrics.npz", runs_of(result))

    names = ("metrics.npz", "suite.json", "cases.csv", "table.txt")
    outputs = [folder / name for name in names]
    run.stage("simulate", {"job": _inputs(job)}, outputs, work)


def likeness(run: Run, sources: Sequence[Dataset]) -> None:
    """Distance of every row to the human over held-out drives of all sources."""
    job, _ = suite_job(run)
    paths = [run.folder / f"likeness.{kind}" for kind in ("npz", "json", "txt")]

    def work() -> None:
        drives = held_out(sources, run.config.drives)
        found = held_out_likeness(drives, job.rows(), job.plan_every)
        write_arrays(paths[0], found.likeness)
        body = {**found.as_dict(), "made_by": run.provenance()}
        write_json(paths[1], body)
        write_whole(paths[2], found.text())

    inputs = {
        "datasets": [source.hash for source in sources],
        "drives": run.config.drives,
        "job": _inputs(job),
    }
    run.stage("likeness", inputs, paths, work)


def suite_runs(run: Run) -> SuiteRuns:
    """The driven suite of the finished simulation."""
    return read_runs(run.folder / "suite" / "metrics.npz")


def verdict_of(run: Run) -> Verdict:
    """The gate's verdict on the finished simulation and held-out drives."""
    job, incumbent = suite_job(run)
    known = read_arrays(run.folder / "likeness.npz")
    gate = run.config.gate
    return judge(
        pair_of(suite_runs(run), incumbent, gate.trivial_baselines, known),
        gate,
        left_out(job),
    )


def gate(run: Run, verdict: Callable[[], Verdict]) -> None:
    """Write the verdict, computing it if there is none yet."""
    path = run.folder / "verdict.json"
    job, incumbent = suite_job(run)
    inputs = {
        "metrics": file_sha256(run.folder / "suite" / "metrics.npz"),
        "likeness": file_sha256(run.folder / "likeness.npz"),
        "gate": dataclasses.asdict(run.config.gate),
        "incumbent": incumbent,
        "left_out": left_out(job),
    }

    def work() -> None:
        files = {"candidate": str(run.weights), "incumbent": run.config.incumbent}
        runs = {"training_runs": run.config.seeds}
        facts = {"files": files, **runs, "made_by": run.provenance()}
        found = verdict()
        write_verdict(path, found, run.config.gate, facts)
        drives = (run.folder / "likeness.txt").read_text()
        write_whole(run.tables, f"{drives}\n{format_verdict(found)}\n")

    run.stage("gate", inputs, [path, run.tables], work)
