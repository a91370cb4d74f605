"""The work of the stages from training to the report; `loop` has their order.

Baselines are tuned on the training scenes of the rewards; held-out scenes and drives,
the closed loop's cases and the margins are those of `evaluation`.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np

from rcirl_jax.data.store.dataset import Dataset, Demonstrations
from rcirl_jax.evaluation.baselines import TERMS_ROW, search_own_terms, tune_idm
from rcirl_jax.evaluation.closed_loop import dial
from rcirl_jax.evaluation.closed_loop.decided import decided
from rcirl_jax.evaluation.closed_loop.likeness import (
    held_out_likeness,
    read_arrays,
    write_arrays,
)
from rcirl_jax.evaluation.closed_loop.runs import read_runs, write_runs
from rcirl_jax.evaluation.closed_loop.suite import (
    SHORT_S,
    SuiteConfig,
    write_suite,
)
from rcirl_jax.evaluation.gate.types import CANDIDATE, INCUMBENT, Pair, Verdict
from rcirl_jax.evaluation.gate.verdict import judge, write_verdict
from rcirl_jax.evaluation.gate.words import format_verdict
from rcirl_jax.evaluation.ranking.evaluate import RankingSetup, evaluate_ranking
from rcirl_jax.evaluation.ranking.report import format_table, from_json, to_json
from rcirl_jax.export.closed_loop import (
    SuiteJob,
    drive_by,
    drive_job,
    gate_job,
    left_out,
    read_tuned_idm,
    suite_facts,
    write_own_terms,
    write_tuned_idm,
)
from rcirl_jax.export.forms import terms_yaml
from rcirl_jax.export.from_run import export_run
from rcirl_jax.export.loading import open_reward, scorer_of
from rcirl_jax.export.sweep import SWEEP, read_sweep
from rcirl_jax.export.weights import save_with_dial
from rcirl_jax.features import feature_map
from rcirl_jax.planner.baselines import TUNED_IDM_ROW
from rcirl_jax.planner.mobil import MOBIL_ROW
from rcirl_jax.report.replays import Replay, make_replays
from rcirl_jax.runtime.atomic_files import read_json, write_json, write_whole
from rcirl_jax.runtime.pipeline import digest, file_sha256
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.simulation.recorded import DATASET, held_out
from rcirl_jax.simulation.rows import TRIVIAL_BASELINES
from rcirl_jax.simulation.suite import recorded_set
from rcirl_jax.train.loop import train
from rcirl_jax.train.metrics import pairs_won
from rcirl_jax.train.state import FUTURES
from rcirl_jax.tuning.prior_cost import (
    OWN_COST,
    make_prior_cost,
    on_own_cost,
    prior_cost_file,
    read_prior_cost,
)
from rcirl_jax.tuning.run import Run
from rcirl_jax.units import HORIZON_S

BASELINES = ("hand-set", "IDM", "random weights", *TRIVIAL_BASELINES)
IDM_EVALUATIONS = 300  # of the search for the tuned IDM
REPLAYS = 6  # cases to play in the report
RECORDED = 2  # held-out drives to play, of all sources


# Training


def train_seeds(run: Run, dataset: Demonstrations, sources: Sequence[Dataset]) -> None:
    """Trains every seed, exports it; the median one becomes the candidate.

    That is the seed with the median share of training pairs won.

    Args:
      run: folder and settings.
      dataset: what there is to learn from.
      sources: of it, what was recorded.
    """
    files = run.seed_files
    make_prior_cost(run, sources)
    prior = prior_cost_file(run)
    run = on_own_cost(run, sources)
    for number, file in enumerate(files):
        train_one(run, f"train {number}", dataset, number, file, prior)
    steps = -(-dataset.indices("train").size // run.config.train.batch_size)

    def won(number: int) -> float:
        return pairs_won(_workdir(run, dataset, number) / "metrics.jsonl", steps)

    def choose() -> None:
        ranked = sorted(range(run.config.seeds), key=won)
        median = files[ranked[(len(ranked) - 1) // 2]]
        write_whole(run.weights, median.read_bytes())
        if run.config.train.reward.today:
            write_whole(run.terms, terms_yaml(open_reward(str(run.weights))))

    hashes = [file_sha256(file) for file in files]
    made = [run.weights, *([run.terms] if run.config.train.reward.today else [])]
    run.stage("export", {"seeds": hashes}, made, choose)


def train_one(
    run: Run,
    stage: str,
    dataset: Demonstrations,
    seed: int,
    file: Path,
    prior: Path | None,
) -> None:
    """Does one training as a stage, exported to a weights file.

    Args:
      run: folder and settings.
      stage: its name.
      dataset: what there is to learn from.
      seed: of the training.
      file: weights to write.
      prior: of its prior cost, if it has one.
    """
    inputs = {**_decides_training(run, dataset), "seed": seed}
    if prior:
        inputs["prior_cost"] = file_sha256(prior)

    def work() -> None:
        config = dataclasses.replace(run.config.train, seed=seed)
        workdir, facts = _workdir(run, dataset, seed), dict(run.facts)
        train(dataset, workdir, config, running=run.running, provenance=facts)
        file.parent.mkdir(parents=True, exist_ok=True)
        known = read_prior_cost(prior) if prior else None
        export_run(workdir, dataset, file, prior_cost=known, own=run.own_cost)

    run.stage(stage, inputs, [file], work)


def _decides_training(run: Run, dataset: Demonstrations) -> dict:
    """Returns what decides a training, but its seed and prior cost."""
    settings = dataclasses.asdict(run.config.train)
    return {"config": settings, "dataset": dataset.hash, **run.code()}


def _workdir(run: Run, dataset: Demonstrations, seed: int) -> Path:
    """Returns the folder of a training run."""
    return _folder_of(run, _decides_training(run, dataset), seed)


def training_of_candidate(run: Run) -> Path:
    """Returns the folder of the candidate's training run, by the notes of its stage."""
    seed = int(open_reward(str(run.weights)).provenance["seed"])
    noted = run.stages.read().get(f"train {seed}", {}).get("inputs", {})
    decided = {name: noted.get(name) for name in ("config", "dataset", *run.code())}
    return _folder_of(run, decided, seed)


