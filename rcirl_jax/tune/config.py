"""Everything that decides the outcome of a tuning run, besides the data."""

import dataclasses
import importlib
from pathlib import Path

from rcirl_jax.data.store.joined import EQUAL
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.gate.types import GateConfig
from rcirl_jax.export.sweep.result import read_sweep
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.tune.prior_cost import PriorCostConfig
from rcirl_jax.tune.rehearsal import Rehearsal


@dataclasses.dataclass(frozen=True, kw_only=True)
class TuneConfig:
    """Everything that decides the outcome, besides the data."""

    train: TrainConfig
    gate: GateConfig
    incumbent: str = "hand-set"  # weights file or baseline
    rehearsal: Rehearsal = dataclasses.field(default_factory=Rehearsal)
    prior_cost: PriorCostConfig = dataclasses.field(default_factory=PriorCostConfig)
    data_weights: str = EQUAL  # of several sources, as `data.store.joined.shares_of`
    recipe: str = ""  # its name, for the report
    seeds: int = 1
    search: str = "cma"  # of the tuned IDM: one of `baselines.tuned.SEARCHES`
    drives: int = 240  # held-out, for human-likeness
    horizon_s: float = 5.0
    suite: str = "full"
    cases: int | None = None  # per family
    duration_s: float | None = None
    catalogue_seed: int = 0
    plan_every: int = 1
    sweep: Path | None = None  # of `rcirl sweep`, shown in the report

    def __post_init__(self) -> None:
        """Reject what would fail only after the training."""
        if self.sweep is not None:
            read_sweep(self.sweep)
        if self.search == "optuna":
            importlib.import_module("optuna")  # an extra
        if self.drives < 1:
            raise InputError(f"--drives: {self.drives}: expected at least 1")
        if self.seeds < 1:
            raise InputError(f"--seeds: {self.seeds}: expected at least 1")
        if self.train.sampler.mode != "speed":
            raise InputError(
                f"--mode: {self.train.sampler.mode}: the closed loop plans speed"
            )
        self.train.reward.check_own()
