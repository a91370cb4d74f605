"""Training data of a run: recorded, and simulated where nobody recorded.

A reward tuned on some roads must not unlearn the others. So an expert drives the
catalogue (other seeds than the suite's), and in each further round the reward learned
so far drives, from which the expert takes over in turn: the way out of where the
learner's own mistakes lead becomes a demonstration too (DAgger, Ross et al. 2011, with
takeovers). What is driven is a dataset like any other, with a weight of its own.

Drives of weight 0 are not learned from. They show what a reward with a prior cost
(`tuning.prior_cost`) has to leave to that cost; in further rounds that reward drives
alone, and shows where it gets to by itself.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path

from rcirl_jax.data.formats.files import listing
from rcirl_jax.data.importing import Logs, import_logs
from rcirl_jax.data.inputs import input_files
from rcirl_jax.data.store.dataset import (
    Dataset,
    Demonstrations,
    JoinedDatasets,
    open_dataset,
)
from rcirl_jax.errors import InputError
from rcirl_jax.export.closed_loop import checked_own_cost, table_rows
from rcirl_jax.planner.own_cost import is_place
from rcirl_jax.planner.rank import Params, Policy, online
from rcirl_jax.runtime.pipeline import digest, file_sha256
from rcirl_jax.simulation.demonstrations import DriveConfig, drive_catalogue
from rcirl_jax.simulation.rows import baseline_row, drawn_weights, mobil_row
from rcirl_jax.simulation.suite import suite_refs
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.tuning.prior_cost import fit_prior_cost
from rcirl_jax.tuning.recipes import SimulatedDemonstrations
from rcirl_jax.tuning.run import Run
from rcirl_jax.tuning.stages import train_one


def source(run: Run, given: str | Logs, number: int) -> Dataset:
    """Opens a source's dataset, or imports its logs."""
    if isinstance(given, str):
        return open_dataset(given)
    found = input_files(given.format, given.input, given.source)
    inputs = {
        "config": dataclasses.asdict(given.config),
        "spec": digest(found[0].spec),
        "files": listing(given.input) if given.input else [],
        **({"signals": given.signals} if given.signals else {}),
    }
    folder = run.folder / f"dataset-{digest({**inputs, **run.code()})[:8]}"

    def work() -> None:
        config = given.import_config(found, run.executor)
        import_logs(
            found, folder, config, executor=run.executor, before_commit=run.sign
        )

    return _made(run, f"import {number}", inputs, folder, work)


def kept_source(run: Run, given: str | Logs, number: int) -> Dataset:
    """Opens a source's dataset, as the run has imported it.

    Raises:
      InputError: the run has not.
    """
    if isinstance(given, str):
        return open_dataset(given)
    made = run.stages.read().get(f"import {number}", {}).get("outputs", {})
    for manifest in made:
        return open_dataset((run.folder / manifest).parent)
    raise InputError(f"{run.folder}: import {number}: missing: expected its dataset")


def as_one(
    sources: Sequence[Dataset], shares: Sequence[float] | None
) -> Demonstrations:
    """Joins datasets under their shares; one alone stays as it is."""
    return sources[0] if len(sources) == 1 else JoinedDatasets(sources, shares)


def with_simulated(
    run: Run, sources: Sequence[Dataset], shares: Sequence[float] | None
) -> Demonstrations:
    """The sources and the simulated demonstrations as one; each round trains first."""
    plan, made = run.config.simulated, [*sources]
    given = list(shares or [float(s.indices("train").size) for s in sources])
    # a recorded source has the weight 1, whatever the shares add up to
    scale = len(sources) / sum(given)
    given = [share * scale for share in given]
    recorded = tuple(given)
    joined = as_one(made, given)
    drives: list[Dataset] = []
    for number in range(plan.datasets):
        learner = None
        if number:
            learner = run.folder / "rounds" / f"{number}.msgpack"
            prior = fit_prior_cost(run, sources, recorded, drives)
            stage = f"demonstrate learner {number}"
            train_one(run, stage, joined, 0, learner, prior)
        drives.append(_round(run, number, learner))
        if plan.weights[number] > 0.0:
            made.append(drives[-1])
            given.append(plan.weights[number])
            joined = as_one(made, given)
    fit_prior_cost(run, sources, recorded, drives)
    return joined