def warnings_of(run: Run) -> dict[str, list[str]]:
    """Returns why numbers of a run may be worth nothing, by the report's sections.

    What the training, the rankings and a sweep have written; a file that is not there
    says nothing.
    """
    rankings = [run.folder / f"{stem}.json" for stem in ("ranking", "ranking_recorded")]
    files = {
        "training": [training_of_candidate(run) / "run.json"],
        "ranking": rankings,
        "sweep": [run.config.sweep / SWEEP] if run.config.sweep else [],
    }
    found = {
        section: [
            said + (" (with recorded futures)" if file == rankings[1] else "")
            for file in some
            if file.is_file()
            for said in read_json(file, "JSON").get("warnings", ())
        ]
        for section, some in files.items()
    }
    return {section: said for section, said in found.items() if said}


def _folder_of(run: Run, decided: Mapping[str, object], seed: int) -> Path:
    return run.folder / f"train-{digest(decided)[:8]}" / f"seed-{seed}"


# Ranking of held-out scenes


def rank(run: Run, dataset: Demonstrations) -> None:
    """Ranks held-out scenes in both forms, all seeds beside incumbent and baselines.

    The strongest simple baseline, an IDM, is tuned on the training scenes first.
    """
    config, path = run.config, run.tuned_idm
    evaluations, search = IDM_EVALUATIONS, config.search
    inputs = {
        "dataset": dataset.hash,
        "evaluations": evaluations,
        "search": search,
        **run.candidates,
    }

    def work() -> None:
        setup = RankingSetup(horizon_s=config.horizon_s, sampler=_ranked_sampler(run))
        write_tuned_idm(path, tune_idm(dataset, setup, evaluations, search))

    run.stage("tune", inputs, [path], work)
    if config.train.reward.today:
        _search_terms(run, dataset, inputs)
    for futures in FUTURES:
        _rank(run, dataset, futures)


