"""One tuning run: its folder, its stages, its incumbent, its provenance.

RUN/dataset-KEY/       the import of each log, unless datasets are given
RUN/demonstrations-KEY/ simulated: the expert's drives
RUN/prior_cost.json    the own cost, and the gain of V on top of it
RUN/train-KEY/seed-N/  training runs; KEY changes with what they are made from
RUN/seeds/N.msgpack    every seed's reward
RUN/weights.msgpack    the candidate: of the seeds the one with the median share of
                       training pairs won
RUN/today.msgpack      own terms with the weights that drive today
RUN/searched.msgpack   own terms with the weights that a search finds, a baseline
RUN/terms.yaml         own terms with the tuned weights, beside today's
RUN/tuned_idm.json     the driver model tuned on the training scenes, a baseline
RUN/ranking.json       held-out scenes as the planner sees them, beside baselines
RUN/ranking_recorded.json   the same with recorded futures
RUN/likeness.json      held-out drives: how near to the human (and likeness.npz, .txt)
RUN/suite/             metrics.npz, suite.json, cases.csv, table.txt
RUN/decided.json       how often the candidate plans otherwise than its own cost would
RUN/dial.json          how strongly the learned value counts: drives at several gains
RUN/dials/N.msgpack    the weights with their gain times N
RUN/verdict.json       of the gate
RUN/verdict.txt        its checks and the held-out drives as tables
RUN/report.html        all of it to look at
RUN/stages.json        what made what (`stages`)
"""

import dataclasses
import importlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rcirl_jax.data.store.dataset import EQUAL, Dataset
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.gate.types import DRIVES, GateConfig
from rcirl_jax.export.closed_loop import checked_own_cost
from rcirl_jax.export.loading import open_reward
from rcirl_jax.export.reader import Reward
from rcirl_jax.export.sweep import read_sweep
from rcirl_jax.planner.own_cost import OwnCost, is_place
from rcirl_jax.planner.program import is_program, program
from rcirl_jax.runtime.executors import Executor
from rcirl_jax.runtime.pipeline import Stages, code_sha256, file_sha256
from rcirl_jax.simulation.rows import KNOWN_BASELINES
from rcirl_jax.train.loop import Running
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.tuning.recipes import SimulatedDemonstrations

# what reads as permission to use weights that are no longer there
JUDGED = ("gate", "dial", "decided", "report")
STALE = {
    **dict.fromkeys(("import", "demonstrate", "train"), ("export", *JUDGED)),
    **dict.fromkeys(("export", "simulate", "likeness"), JUDGED),
    **dict.fromkeys(("rank", *JUDGED[:-1]), ("report",)),
}
TODAY, TERMS = "today.msgpack", "terms.yaml"
NOTED = ("git_commit", "code_sha256", "versions", "flags")  # of every stage


