"""From logs to a verdict: import, train, rank, simulate, gate, or all of it."""

import dataclasses
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from rcirl_jax.data import importing
from rcirl_jax.data.formats import read_recordings
from rcirl_jax.data.formats.recognise import recognised_format
from rcirl_jax.data.importing import ImportConfig
from rcirl_jax.data.inputs import input_files
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.store.dataset import Dataset, open_dataset
from rcirl_jax.data.store.joined import Demonstrations, open_datasets
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.likeness import DRIVES
from rcirl_jax.evaluation.closed_loop.suite import (
    SuiteResult,
    write_suite,
)
from rcirl_jax.evaluation.closed_loop.summary import format_suite
from rcirl_jax.evaluation.gate.types import GateConfig, Verdict
from rcirl_jax.evaluation.gate.verdict import write_verdict
from rcirl_jax.evaluation.gate.words import format_verdict
from rcirl_jax.evaluation.ranking.evaluate import RankingSetup, evaluate_ranking
from rcirl_jax.evaluation.ranking.report import RankingReport, format_table
from rcirl_jax.export.closed_loop import SuiteJob, run_job
from rcirl_jax.export.from_run import export_run
from rcirl_jax.export.gate_job import gate_job, judged
from rcirl_jax.export.loading import load_runs, open_reward
from rcirl_jax.export.reader import Reward
from rcirl_jax.reward import RewardConfig
from rcirl_jax.runtime.checked import typed_fields
from rcirl_jax.runtime.executors import Executor, Serial
from rcirl_jax.runtime.pipeline import only_one
from rcirl_jax.runtime.provenance import provenance
from rcirl_jax.simulation.rows import BASELINES
from rcirl_jax.simulation.suite import case_duration, suite_refs
from rcirl_jax.train.loop import Running, train
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.tuning.loop import tune as run_stages
from rcirl_jax.tuning.recipes import (
    DEFAULT,
    NOT_OF_A_RECIPE,
    PRESETS_OWN,
    TuneConfig,
    load_recipe,
    override,
)
from rcirl_jax.tuning.run import Run
from rcirl_jax.tuning.stages import verdict_of
from rcirl_jax.types import Recording

Place = str | os.PathLike[str]


def read_logs(
    path: Place, *, format: str | None = None, source: Place | None = None
) -> Iterator[Recording]:
    """Read the recordings of a log, one at a time, before anything is made of them.

    Args:
      path: file or folder.
      format: one of docs/formats, for example "csv"; None: recognised by names of
        files and columns.
      source: TOML that says what columns mean and which units they have; None: the
        one of the format.

    Returns:
      Recordings: tracks (positions in m, headings in rad, speeds in m/s, times in s),
      lanes and signals.

    Raises:
      InputError: nothing there, a format that nobody knows, or a log that is not as its
        format says.

    Examples:
        >>> for recording in rcirl_jax.read_logs("traffic.toml"):
        ...     print(recording.name, recording.rate_hz, len(recording.lanes))
        highway_straight-01-000 10.0 4
        highway_straight-01-001 10.0 4
    """
    where, toml = _paths(path, source)
    return read_recordings(format or recognised_format(where, toml), where, toml)


def import_logs(
    path: Place,
    output: Place,
    *,
    format: str | None = None,
    source: Place | None = None,
    test_fraction: float = 0.25,
    overwrite: bool = False,
    executor: Executor | None = None,
    **collect: float | bool,
) -> Dataset:
    """Import a log into a dataset of scenes and what people did in them.

    An import that was interrupted goes on where it was when it is called again.

    Args:
      path: as `read_logs`.
      output: folder of the dataset, or a tensorstore URL (`gs://`, `s3://`).
      format: as `read_logs`.
      source: as `read_logs`.
      test_fraction: share of scenes held out; no vehicle is on both sides.
      overwrite: replace a finished dataset.
      executor: where logs are read, of `rcirl_jax.runtime.executors`; None: this
        process. The dataset is the same byte for byte.
      **collect: how scenes are cut out, by the fields of `CollectConfig`; among them
        `stride_s`, s between two scenes of one driver, and `min_future_s`, s of record
        that a scene needs; `require_obstacles=False` and `require_speed_change=False`
        keep the scenes that the paper drops.

    Returns:
      The dataset, open. `dataset.manifest.quality` is the report on the log.

    Raises:
      InputError: bad input, after which nothing stays on disk, or a dataset that is
        there already.

    Examples:
        >>> dataset = rcirl_jax.import_logs(
        ...     "traffic.toml", "other", stride_s=4.0, require_obstacles=False
        ... )
        >>> dataset.count > 50
        True
    """
    settings = typed_fields(CollectConfig, collect, "import_logs: ", ("signal_checks",))
    where, toml = _paths(path, source)
    form = format or recognised_format(where, toml)
    config = ImportConfig(
        format=form, collect=CollectConfig(**settings), test_fraction=test_fraction
    )

    def sign(dataset: Dataset) -> None:
        flags = {"input": str(where), "format": form, **dataclasses.asdict(config)}
        made_by = {"flags": flags, **provenance()}
        dataset.write_facts({"data_hash": dataset.hash, "made_by": made_by})

    importing.import_logs(
        input_files(form, where, toml),
        os.fspath(output),
        config,
        executor=executor,
        overwrite=overwrite,
        before_commit=sign,
    )
    return open_dataset(output, verify=False)