def _search_terms(run: Run, dataset: Demonstrations, inputs: Mapping) -> None:
    """Searches weights of own terms, with at least the queries of a training."""
    config, train = run.config, run.config.train
    own = feature_map(train.features).own
    assert own is not None

    def work() -> None:
        setup = RankingSetup(horizon_s=config.horizon_s, sampler=_ranked_sampler(run))
        epochs, search = train.epochs, config.search
        found = search_own_terms(own, dataset, setup, epochs, IDM_EVALUATIONS, search)
        reward = dataclasses.replace(train.reward, today=found)
        write_own_terms(run.searched, dataclasses.replace(train, reward=reward))

    facts = {**inputs, "terms": own.sha256, "epochs": train.epochs}
    run.stage("tune terms", facts, [run.searched], work)


def _ranked_sampler(run: Run) -> SamplerConfig:
    """Returns the usual grid, whatever the training's, or the user's own candidates."""
    trained = run.config.train.sampler
    return trained.on_own(SamplerConfig(mode=trained.mode))


def _rank(run: Run, dataset: Demonstrations, futures: str) -> None:
    """Ranks held-out scenes with the others' `futures` (one of `FUTURES`)."""
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
    searched = run.searched if config.train.reward.today else None
    if searched:
        inputs["searched"] = file_sha256(searched)

    def work() -> None:
        rewards = [open_reward(str(file)) for file in run.seed_files]
        learned = {CANDIDATE: [scorer_of(reward) for reward in rewards]}
        known = run.incumbent_reward()
        if known is not None:
            learned[INCUMBENT] = [scorer_of(known)]
        if searched:
            learned[TERMS_ROW] = [scorer_of(open_reward(str(searched)))]
        setup = RankingSetup(
            preset=str(rewards[0].preset),
            sampler=_ranked_sampler(run),
            horizon_s=config.horizon_s,
            futures=futures,
            tuned={TUNED_IDM_ROW: [tuned]},
            own=run.own_cost,
        )
        own = [run.own_cost.name] if run.own_cost else []
        own += [INCUMBENT] if known else []
        own += [TERMS_ROW] if searched else []
        references = [*own, "hand-set", TUNED_IDM_ROW, "random"]
        report = evaluate_ranking(dataset, learned, setup, run.executor, references)
        write_whole(text, format_table(report, 118) + "\n")
        made_by = {**run.provenance(), "data_hash": dataset.hash}
        write_json(path, {**to_json(report), "made_by": made_by})

    run.stage(f"rank {futures}", inputs, [path, text], work)


# Closed loop


def suite_job(run: Run, *, tuned: bool = True) -> tuple[SuiteJob, str]:
    """Returns the job of the suite, and the name of the incumbent's row.

    Args:
      run: folder and settings.
      tuned: with what a search has tuned, the IDM and own terms, once it has.
    """
    config = run.config
    searched = bool(config.train.reward.today)
    return gate_job(
        str(run.weights),
        config.incumbent,
        suite=config.suite,
        cases=config.cases,
        duration_s=config.duration_s,
        catalogue_seed=config.catalogue_seed,
        plan_every=config.plan_every,
        baselines=(*BASELINES, *([MOBIL_ROW] if run.steers else [])),
        tuned_idm=read_tuned_idm(run.tuned_idm) if tuned else None,
        beside={TERMS_ROW: str(run.searched)} if tuned and searched else None,
    )