def _say(line: str) -> None:
    """A line that is seen at once, also where it goes into a file."""
    print(line, flush=True)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TuneConfig:
    """Everything that decides the outcome, besides the data."""

    train: TrainConfig
    gate: GateConfig
    # weights file, baseline, or place of an own cost
    incumbent: str = "hand-set"
    simulated: SimulatedDemonstrations = dataclasses.field(
        default_factory=SimulatedDemonstrations
    )
    gain: float = 0.0  # of V on top of the own cost; 0: V drives alone
    data_weights: str = EQUAL  # of several sources, as `data.store.dataset.shares_of`
    recipe: str = ""  # its name, for the report
    seeds: int = 1
    search: str = "cma"  # of the tuned IDM: one of `baselines.SEARCHES`
    drives: int = DRIVES  # held-out, for human-likeness and safety
    horizon_s: float = 5.0
    suite: str = "full"
    cases: int | None = None  # per family
    duration_s: float | None = None
    catalogue_seed: int = 0
    plan_every: int = 1
    sweep: Path | None = None  # of `rcirl sweep`, shown in the report

    def __post_init__(self) -> None:
        """Rejects settings that would fail only after the training."""
        if self.sweep is not None:
            read_sweep(self.sweep)
        if self.search == "optuna":
            importlib.import_module("optuna")  # an extra
        if self.drives < 1:
            raise InputError(f"drives: {self.drives}: expected at least 1")
        if self.seeds < 1:
            raise InputError(f"seeds: {self.seeds}: expected at least 1")
        self.train.reward.check_own()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """One run folder with its settings."""

    folder: Path
    config: TuneConfig
    executor: Executor
    running: Running
    facts: Mapping[str, Any]  # provenance: commit, versions, flags
    say: Callable[[str], object] = _say
    done: list[str] = dataclasses.field(default_factory=list)  # stages, by this process

    @property
    def stages(self) -> Stages:
        """The record of finished stages."""
        return Stages(folder=self.folder)

    @property
    def weights(self) -> Path:
        """The candidate."""
        return self.folder / "weights.msgpack"

    @property
    def today(self) -> Path:
        """Own terms with the weights that drive today."""
        return self.folder / TODAY

    @property
    def searched(self) -> Path:
        """Own terms with the weights that a search finds."""
        return self.folder / "searched.msgpack"

    @property
    def terms(self) -> Path:
        """Own terms with the tuned weights."""
        return self.folder / TERMS

    @property
    def metrics(self) -> Path:
        """The driven suite."""
        return self.folder / "suite" / "metrics.npz"

    @property
    def tables(self) -> Path:
        """The verdict's checks and the held-out drives as text."""
        return self.folder / "verdict.txt"

    @property
    def page(self) -> Path:
        """The report to open."""
        return self.folder / "report.html"

    @property
    def dial(self) -> Path:
        """Drives at several gains of the learned value on its own cost."""
        return self.folder / "dial.json"

    @property
    def decided(self) -> Path:
        """The share of plans that differ from the own cost's choice."""
        return self.folder / "decided.json"

    @property
    def tuned_idm(self) -> Path:
        """The driver model tuned on the training scenes."""
        return self.folder / "tuned_idm.json"

    @property
    def steers(self) -> bool:
        """True if paths are planned, not speed alone."""
        return self.config.train.sampler.mode == "path_speed"

    @property
    def candidates(self) -> dict[str, str]:
        """The part of a stage's inputs that says which candidates there are."""
        sampler = self.config.train.sampler
        return {"mode": sampler.mode, "sampler": sampler.own_sha256}

    @property
    def seed_files(self) -> list[Path]:
        """The weights of every seed."""
        numbers = range(self.config.seeds)
        return [self.folder / "seeds" / f"{number}.msgpack" for number in numbers]

    def stage(
        self,
        name: str,
        inputs: Mapping[str, Any],
        outputs: list[Path],
        work: Callable[[], object],
    ) -> None:
        """Do a stage's work unless it was done from these inputs by this code.

        Arguments as of `Stages.run`; what the stage makes `STALE` is removed first.
        """
        facts = {**inputs, **self.code()}
        kind = name.partition(" ")[0]
        stale = STALE.get(kind, ())
        made_by = {key: self.facts[key] for key in NOTED if key in self.facts}
        done = self.stages.run(name, facts, outputs, work, stale, made_by)
        if done:
            self.done.append(name)
        self.say(f"[{name}] {'done' if done else 'as before, kept'}")

    def code(self) -> dict:
        """The part of a stage's key besides its inputs: package and libraries."""
        return {"code": code_sha256(), "versions": self.facts["versions"]}

    def sign(self, dataset: Dataset) -> None:
        """Write the provenance of a dataset of this run beside it."""
        dataset.write_facts({"data_hash": dataset.hash, "made_by": self.facts})

    def provenance(self) -> dict:
        """Provenance of an output, with the hashes of the rewards."""
        rewards = [open_reward(str(file)) for file in [*self.seed_files, self.weights]]
        known = self.incumbent_reward()
        rewards += [known] if known else []
        return {**self.facts, "weights_sha256": {r.file: r.sha256 for r in rewards}}

    def incumbent_reward(self) -> Reward | None:
        """The incumbent's reward; None: a baseline, an own cost or a program."""
        name = self.config.incumbent
        other = name in KNOWN_BASELINES or is_place(name) or is_program(name)
        return None if other else open_reward(name)

    @property
    def own_cost(self) -> OwnCost | None:
        """The user's own cost, where it is the incumbent."""
        name = self.config.incumbent
        return checked_own_cost(name) if is_place(name) else None

    def incumbent_hash(self) -> str:
        """The sha256 of the incumbent's file, or the baseline's name."""
        name = self.config.incumbent
        if self.own_cost:
            return self.own_cost.sha256
        if is_program(name):
            return program(name).sha256
        return name if name in KNOWN_BASELINES else file_sha256(Path(name))