def _round(run: Run, number: int, learner: Path | None) -> Dataset:
    """Drives a round; the expert's alone without a learner."""
    plan, incumbent = run.config.simulated, run.config.incumbent
    inputs = {
        "simulated_demonstrations": dataclasses.asdict(plan),
        "number": number,
        "expert": run.incumbent_hash() if plan.expert != "driver model" else "",
        "learner": file_sha256(learner) if learner else "",
        **run.candidates,
    }
    key = digest({**inputs, **run.code()})[:8]
    folder = run.folder / f"demonstrations-{key}" / str(number)
    work = functools.partial(
        drive_round,
        number,
        plan,
        folder,
        config=run.config.train,
        incumbent=incumbent,
        learner=learner,
        before_commit=run.sign,
    )
    return _made(run, f"demonstrate {number}", inputs, folder, work)


def _made(
    run: Run, stage: str, inputs: dict, folder: Path, work: Callable[[], object]
) -> Dataset:
    """Makes a dataset as a stage."""
    manifest = folder / "manifest.json"

    def unless_there() -> None:
        if not manifest.exists():  # else finished, but not noted: killed in between
            work()

    run.stage(stage, inputs, [manifest], unless_there)
    return open_dataset(folder)


def expert_of(
    plan: SimulatedDemonstrations, incumbent: str, config: TrainConfig
) -> tuple[Policy, Params] | None:
    """Returns the expert as a policy and its weights; None: the driver models.

    Where paths are planned the driver model is the one that changes lanes.

    Args:
      plan: names the expert.
      incumbent: weights file, "hand-set" or the place of an own cost, which is the
        expert "own cost" where it is given.
      config: of the training: a cost drives in the program of its rewards.

    Raises:
      InputError: a file cannot be read.
    """
    if plan.expert == "driver model":
        if config.sampler.mode == "speed":
            return None
        row = mobil_row()
        return row.policy, row.params
    if plan.expert == "own cost" or incumbent == "hand-set" or is_place(incumbent):
        own = checked_own_cost(incumbent) if is_place(incumbent) else None
        row = baseline_row(
            own.name if own else "hand-set",
            config.features,
            drawn_weights(config.features, config.reward),
            online(config.sampler, own=own),
            config.reward.activation,
        )
    else:
        row = table_rows([incumbent], ())[0]
    return row.policy, row.params


def drive_round(
    number: int,
    plan: SimulatedDemonstrations,
    output: Path,
    *,
    config: TrainConfig,
    incumbent: str,
    learner: Path | None,
    before_commit: Callable[[Dataset], object],
) -> Dataset:
    """Drives the catalogue and keeps what the expert did.

    Args:
      number: 0: the expert alone; else the round.
      plan: which cases, how long, how densely.
      output: dataset folder.
      config: as `expert_of`.
      incumbent: as `expert_of`.
      learner: weights file of the reward learned so far; None in round 0.
      before_commit: as `DatasetWriter.finish`.
    """
    expert, driven = expert_of(plan, incumbent, config), None
    if learner is not None:
        row = table_rows([str(learner)], ())[0]
        driven = row.policy, row.params
    if driven and not plan.weight:
        expert, driven = driven, None
    drives = DriveConfig(
        duration_s=plan.duration_s,
        stride_s=plan.takeover_stride_s if driven else plan.stride_s,
        test_fraction=0.0,
    )
    cases = plan.takeover_cases if number else plan.cases
    drive_catalogue(
        suite_refs("full", cases, plan.catalogue_seed + number),
        output,
        drives,
        expert=expert,
        learner=driven,
        overwrite=True,
        before_commit=before_commit,
    )
    return open_dataset(output)
