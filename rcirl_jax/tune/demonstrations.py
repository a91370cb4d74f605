"""Training data of a run: the stages import and rehearse."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from rcirl_jax.data.formats.files import listing
from rcirl_jax.data.importing import import_parts
from rcirl_jax.data.logs import Logs
from rcirl_jax.data.parts import parts_of
from rcirl_jax.data.store.dataset import Dataset, open_dataset
from rcirl_jax.data.store.joined import Demonstrations, JoinedDatasets
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.pipeline import digest, file_sha256
from rcirl_jax.tune.rehearsal import rehearse
from rcirl_jax.tune.rewards import fit_prior_cost, train_round
from rcirl_jax.tune.run import Run


def source(run: Run, given: str | Logs, number: int) -> Dataset:
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
    key = digest({**inputs, **run.code(__name__)})[:8]
    folder = run.folder / f"dataset-{key}"

    def work() -> None:
        if (folder / "manifest.json").exists():
            return  # finished, but not noted: killed in between
        config = given.import_config(found, run.executor)
        import_parts(
            found, folder, config, executor=run.executor, before_commit=run.sign
        )

    run.stage(f"import {number}", inputs, [folder / "manifest.json"], work)
    return open_dataset(folder)


def kept_source(run: Run, given: str | Logs, number: int) -> Dataset:
    """A source's dataset, as the run has imported it.

    Raises:
      InputError: the run has not.
    """
    if isinstance(given, str):
        return open_dataset(given)
    made = run.stages.read().get(f"import {number}", {}).get("outputs", {})
    for manifest in made:
        return open_dataset((run.folder / manifest).parent)
    raise InputError(f"{run.folder}: import {number}: missing: expected its dataset")


def with_rehearsal(
    run: Run, sources: Sequence[Dataset], shares: Sequence[float] | None
) -> Demonstrations:
    """The sources and the rehearsed catalogue as one; each round trains first."""
    plan, made = run.config.rehearsal, [*sources]
    given = list(shares or [float(s.indices("train").size) for s in sources])
    # a recorded source has the weight 1, whatever the shares add up to
    scale = len(sources) / sum(given)
    given = [share * scale for share in given]
    joined: Demonstrations = _as_one(made, given)
    drives: list[Dataset] = []
    for number in range(plan.datasets):
        learner = None
        if number:
            learner = run.folder / "rounds" / f"{number}.msgpack"
            prior_cost = fit_prior_cost(run, sources, given[: len(sources)], drives)
            train_round(run, joined, number, learner, prior_cost)
        drives.append(_rehearsed(run, number, learner))
        if plan.weights[number] > 0.0:
            made.append(drives[-1])
            given.append(plan.weights[number])
            joined = _as_one(made, given)
    fit_prior_cost(run, sources, given[: len(sources)], drives)
    return joined


def _rehearsed(run: Run, number: int, learner: Path | None) -> Dataset:
    """The drives of a round; the teacher's alone without a learner."""
    plan, config = run.config.rehearsal, run.config
    inputs = {
        "rehearsal": dataclasses.asdict(plan),
        "number": number,
        "teacher": run.incumbent_hash() if plan.teacher == "incumbent" else "",
        "learner": file_sha256(learner) if learner else "",
    }
    key = digest({**inputs, **run.code(__name__)})[:8]
    folder = run.folder / f"rehearsal-{key}" / str(number)

    def work() -> None:
        if (folder / "manifest.json").exists():
            return  # finished, but not noted: killed in between
        rehearse(
            number,
            plan,
            folder,
            incumbent=config.incumbent,
            learner=learner,
            before_commit=run.sign,
        )

    run.stage(f"rehearse {number}", inputs, [folder / "manifest.json"], work)
    return open_dataset(folder)


def _as_one(parts: Sequence[Dataset], shares: Sequence[float]) -> Demonstrations:
    """Datasets joined under their shares; one alone as it is."""
    return parts[0] if len(parts) == 1 else JoinedDatasets(parts, shares)