def simulate(run: Run, sources: Sequence[Dataset]) -> None:
    """Drives candidate, incumbent and baselines: the suite, and held-out drives.

    The held-out drives, of all sources, measure every row's distance to the human.
    """
    job, incumbent = suite_job(run)
    decides = {
        **dataclasses.asdict(job),
        "planners": job.planner_facts(),
        "refs": digest([ref.id for ref in job.refs]),
        "weights": [file_sha256(Path(file)) for file in job.weights],
    }
    folder = run.folder / "suite"

    def drive() -> None:
        result = drive_job(job, run.executor)
        write_suite(result, folder, run.provenance())
        write_runs(folder / "metrics.npz", result)

    names = ("metrics.npz", "suite.json", "cases.csv", "table.txt")
    run.stage("simulate", {"job": decides}, [folder / name for name in names], drive)

    arrays, body, text = (
        run.folder / f"likeness.{kind}" for kind in ("npz", "json", "txt")
    )

    def compare() -> None:
        drives = held_out(sources, run.config.drives)
        found = held_out_likeness(drives, job.rows(), job.plan_every, incumbent)
        write_arrays(arrays, found.likeness)
        write_json(body, {**found.facts, "made_by": run.provenance()})
        write_whole(text, found.text())

    inputs = {
        "datasets": [source.hash for source in sources],
        "drives": run.config.drives,
        "job": decides,
    }
    run.stage("likeness", inputs, [arrays, body, text], compare)


