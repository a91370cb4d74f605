"""The page of a run: the stage report."""

import functools
from collections.abc import Callable, Sequence

from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.evaluation.gate.runs import CANDIDATE, INCUMBENT
from rcirl_jax.evaluation.gate.types import Verdict
from rcirl_jax.evaluation.ranking.table import from_json
from rcirl_jax.export.loading import open_reward
from rcirl_jax.export.sweep.folder import SWEEP
from rcirl_jax.export.sweep.result import read_sweep
from rcirl_jax.report.replays import Replay, make_replays
from rcirl_jax.runtime.atomic_files import read_json
from rcirl_jax.runtime.pipeline import file_sha256
from rcirl_jax.simulation.recorded.scenes import held_out
from rcirl_jax.simulation.suite import recorded_set
from rcirl_jax.train.state import FUTURES
from rcirl_jax.tune.evidence import suite_job, suite_runs
from rcirl_jax.tune.rewards import kept_workdir
from rcirl_jax.tune.run import Run

REPLAYS = 6  # cases to play in the report
RECORDED = 2  # held-out drives, of all sources


def report(
    run: Run,
    verdict: Callable[[], Verdict],
    dataset: Demonstrations,
    sources: Sequence[Dataset],
) -> None:
    """report.html from everything before it."""
    made_from = ("ranking.json", "suite/metrics.npz", "verdict.json")
    inputs = {
        "files": [file_sha256(run.folder / name) for name in made_from],
        "weights": file_sha256(run.weights),
        "incumbent": run.incumbent_hash(),
        "dataset": dataset.hash,
        "recipe": run.config.recipe,
    }
    if run.config.sweep:
        inputs["sweep"] = file_sha256(run.config.sweep / SWEEP)
    draw = functools.partial(_draw, run, verdict, dataset, sources)
    run.stage("report", inputs, [run.page], draw)


def _draw(
    run: Run,
    verdict: Callable[[], Verdict],
    dataset: Demonstrations,
    sources: Sequence[Dataset],
) -> None:
    # of the extra [report], without which all before it can be done
    from rcirl_jax.report.tuning_page import TuningReport, write_tuning_page

    _, incumbent = suite_job(run)
    judged = verdict()
    rewards = {CANDIDATE: open_reward(str(run.weights))}
    if known := run.incumbent_reward():
        rewards[INCUMBENT] = known
    sweep = run.config.sweep
    seed = int(rewards[CANDIDATE].provenance["seed"])
    facts = {"recipe": run.config.recipe, **run.facts}
    write_tuning_page(
        run.page,
        TuningReport(
            verdict=judged,
            gate=run.config.gate,
            suite=suite_runs(run),
            incumbent=incumbent,
            ranking=from_json(read_json(run.folder / "ranking.json", "a ranking")),
            rewards=rewards,
            dataset=dataset,
            replays=_replays(run, judged, sources),
            workdir=kept_workdir(run, seed),
            sweep=read_sweep(sweep) if sweep else None,
            likeness=(run.folder / "likeness.txt").read_text(),
            training_runs=run.config.seeds,
            facts={**facts, "stages": _stages(run, len(sources))},
        ),
    )


def _stages(run: Run, sources: int) -> dict:
    """The stages' records, but by what: the page says it once, stages.json of each."""
    imports = [f"import {number}" for number in range(sources)]
    trained = [f"train {number}" for number in range(run.config.seeds)]
    ranks = [f"rank {futures}" for futures in FUTURES]
    after = ["export", *ranks, "simulate", "likeness", "gate"]
    known = run.stages.read()
    return {
        name: {key: x for key, x in known[name].items() if key != "made_by"}
        for name in [*imports, *trained, *after]
        if name in known
    }


def _replays(run: Run, verdict: Verdict, sources: Sequence[Dataset]) -> list[Replay]:
    """Cases worth a look, then a few held-out drives beside the human."""
    job, incumbent = suite_job(run)
    drivers = [row for row in job.rows() if row.name in (CANDIDATE, incumbent)]
    shown = verdict.look_at[:REPLAYS] or job.cases().ids[:2]
    every, recorded = run.config.plan_every, recorded_set(held_out(sources, RECORDED))
    return [
        *make_replays(drivers, job.cases(), shown, every),
        *make_replays(drivers, recorded, recorded.ids, every),
    ]
