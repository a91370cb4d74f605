"""The tuning loop: data -> rewards -> ranking -> simulation -> verdict -> report.

RUN/dataset-KEY/       the import of each log, unless datasets are given
RUN/rehearsal-KEY/N/   the rehearsed catalogue: the teacher's drives, then each round's
RUN/rounds/N.msgpack   the reward that the teacher of round N takes over from
RUN/anchors/N.json     how far the recordings reach, against N sets of drives
RUN/train-KEY/seed-N/  training runs; KEY changes with what they are made from
RUN/seeds/N.msgpack    every seed's reward
RUN/weights.msgpack    the candidate: of the seeds the one with the median share of
                       training pairs won
RUN/tuned_idm.json     the driver model tuned on the training scenes, a rival
RUN/ranking.json       held-out scenes as the planner sees them, all seeds beside rivals
RUN/ranking_recorded.json   the same with recorded futures
RUN/likeness.json      held-out drives: how near to the human (and likeness.npz, .txt)
RUN/suite/             metrics.npz, suite.json, cases.csv, table.txt
RUN/verdict.json       of the gate
RUN/report.html        all of it to look at
RUN/stages.json        what made what (`stages`)
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rcirl_jax.autotune.anchoring import (
    Anchoring,
    fitted_anchor,
    read_anchor,
    write_anchor,
)
from rcirl_jax.autotune.rehearsal import Rehearsal, rehearse
from rcirl_jax.data.importers.files import listing
from rcirl_jax.data.importing import import_parts
from rcirl_jax.data.logs import Logs
from rcirl_jax.data.parts import parts_of
from rcirl_jax.data.store.dataset import Dataset, open_dataset
from rcirl_jax.data.store.joined import EQUAL, Demonstrations, JoinedDatasets, shares_of
from rcirl_jax.data.store.preferences import read_preferences
from rcirl_jax.errors import InputError
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
from rcirl_jax.evaluation.gate.types import GateConfig, Verdict
from rcirl_jax.evaluation.ranking.evaluate import RankingSetup, evaluate_ranking
from rcirl_jax.evaluation.ranking.format import format_table
from rcirl_jax.evaluation.ranking.table import from_json, to_json
from rcirl_jax.evaluation.rivals.tuned import tune_idm
from rcirl_jax.export.from_run import export_run
from rcirl_jax.export.gate_job import drive_job, gate_job, left_out
from rcirl_jax.export.loading import open_reward, scorer_of
from rcirl_jax.export.reader import Anchor, Reward
from rcirl_jax.export.spread import SuiteJob
from rcirl_jax.export.sweep import SWEEP, read_sweep
from rcirl_jax.export.tuned_idm import read_tuned_idm, write_tuned_idm
from rcirl_jax.features import feature_map
from rcirl_jax.planner.baselines import TUNED_IDM_ROW, Idm
from rcirl_jax.report.player.recorded_replays import recorded_replays
from rcirl_jax.report.player.replays import make_replays
from rcirl_jax.report.tuning.page import TuningReport, anchor_words, write_tuning_page
from rcirl_jax.runtime.atomic_files import read_json, write_json, write_whole
from rcirl_jax.runtime.executors import Executor
from rcirl_jax.runtime.pipeline import Stages, code_sha256, digest, file_sha256
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.simulation.recorded.scenes import held_out
from rcirl_jax.simulation.rows import BASELINES, NULLS
from rcirl_jax.train.loop import train
from rcirl_jax.train.metrics import pairs_won
from rcirl_jax.train.running import Running
from rcirl_jax.train.state import FUTURES, TrainConfig

STAGES = ("import", "rehearse", "train", "rank", "simulate", "gate", "report")
# what reads as permission to use weights that are no longer there
STALE = {
    **dict.fromkeys(("import", "rehearse", "train"), ("export", "gate", "report")),
    **dict.fromkeys(("export", "simulate", "likeness"), ("gate", "report")),
    **dict.fromkeys(("rank", "gate"), ("report",)),
}
NOTED = ("git_commit", "code_sha256", "versions", "flags")  # of every stage
RIVALS = ("hand-set", "IDM", "random weights", *NULLS)
IDM_EVALUATIONS = 300  # of the search for the tuned IDM
REPLAYS = 6  # cases to play in the report


@dataclasses.dataclass(frozen=True, kw_only=True)
class TuneConfig:
    """Everything that decides the outcome, besides the data."""

    train: TrainConfig
    gate: GateConfig
    preferences: Path | None = None  # whose hash `train.preferences` is
    incumbent: str = "hand-set"  # weights file or baseline
    rehearsal: Rehearsal = dataclasses.field(default_factory=Rehearsal)
    anchor: Anchoring = dataclasses.field(default_factory=Anchoring)
    data_weights: str = EQUAL  # of several sources, as `data.store.joined.shares_of`
    recipe: str = ""  # its name, for the report
    seeds: int = 1
    drives: int = 240  # held-out, for human-likeness
    horizon_s: float = 5.0
    suite: str = "full"
    cases: int | None = None  # per family
    duration_s: float | None = None
    catalogue_seed: int = 0
    plan_every: int = 1
    sweep: Path | None = None  # of `experiments.sweep`, shown in the report

    def __post_init__(self) -> None:
        """Reject what would fail only after the training."""
        if self.sweep is not None:
            read_sweep(self.sweep)
        if self.drives < 1:
            raise InputError(f"--drives: {self.drives}: expected at least 1")
        if self.seeds < 1:
            raise InputError(f"--seeds: {self.seeds}: expected at least 1")
        if self.train.sampler.mode != "speed":
            raise InputError(
                f"--mode: {self.train.sampler.mode}: the closed loop plans speed"
            )
        self.train.reward.check_own()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Loop:
    """One run folder with its settings."""

    folder: Path
    config: TuneConfig
    executor: Executor
    running: Running
    facts: Mapping[str, Any]  # provenance: commit, versions, flags
    say: Callable[[str], object] = print

    @property
    def stages(self) -> Stages:
        """What has been done."""
        return Stages(folder=self.folder)

    @property
    def weights(self) -> Path:
        """The candidate."""
        return self.folder / "weights.msgpack"

    def _run(
        self,
        name: str,
        inputs: Mapping[str, Any],
        outputs: list[Path],
        work: Callable[[], object],
    ) -> None:
        facts = {**inputs, **self._code()}
        kind = name.partition(" ")[0]
        stale = STALE.get(kind, ())
        made_by = {key: self.facts[key] for key in NOTED if key in self.facts}
        done = self.stages.run(name, facts, outputs, work, stale, made_by)
        self.say(f"[{name}] {'done' if done else 'as before, kept'}")

    def _code(self) -> dict:
        """What made a stage besides its inputs."""
        return {"code": code_sha256(), "versions": self.facts["versions"]}

    def until(self, last: str, given: Sequence[str | Logs]) -> None:
        """Run the stages in order, up to and with `last`; says what comes of it."""
        # what would fail only after hours of work
        self._job(tuned=False)
        shares = shares_of(self.config.data_weights, len(given))
        self._check_incumbent()
        sources = [self.data(one, number) for number, one in enumerate(given)]
        dataset = sources[0] if len(sources) == 1 else JoinedDatasets(sources, shares)
        everything: list[Demonstrations] = [dataset]
        steps: dict[str, Callable[[], object]] = {
            "import": lambda: None,
            "rehearse": lambda: everything.append(self.rehearse(sources, shares)),
            "train": lambda: self.train(everything[-1]),
            "rank": lambda: self.rank(dataset),
            "simulate": lambda: (self.simulate(), self.likeness(sources)),
            "gate": self.gate,
            "report": lambda: self.report(dataset, given),
        }
        for name in STAGES[: STAGES.index(last) + 1]:
            steps[name]()
        if last in ("gate", "report"):
            self.say((self.folder / "likeness.txt").read_text())
            self.say(format_verdict(self._verdict))
        if last not in ("import", "rehearse"):
            self.say(f"weights: {self.weights}")
            self.say(self._said_of_weights())
        if last == "report":
            self.say(f"report to open: {self.folder / 'report.html'}")

    # ---------------------------------------------------------------- the stages

    def _said_of_weights(self) -> str:
        """Features that the training never saw vary; gains, if anchored; one a line."""
        reward = open_reward(str(self.weights))
        silent = "features without effect, for they never vary in the training data: "
        silent += ", ".join(reward.unsupported) or "none"
        anchored = anchor_words(CANDIDATE, reward)
        return "\n".join(filter(None, (silent, anchored)))

    def data(self, given: str | Logs, number: int) -> Dataset:
        """Open a source's dataset, or import its logs."""
        if isinstance(given, str):
            return open_dataset(given)
        found = parts_of(given.format, given.input, given.source)
        inputs = {
            "config": dataclasses.asdict(given.config),
            "spec": digest(found[0].spec),
            "files": listing(given.input) if given.input else [],
            **({"signals": given.signals} if given.signals else {}),
        }
        key = digest({**inputs, **self._code()})[:8]
        folder = self.folder / f"dataset-{key}"

        def work() -> None:
            if (folder / "manifest.json").exists():
                return  # finished, but not noted: killed in between
            config = given.import_config(found, self.executor)
            import_parts(
                found,
                folder,
                config,
                executor=self.executor,
                before_commit=lambda dataset: dataset.write_facts(
                    {"data_hash": dataset.hash, "made_by": self.facts}
                ),
            )

        self._run(f"import {number}", inputs, [folder / "manifest.json"], work)
        return open_dataset(folder)

    def rehearse(
        self, sources: Sequence[Dataset], shares: Sequence[float] | None
    ) -> Demonstrations:
        """The sources and the rehearsed catalogue as one; each round trains first."""
        plan, made = self.config.rehearsal, [*sources]
        given = list(shares or [float(s.indices("train").size) for s in sources])
        # a recorded source has the weight 1, whatever the shares add up to
        scale = len(sources) / sum(given)
        given = [share * scale for share in given]
        joined: Demonstrations = _as_one(made, given)
        drives: list[Dataset] = []
        for number in range(plan.datasets):
            learner = None
            if number:
                learner = self.folder / "rounds" / f"{number}.msgpack"
                anchor = self._anchor(sources, given[: len(sources)], drives)
                self._train_round(joined, number, learner, anchor)
            drives.append(self._rehearsed(number, learner))
            if plan.weights[number] > 0.0:
                made.append(drives[-1])
                given.append(plan.weights[number])
                joined = _as_one(made, given)
        self._anchor(sources, given[: len(sources)], drives)
        return joined

    def _anchor(
        self,
        sources: Sequence[Dataset],
        shares: Sequence[float],
        drives: list[Dataset],
    ) -> Path | None:
        """How far the recordings reach beside the rehearsed drives; None: no anchor."""
        config, path = self.config, self._anchor_file(len(drives))
        if path is None:
            return None
        inputs = {
            "anchor": dataclasses.asdict(config.anchor),
            "recorded": [one.hash for one in sources],
            "shares": list(shares),
            "drives": [one.hash for one in drives],
            "features": config.train.features,
        }

        def work() -> None:
            features = feature_map(config.train.features)
            made = fitted_anchor(config.anchor, sources, shares, drives, features)
            write_anchor(path, made)

        self._run(f"anchor {len(drives)}", inputs, [path], work)
        return path

    def _anchor_file(self, drives: int) -> Path | None:
        """Where the anchor against so many sets of drives lies; None: there is none."""
        wanted = self.config.anchor.wanted
        return self.folder / "anchors" / f"{drives}.json" if wanted else None

    def _rehearsed(self, number: int, learner: Path | None) -> Dataset:
        plan, config = self.config.rehearsal, self.config
        inputs = {
            "rehearsal": dataclasses.asdict(plan),
            "number": number,
            "teacher": self._incumbent_hash() if plan.teacher == "incumbent" else "",
            "learner": file_sha256(learner) if learner else "",
        }
        key = digest({**inputs, **self._code()})[:8]
        folder = self.folder / f"rehearsal-{key}" / str(number)

        def work() -> None:
            if (folder / "manifest.json").exists():
                return  # finished, but not noted: killed in between
            rehearse(
                number,
                plan,
                folder,
                incumbent=config.incumbent,
                learner=learner,
                before_commit=lambda dataset: dataset.write_facts(
                    {"data_hash": dataset.hash, "made_by": self.facts}
                ),
            )

        self._run(f"rehearse {number}", inputs, [folder / "manifest.json"], work)
        return open_dataset(folder)

    def _train_round(
        self, dataset: Demonstrations, number: int, file: Path, path: Path | None
    ) -> None:
        """The learner of a round; `path` is of its anchor."""
        inputs = {**self._train_inputs(dataset), "seed": 0}
        anchor = None
        if path:
            anchor, inputs = read_anchor(path), {**inputs, "anchor": file_sha256(path)}
        work = lambda: self._train_one(dataset, 0, file, None, anchor)  # noqa: E731
        self._run(f"rehearse learner {number}", inputs, [file], work)

    def _train_one(
        self,
        dataset: Demonstrations,
        seed: int,
        file: Path,
        judged: Path | None,
        anchor: Anchor | None,
    ) -> None:
        """One training run, exported."""
        config = dataclasses.replace(self.config.train, seed=seed)
        if judged is None:
            config = dataclasses.replace(config, preferences="")
        workdir = self._workdir(dataset, seed)
        # people judged scenes of the first source, whose rows come first
        whose = dataset.parts[0] if isinstance(dataset, JoinedDatasets) else dataset
        train(
            dataset,
            workdir,
            config,
            running=self.running,
            provenance=dict(self.facts),
            preferences=read_preferences(judged, whose) if judged else None,
        )
        file.parent.mkdir(parents=True, exist_ok=True)
        export_run(workdir, dataset, file, anchor=anchor)

    def train(self, dataset: Demonstrations) -> None:
        """Train every seed, export it, choose the median one."""
        inputs, files = self._train_inputs(dataset), self._seed_files()
        judged, anchor = self.config.preferences, None
        if path := self._anchor_file(self.config.rehearsal.datasets):
            anchor, inputs = read_anchor(path), {**inputs, "anchor": file_sha256(path)}
        for number, file in enumerate(files):
            named = {**inputs, "seed": number}
            one = lambda n=number, f=file: self._train_one(  # noqa: E731
                dataset, n, f, judged, anchor
            )
            self._run(f"train {number}", named, [file], one)
        hashes = [file_sha256(file) for file in files]
        choose = lambda: self._choose(dataset)  # noqa: E731
        self._run("export", {"seeds": hashes}, [self.weights], choose)

    def _train_inputs(self, dataset: Demonstrations) -> dict:
        settings = dataclasses.asdict(self.config.train)
        return {"config": settings, "dataset": dataset.hash, **self._code()}

    def _workdir(self, dataset: Demonstrations, seed: int) -> Path:
        key = digest(self._train_inputs(dataset))[:8]
        return self.folder / f"train-{key}" / f"seed-{seed}"

    def _seed_files(self) -> list[Path]:
        numbers = range(self.config.seeds)
        return [self.folder / "seeds" / f"{number}.msgpack" for number in numbers]

    def _choose(self, dataset: Demonstrations) -> None:
        """The seed with the median share of training pairs won becomes candidate."""
        config = self.config.train
        steps = -(-dataset.indices("train").size // config.batch_size)

        def won(number: int) -> float:
            workdir = self._workdir(dataset, number)
            return pairs_won(workdir / "metrics.jsonl", steps)

        ranked = sorted(range(self.config.seeds), key=won)
        median = self._seed_files()[ranked[(len(ranked) - 1) // 2]]
        write_whole(self.weights, median.read_bytes())

    def rank(self, dataset: Demonstrations) -> None:
        """Held-out scenes in both forms, all seeds beside incumbent and rivals."""
        self._tune_idm(dataset)
        for futures in FUTURES:
            self._rank(dataset, futures)

    def _tune_idm(self, dataset: Demonstrations) -> None:
        """The rival that a sceptic names: IDM tuned on the same training scenes."""
        path = self.folder / "tuned_idm.json"
        setup = RankingSetup(horizon_s=self.config.horizon_s)
        inputs = {"dataset": dataset.hash, "evaluations": IDM_EVALUATIONS}

        def work() -> None:
            write_tuned_idm(path, tune_idm(dataset, setup, IDM_EVALUATIONS))

        self._run("tune", inputs, [path], work)

    @property
    def _tuned_idm(self) -> Idm:
        return read_tuned_idm(self.folder / "tuned_idm.json")

    def _rank(self, dataset: Demonstrations, futures: str) -> None:
        config, tuned = self.config, self._tuned_idm
        stem = "ranking" if futures == "predicted" else f"ranking_{futures}"
        path, text = self.folder / f"{stem}.json", self.folder / f"{stem}.txt"
        inputs = {
            "dataset": dataset.hash,
            "seeds": [file_sha256(file) for file in self._seed_files()],
            "incumbent": self._incumbent_hash(),
            "horizon_s": config.horizon_s,
            "futures": futures,
            "tuned_idm": dataclasses.asdict(tuned),
        }

        def work() -> None:
            rewards = [open_reward(str(file)) for file in self._seed_files()]
            learned = {CANDIDATE: [scorer_of(reward) for reward in rewards]}
            known = self._incumbent_reward()
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
            report = evaluate_ranking(
                dataset, learned, setup, self.executor, references
            )
            write_whole(text, format_table(report, 118) + "\n")
            made_by = {**self._made_by(), "data_hash": dataset.hash}
            write_json(path, {**to_json(report), "made_by": made_by})

        self._run(f"rank {futures}", inputs, [path, text], work)

    def simulate(self) -> None:
        """Candidate, incumbent and rivals on the same closed-loop cases."""
        job, _ = self._job()
        folder = self.folder / "suite"

        def work() -> None:
            result = drive_job(job, self.executor)
            write_suite(result, folder, self._made_by())
            write_runs(folder / "metrics.npz", runs_of(result))

        inputs = {"job": self._job_inputs()}
        names = ("metrics.npz", "suite.json", "cases.csv", "table.txt")
        self._run("simulate", inputs, [folder / name for name in names], work)

    def likeness(self, sources: Sequence[Dataset]) -> None:
        """Every row over held-out drives of all sources: how near to the human."""
        job, _ = self._job()
        paths = [self.folder / f"likeness.{kind}" for kind in ("npz", "json", "txt")]

        def work() -> None:
            drives = held_out(sources, self.config.drives)
            found = held_out_likeness(drives, job.rows(), job.plan_every)
            write_arrays(paths[0], found.likeness)
            body = {**found.as_dict(), "made_by": self._made_by()}
            write_json(paths[1], body)
            write_whole(paths[2], found.text())

        inputs = {
            "datasets": [source.hash for source in sources],
            "drives": self.config.drives,
            "job": self._job_inputs(),
        }
        self._run("likeness", inputs, paths, work)

    def gate(self) -> None:
        """The verdict."""
        path = self.folder / "verdict.json"
        metrics = self.folder / "suite" / "metrics.npz"
        inputs = {
            "metrics": file_sha256(metrics),
            "likeness": file_sha256(self.folder / "likeness.npz"),
            "gate": dataclasses.asdict(self.config.gate),
            "incumbent": self._job()[1],
            "left_out": left_out(self._job()[0]),
        }

        def work() -> None:
            files = {"candidate": str(self.weights), "incumbent": self.config.incumbent}
            runs = {"training_runs": self.config.seeds}
            facts = {"files": files, **runs, "made_by": self._made_by()}
            write_verdict(path, self._verdict, self.config.gate, facts)

        self._run("gate", inputs, [path], work)

    def report(self, dataset: Demonstrations, given: Sequence[str | Logs]) -> Path:
        """report.html from everything above."""
        path = self.folder / "report.html"
        made_from = ("ranking.json", "suite/metrics.npz", "verdict.json")
        inputs = {
            "files": [file_sha256(self.folder / name) for name in made_from],
            "weights": file_sha256(self.weights),
            "incumbent": self._incumbent_hash(),
            "dataset": dataset.hash,
            "recorded": [not isinstance(one, str) for one in given],
            "recipe": self.config.recipe,
        }
        if self.config.sweep:
            inputs["sweep"] = file_sha256(self.config.sweep / SWEEP)
        self._run("report", inputs, [path], lambda: self._draw(path, dataset, given))
        return path

    # -------------------------------------------------------------------- helpers

    def _made_by(self) -> dict:
        """Provenance of an output, with the hashes of the rewards."""
        rewards = [
            open_reward(str(file)) for file in [*self._seed_files(), self.weights]
        ]
        known = self._incumbent_reward()
        rewards += [known] if known else []
        return {**self.facts, "weights_sha256": {r.file: r.sha256 for r in rewards}}

    @functools.cached_property
    def _runs(self) -> SuiteRuns:
        """Of the finished simulation."""
        return read_runs(self.folder / "suite" / "metrics.npz")

    @functools.cached_property
    def _verdict(self) -> Verdict:
        job, incumbent = self._job()
        known = read_arrays(self.folder / "likeness.npz")
        pair = pair_of(self._runs, incumbent, self.config.gate.nulls, known)
        return judge(pair, self.config.gate, left_out(job))

    def _draw(
        self, path: Path, dataset: Demonstrations, given: Sequence[str | Logs]
    ) -> None:
        job, incumbent = self._job()
        verdict = self._verdict
        names = [f"train {number}" for number in range(self.config.seeds)]
        imports = [f"import {number}" for number in range(len(given))]
        ranks = [f"rank {futures}" for futures in FUTURES]
        after = ["export", *ranks, "simulate", "likeness", "gate"]
        names = [*imports, *names, *after]
        known = self.stages.read()
        made = {  # but by what: the page says it once, stages.json of each
            name: {key: x for key, x in known[name].items() if key != "made_by"}
            for name in names
            if name in known
        }
        rewards = {CANDIDATE: open_reward(str(self.weights))}
        if known := self._incumbent_reward():
            rewards[INCUMBENT] = known
        drivers = [row for row in job.rows() if row.name in (CANDIDATE, incumbent)]
        shown = verdict.look_at[:REPLAYS] or job.cases().ids[:2]
        every = self.config.plan_every
        replays = make_replays(drivers, job.cases(), shown, every)
        for one in given:
            if isinstance(one, Logs):
                parts = parts_of(one.format, one.input, one.source)
                replays += recorded_replays(drivers, parts, every)
        sweep = self.config.sweep
        seed = int(rewards[CANDIDATE].provenance["seed"])
        write_tuning_page(
            path,
            TuningReport(
                verdict=verdict,
                gate=self.config.gate,
                suite=self._runs.report(),
                incumbent=incumbent,
                ranking=from_json(read_json(self.folder / "ranking.json", "a ranking")),
                rewards=rewards,
                dataset=dataset,
                replays=replays,
                workdir=self._workdir(dataset, seed),
                sweep=read_sweep(sweep) if sweep else None,
                likeness=(self.folder / "likeness.txt").read_text(),
                training_runs=self.config.seeds,
                facts={"recipe": self.config.recipe, **self.facts, "stages": made},
            ),
        )

    def _check_incumbent(self) -> None:
        known = self._incumbent_reward()
        if known is None:
            return
        found = (str(known.preset), str(known.provenance.get("mode", "speed")))
        wanted = (self.config.train.features, self.config.train.sampler.mode)
        if found != wanted:
            raise InputError(
                f"--incumbent: {known.file}: preset and mode {found}: expected {wanted}"
            )

    def _incumbent_reward(self) -> Reward | None:
        name = self.config.incumbent
        return None if name in BASELINES else open_reward(name)

    def _incumbent_hash(self) -> str:
        name = self.config.incumbent
        return name if name in BASELINES else file_sha256(Path(name))

    def _job(self, *, tuned: bool = True) -> tuple[SuiteJob, str]:
        """What the suite drives; without the tuned IDM before there is one."""
        config = self.config
        idm = dataclasses.asdict(self._tuned_idm) if tuned else {}
        return gate_job(
            str(self.weights),
            config.incumbent,
            suite=config.suite,
            cases=config.cases,
            duration_s=config.duration_s,
            catalogue_seed=config.catalogue_seed,
            plan_every=config.plan_every,
            rivals=RIVALS,
            tuned_idm=tuple(idm.items()),
        )

    def _job_inputs(self) -> dict:
        job, _ = self._job()
        return {
            **dataclasses.asdict(job),
            "refs": digest([ref.id for ref in job.refs]),
            "weights": [file_sha256(Path(file)) for file in job.weights],
        }


def _as_one(parts: Sequence[Dataset], shares: Sequence[float]) -> Demonstrations:
    """Datasets joined under their shares; one alone as it is."""
    return parts[0] if len(parts) == 1 else JoinedDatasets(parts, shares)