def _paths(path: Place, source: Place | None) -> tuple[Path, Path | None]:
    return Path(path), None if source is None else Path(source)


def train_reward(
    data: Place | Sequence[Place] | Demonstrations,
    workdir: Place,
    *,
    recipe: str = DEFAULT,
    seed: int = 0,
    **settings: Any,  # noqa: ANN401
) -> Reward:
    """Train a reward on the training scenes of a dataset, and write its weights.

    The weights are WORKDIR/weights.msgpack. A training that was interrupted goes on
    where it was when it is called again; one that is done is not done again. The
    reward stands alone: `tune` adds a recipe's simulated demonstrations and prior cost.

    Args:
      data: a dataset, its folder, or the folders of several, which count alike.
      workdir: folder of the run: checkpoints, metrics, weights.
      recipe: name in data_specs/recipes ("tuned", "paper", "quick"), or a TOML file.
      seed: of initial weights, batches and candidates.
      **settings: in place of the recipe's: fields of `TrainConfig` and `RewardConfig`,
        for example `epochs=40`, `loss="listwise"`, `hidden=(15,)`, `constraint="none"`.

    Returns:
      The reward as `load_weights` reads it.

    Raises:
      InputError: a setting that cannot be, a workdir of other settings or data, or a
        scene with a feature that is not finite.
      Interrupted: the process was told to end; the last step is saved.

    Examples:
        >>> reward = rcirl_jax.train_reward("data", "run", recipe="quick", epochs=1)
        >>> reward.preset, len(reward.names)
        ('paper21', 21)
        >>> rcirl_jax.load_weights("run/weights.msgpack").sha256 == reward.sha256
        True
    """
    config = training_of(recipe, seed, settings)
    config.reward.check_own()
    folder = Path(workdir)
    named = folders_of(data)
    dataset = cast(Demonstrations, data) if named is None else open_datasets(named)
    flags = {"data": named, "recipe": recipe, "seed": seed, **settings}
    train(dataset, folder, config, provenance={"flags": flags, **provenance()})
    return export_run(folder, dataset, folder / "weights.msgpack")


def training_of(recipe: str, seed: int, settings: Mapping[str, Any]) -> TrainConfig:
    """The training of a recipe with settings in place of its own."""
    names = {field.name for field in dataclasses.fields(RewardConfig)}
    of_reward = {name: settings[name] for name in settings if name in names}
    rest = {name: settings[name] for name in settings if name not in names}
    given = typed_fields(TrainConfig, rest, "settings: ", NOT_OF_A_RECIPE)
    given |= typed_fields(RewardConfig, of_reward, "settings: ", PRESETS_OWN)
    return override(load_recipe(recipe).train, given, seed=seed)


def folders_of(data: object) -> list[str] | None:
    """Folders by name; None for a dataset that is open."""
    if isinstance(data, str | os.PathLike):
        return [os.fspath(data)]
    if isinstance(data, Sequence):
        return [os.fspath(one) for one in data]
    return None


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
    learned, preset, sampler = load_runs(_files(weights))
    setup = RankingSetup(
        preset=preset,
        sampler=sampler,
        horizon_s=horizon_s,
        split=split,
        drop_collisions=drop_collisions,
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

    Both drive the same cases; never is a learned reward the judge (docs/gate.md).

    Args:
      candidate: weights file.
      incumbent: weights file, or a baseline's name.
      data: datasets whose held-out drives say how near to people it drives; without
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
        baselines=(
            "IDM",
            *(name for name in config.trivial_baselines if name in BASELINES),
        ),
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
    """What may be one or several as a list."""
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
    drives: int = 240,
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
      incumbent: what drives today: a weights file, or a baseline's name.
      suite: cases of the closed loop: "full", "smoke", or families with commas.
      cases: of each family; None: as declared.
      duration_s: s of a case; None: 120, of "smoke" 20.
      drives: held-out recorded drives that say how near to people it drives.
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
        prior_cost=chosen.prior_cost,
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