def compare_choices(run: Run, sources: Sequence[Dataset]) -> None:
    """Says how often the candidate plans otherwise than its own cost would.

    Along its drives of the dial's cases and of the held-out recordings (`decided`). The
    own cost is the prior cost, else the user's, today's weights of own terms, or the
    hand-set one.

    Args:
      run: folder and settings.
      sources: what was recorded.
    """
    job, _ = suite_job(run)
    prior = open_reward(str(run.weights)).prior_cost
    name = INCUMBENT if run.config.train.reward.today else OWN_COST
    if run.own_cost:
        name = run.own_cost.name
    if prior:
        name = prior.incumbent
    job = dataclasses.replace(job, refs=tuple(job.refs[i] for i in dial_plan(job)[1]))
    inputs = {
        "weights": file_sha256(run.weights),
        "own_cost": name,
        "planners": job.planner_facts(),
        "cases": [ref.id for ref in job.refs],
        "duration_s": job.duration_s,
        "plan_every": job.plan_every,
        "datasets": [source.hash for source in sources],
        "drives": run.config.drives,
    }

    def work() -> None:
        rows = {row.name: row for row in job.rows()}
        pair, cases = (rows[CANDIDATE], rows[name]), job.cases()
        drives, total = held_out(sources, run.config.drives), len(job.refs)
        sites = [site_of(source, i) for i, source in enumerate(sources)]
        found = {
            "families": decided(
                *pair,
                cases.build(0, total),
                cases.groups,
                np.arange(total),
                job.duration_s,
                job.plan_every,
            ),
            "sites": decided(
                *pair,
                drives.cases,
                [sites[number // DATASET] for number in drives.vehicle.tolist()],
                drives.vehicle,
                HORIZON_S,
                job.plan_every,
            ),
        }
        write_json(
            run.decided, {"own_cost": name, **found, "made_by": run.provenance()}
        )

    run.stage("decided", inputs, [run.decided], work)


def site_of(dataset: Dataset, number: int) -> str:
    """Names a source by its recordings: "0: us101-1 to us101-2"."""
    first, *more = dataset.manifest.recordings
    return f"{number}: {first}" + (f" to {more[-1]}" if more else "")


def dial_plan(job: SuiteJob) -> tuple[tuple[float, ...], list[int]]:
    """Returns the settings of the dial that are compared, and on which cases."""
    short = len(job.refs) * job.duration_s <= SHORT_S
    settings = dial.FEW_SETTINGS if short else dial.SETTINGS
    most = dial.FEW_CASES if short else dial.CASES
    return settings, [i for i, ref in enumerate(job.refs) if ref.index < most]


def turn_dial(run: Run, sources: Sequence[Dataset]) -> None:
    """Compares how strongly the learned value counts, if there is an own cost.

    The first cases of each family and all held-out drives; settings 0 and 1, the own
    cost alone and the candidate, have driven them already.

    Args:
      run: folder and settings.
      sources: what was recorded.
    """
    job, _ = suite_job(run)
    prior = open_reward(str(run.weights)).prior_cost
    if prior is None or len(job.refs) < 2:
        return
    path, folder = run.dial, run.folder / "dials"
    settings, at = dial_plan(job)
    files = {x: folder / f"{x:g}.msgpack" for x in settings if x not in (0.0, 1.0)}
    known = read_arrays(run.folder / "likeness.npz")
    # the same cases, driven by weights files as rows of the suite are
    job = dataclasses.replace(
        job,
        weights=tuple(map(str, files.values())),
        names=tuple(f"dial {x:g}" for x in files),
        baselines=(),
        tuned_idm=None,
        refs=tuple(job.refs[i] for i in at),
    )
    inputs = {
        "weights": file_sha256(run.weights),
        "metrics": file_sha256(run.metrics),
        "likeness": file_sha256(run.folder / "likeness.npz"),
        "settings": list(settings),
        "cases": [ref.id for ref in job.refs],
    }

    def work() -> None:
        runs, ends = read_runs(run.metrics), {0.0: prior.incumbent, 1.0: CANDIDATE}
        for x, file in files.items():
            save_with_dial(run.weights, x, file)
        drive, cases = drive_by(run.executor, job), job.cases()
        config = SuiteConfig(plan_every=job.plan_every)
        drawn = dict(zip(files, job.rows(), strict=False))  # learned rows come first
        driven = {x: drive(row, cases, config) for x, row in drawn.items()}
        driven |= {
            x: jax.tree.map(lambda leaf: np.asarray(leaf)[at], runs.rows[name])
            for x, name in ends.items()
        }
        drives = held_out(sources, run.config.drives)
        apart = held_out_likeness(drives, [*drawn.values()], job.plan_every).distance
        distance = {x: apart[row.name] for x, row in drawn.items()}
        distance |= {x: known.distance[name] for x, name in ends.items()}
        found = dial.compare_settings(
            {x: driven[x] for x in settings},
            np.asarray(runs.groups)[at],
            runs.way[at],
            distance,
            known.clusters,
        )
        names = {**files, 1.0: run.weights}
        rows = [
            {
                "dial": x,
                "gain": x * prior.gain,
                "file": str(names[x].relative_to(run.folder)) if x in names else None,
                "measures": found[x],
            }
            for x in settings
        ]
        facts = {
            "own_cost": prior.incumbent,
            "cases": len(at),
            "families": len({runs.groups[i] for i in at}),
            "duration_s": job.duration_s,
            "drives": int(known.clusters.size),
            "vehicles": int(np.unique(known.clusters).size),
        }
        made_by = run.provenance()
        write_json(path, {**facts, "settings": rows, "made_by": made_by})

    run.stage("dial", inputs, [path, *files.values()], work)


# Verdict and report


def verdict_of(run: Run) -> Verdict:
    """Judges the finished simulation and held-out drives."""
    job, incumbent = suite_job(run)
    runs, known = read_runs(run.metrics), read_arrays(run.folder / "likeness.npz")
    pair = Pair(runs=runs, name=incumbent, likeness=known)
    return judge(pair, run.config.gate, left_out(job))


def gate(run: Run) -> Verdict:
    """Judges; writes the verdict, if there is none yet."""
    path = run.folder / "verdict.json"
    job, incumbent = suite_job(run)
    verdict = verdict_of(run)
    inputs = {
        "metrics": file_sha256(run.metrics),
        "likeness": file_sha256(run.folder / "likeness.npz"),
        "gate": dataclasses.asdict(run.config.gate),
        "incumbent": incumbent,
        "left_out": left_out(job),
        "warnings": warnings_of(run),
    }

    def work() -> None:
        files = {"candidate": str(run.weights), "incumbent": run.config.incumbent}
        runs = {"training_runs": run.config.seeds}
        facts = {"files": files, **runs, **suite_facts(job)}
        facts["warnings"] = warnings_of(run)
        facts["made_by"] = run.provenance()
        write_verdict(path, verdict, run.config.gate, facts)
        drives = (run.folder / "likeness.txt").read_text()
        write_whole(run.tables, f"{drives}\n{format_verdict(verdict)}\n")

    run.stage("gate", inputs, [path, run.tables], work)
    return verdict


def report(
    run: Run, verdict: Verdict, dataset: Demonstrations, sources: Sequence[Dataset]
) -> None:
    """Draws report.html from everything before it."""
    config, ranking = run.config, run.folder / "ranking.json"
    made_from = (ranking, run.metrics, run.folder / "verdict.json")
    inputs = {
        "files": [file_sha256(file) for file in made_from],
        "weights": file_sha256(run.weights),
        "incumbent": run.incumbent_hash(),
        "dataset": dataset.hash,
        "recipe": config.recipe,
        "warnings": warnings_of(run),
    }
    for name, file in {"dial": run.dial, "decided": run.decided}.items():
        if file.exists():
            inputs[name] = file_sha256(file)
    if config.sweep:
        inputs["sweep"] = file_sha256(config.sweep / SWEEP)

    def work() -> None:
        # of the extra [report], without which all before it can be done
        from rcirl_jax.report.tuning_page import TuningReport, write_tuning_page

        rewards = {CANDIDATE: open_reward(str(run.weights))}
        if known := run.incumbent_reward():
            rewards[INCUMBENT] = known
        stages = run.stages.read()
        names = (
            *(f"import {number}" for number in range(len(sources))),
            *(f"train {number}" for number in range(config.seeds)),
            "export",
            *(f"rank {futures}" for futures in FUTURES),
            *("simulate", "likeness", "gate", "dial", "decided"),
        )
        shown = {  # without `made_by`, which the page says once
            name: {key: x for key, x in stages[name].items() if key != "made_by"}
            for name in names
            if name in stages
        }
        write_tuning_page(
            run.page,
            TuningReport(
                verdict=verdict,
                gate=config.gate,
                suite=read_runs(run.metrics),
                incumbent=suite_job(run)[1],
                ranking=from_json(read_json(ranking, "a ranking")),
                rewards=rewards,
                dataset=dataset,
                replays=_replays(run, verdict, sources),
                workdir=training_of_candidate(run),
                sweep=read_sweep(config.sweep) if config.sweep else None,
                dial=read_json(run.dial, "a dial") if run.dial.exists() else None,
                decided=(
                    read_json(run.decided, "shares of plans")
                    if run.decided.exists()
                    else None
                ),
                likeness=(run.folder / "likeness.txt").read_text(),
                training_runs=config.seeds,
                warnings=warnings_of(run),
                facts={
                    "recipe": config.recipe,
                    "mode": config.train.sampler.mode,
                    **run.facts,
                    "stages": shown,
                },
            ),
        )

    run.stage("report", inputs, [run.page], work)


def _replays(run: Run, verdict: Verdict, sources: Sequence[Dataset]) -> list[Replay]:
    """Replays cases worth a look, then a few held-out drives beside the human."""
    job, incumbent = suite_job(run)
    drivers = [row for row in job.rows() if row.name in (CANDIDATE, incumbent)]
    shown = verdict.look_at[:REPLAYS] or job.cases().ids[:2]
    every, recorded = run.config.plan_every, recorded_set(held_out(sources, RECORDED))
    return [
        *make_replays(drivers, job.cases(), shown, every),
        *make_replays(drivers, recorded, recorded.ids, every),
    ]
