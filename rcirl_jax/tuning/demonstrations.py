"""Training data of a run: recorded, and simulated where nobody recorded.

A reward tuned on some roads must not unlearn the others. So an expert may drive the
catalogue (other seeds than the suite's). What is driven is a dataset like any other,
with a weight of its own.
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
from rcirl_jax.runtime.pipeline import digest
from rcirl_jax.simulation.demonstrations import DriveConfig, drive_catalogue
from rcirl_jax.simulation.rows import baseline_row, drawn_weights, mobil_row
from rcirl_jax.simulation.suite import suite_refs
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.tuning.recipes import SimulatedDemonstrations
from rcirl_jax.tuning.run import Run


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
    """The sources and the simulated demonstrations, if there are any, as one."""
    plan, made = run.config.simulated, [*sources]
    given = list(shares or [float(s.indices("train").size) for s in sources])
    # a recorded source has the weight 1, whatever the shares add up to
    scale = len(sources) / sum(given)
    given = [share * scale for share in given]
    if plan.expert != "none":
        made.append(_drives(run))
        given.append(plan.weight)
    return as_one(made, given)


def _drives(run: Run) -> Dataset:
    """The expert's drives."""
    plan, incumbent = run.config.simulated, run.config.incumbent
    inputs = {
        "simulated_demonstrations": dataclasses.asdict(plan),
        "expert": run.incumbent_hash() if plan.expert != "driver model" else "",
        **run.candidates,
    }
    key = digest({**inputs, **run.code()})[:8]
    folder = run.folder / f"demonstrations-{key}"
    work = functools.partial(
        drive_expert,
        plan,
        folder,
        config=run.config.train,
        incumbent=incumbent,
        before_commit=run.sign,
    )
    return _made(run, "demonstrate", inputs, folder, work)


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


def drive_expert(
    plan: SimulatedDemonstrations,
    output: Path,
    *,
    config: TrainConfig,
    incumbent: str,
    before_commit: Callable[[Dataset], object],
) -> Dataset:
    """Drives the catalogue and keeps what the expert did.

    Args:
      plan: which cases, how long, how densely.
      output: dataset folder.
      config: as `expert_of`.
      incumbent: as `expert_of`.
      before_commit: as `DatasetWriter.finish`.
    """
    drives = DriveConfig(
        duration_s=plan.duration_s, stride_s=plan.stride_s, test_fraction=0.0
    )
    drive_catalogue(
        suite_refs("full", plan.cases, plan.catalogue_seed),
        output,
        drives,
        expert=expert_of(plan, incumbent, config),
        overwrite=True,
        before_commit=before_commit,
    )
    return open_dataset(output)
