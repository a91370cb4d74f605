"""Closed-loop suites and gates by the names of weights files and baselines.

Rows hold compiled functions and cases come from files, so neither is sent to other
processes: a piece, a range of cases with one row, names them, and whoever drives it
builds them again. The tuned driver model is a JSON file with one number for every field
of `Idm`: {"headway": 1.1, "standstill_gap": 2.3, ...}.
"""

import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import jax
import msgspec
import numpy as np

from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.likeness import (
    LikenessReport,
    held_out_likeness,
)
from rcirl_jax.evaluation.closed_loop.suite import (
    DriveRow,
    SuiteConfig,
    SuiteResult,
    bar_of,
    drive_here,
    run_suite,
)
from rcirl_jax.evaluation.gate.full_suite import families_sha256, left_out_of_suite
from rcirl_jax.evaluation.gate.types import (
    CANDIDATE,
    DRIVES,
    INCUMBENT,
    GateConfig,
    Pair,
    Verdict,
)
from rcirl_jax.evaluation.gate.verdict import judge, repeats
from rcirl_jax.export.from_run import NUM_SAMPLES, write_weights
from rcirl_jax.export.loading import (
    open_reward,
    own_cost_of,
    own_sampler_of,
    reward_params,
    row_names,
)
from rcirl_jax.export.reader import Reward
from rcirl_jax.export.weights import PROVENANCE_KEYS
from rcirl_jax.features import feature_map
from rcirl_jax.planner.baselines import TUNED_IDM_ROW, Idm, Yielding
from rcirl_jax.planner.dp import DpConfig, dp_policy
from rcirl_jax.planner.mobil import MOBIL_ROW
from rcirl_jax.planner.own_cost import (
    OwnCost,
    check_own_cost,
    is_place,
    own_cost,
)
from rcirl_jax.planner.program import (
    PREFIX,
    Program,
    check_program,
    is_program,
    program,
)
from rcirl_jax.planner.rank import (
    ONLINE,
    Params,
    RankConfig,
    Ranking,
    Score,
    hand_score,
    online,
    rank_policy,
    ranking,
    ranking_score,
)
from rcirl_jax.reward import RewardConfig, fit_normaliser, init_params, seen_range
from rcirl_jax.reward.speed_dp import SPEED_DP_ROW
from rcirl_jax.runtime.atomic_files import read_json, write_json
from rcirl_jax.runtime.checked import checked
from rcirl_jax.runtime.executors import Executor
from rcirl_jax.sampling import SamplerConfig, sample
from rcirl_jax.sampling.own_sampler import check_own_sampler
from rcirl_jax.simulation.cases import STEP_S
from rcirl_jax.simulation.metrics import CaseMetrics
from rcirl_jax.simulation.recorded import held_out
from rcirl_jax.simulation.rollout import LANES, first_scenes
from rcirl_jax.simulation.rows import (
    KNOWN_BASELINES,
    Row,
    baseline_row,
    drawn_weights,
    judges,
    program_row,
    rule_row,
)
from rcirl_jax.simulation.suite import (
    FULL_S,
    CaseRef,
    CaseSet,
    build,
    case_duration,
    catalogue_set,
    drive_row,
    rollout_config,
    suite_refs,
)
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.types import Candidates, Scene

# features and activation of "random weights" in a table without any
NO_WEIGHTS, ACTIVATION = "paper21", RewardConfig().activation
FIELDS = tuple(field.name for field in dataclasses.fields(Idm))
_POSITIVE = Annotated[float, msgspec.Meta(gt=0.0, lt=1e6)]
_IDM = msgspec.defstruct(
    "_IDM", [(name, _POSITIVE) for name in FIELDS], forbid_unknown_fields=True
)


def score_of(reward: Reward, own: OwnCost | None = None) -> tuple[Score, Ranking]:
    """Returns the score of a weights file: V, or its prior cost and V.

    Args:
      reward: the file's.
      own: the user's own cost, where other rows or the file's prior cost are of it.

    Raises:
      InputError: its prior cost is another than `own` and the embedded ones.
    """
    score = ranking_score(feature_map(str(reward.preset)), reward.activation, own)
    prior_cost = reward.prior_cost
    if prior_cost is None:
        return score, ranking(reward_params(reward))
    known = ["hand-set", *([own.name] if own else [])]
    if prior_cost.incumbent not in known:
        raise InputError(
            f"{reward.file}: prior_cost.incumbent: {prior_cost.incumbent}: expected "
            f"{' or '.join(known)}, whose cost is known here"
        )
    return score, ranking(reward_params(reward), prior_cost.incumbent, prior_cost.gain)


def incumbent_score(name: str, own: OwnCost | None = None) -> tuple[Score, Params]:
    """The score of "hand-set", of an own cost or of a weights file, and its weights.

    Raises:
      InputError: none of them.
    """
    if name == "hand-set":
        return hand_score, None
    if own is not None and name == own.name:
        return own.score, None
    reward = open_reward(name)
    return score_of(reward, own_cost_of([reward]))


def table_rows(
    weights: Sequence[str],
    baselines: Sequence[str],
    *,
    dp: bool = False,
    tuned_idm: Idm | None = None,
    names: Sequence[str] = (),
    track: str = "full",
    planners: Sequence[tuple[str, str]] = (),
    mode: str | None = None,
) -> list[Row]:
    """Learned rows first, in the order of the files, planners, then the baselines.

    Rows are named as by `row_names`, or bear `names`, one per file. The first drives
    again with search and by the plans of search alone (`dp`). A tuned IDM comes last.
    `track` is the safety filter's (`SafetyConfig`). `planners` are names of rows (""
    for their own) and places of programs (`planner.program`) or own costs
    (`planner.own_cost`). Weights plan what they were trained to plan, other rows that
    rank candidates what `mode` says or else the first file's; the rest plan speed along
    the given path.

    Raises:
      InputError: no file and no planner, an unreadable one, one twice without `names`,
        an unknown baseline, a planner that cannot be started or is called as another
        row.
    """
    if not weights and not planners:
        raise InputError("weights: none: expected at least one file or planner")
    rewards = [open_reward(path) for path in weights]
    places = [place for _, place in planners if is_place(place)]
    sampler = own_sampler_of(rewards, SamplerConfig())

    def config_of(reward: Reward | None, mode: str) -> RankConfig:
        own = own_cost_of([reward] if reward else [], places)
        if own is None and places:  # drives in the same program
            own = own_cost(places[0])
        return online(dataclasses.replace(sampler, mode=mode), track, own)

    rows: list[Row] = []
    for reward, name in zip(rewards, names or row_names(rewards), strict=True):
        config = config_of(reward, reward.mode)
        score, params = score_of(reward, config.own)
        seed = int(reward.provenance.get("seed") or 0)
        policy = rank_policy(score, config)
        rows.append(Row(name=name, policy=policy, params=params, seed=seed))
    first = rewards[0] if rewards else None
    # the program in which baselines are ranked
    preset, params, activation = NO_WEIGHTS, drawn_weights(NO_WEIGHTS), ACTIVATION
    if first is not None:
        preset, activation = str(first.preset), first.activation
        params = reward_params(first)
    config = config_of(first, mode or (first.mode if first else "speed"))
    in_speed = config_of(first, "speed")
    if dp and first is None:
        raise InputError("dp: without weights: expected a weights file")
    if dp and first is not None:
        prior_cost = first.prior_cost
        policy = dp_policy(
            feature_map(preset),
            activation,
            config_of(first, first.mode),
            DpConfig(),
            own=prior_cost.incumbent if prior_cost else "constant V",
        )
        known = rows[0]
        rows[1:1] = [
            dataclasses.replace(
                known,
                name=f"{known.name} {name}",
                policy=policy,
                params=(known.params, np.asarray(alone)),
            )
            for name, alone in (("search", False), ("DP", True))
        ]
    for name, place in planners:
        if is_place(place):
            own = dataclasses.replace(config, own=own_cost(place))
            row = baseline_row(own_cost(place).name, preset, params, own, activation)
            is_taken = row.name in [one.name for one in rows]
            name = name or (place if is_taken else row.name)
            rows.append(dataclasses.replace(row, name=name))
        else:
            rows.append(program_row(program(place), name))
    by_name = {SPEED_DP_ROW: in_speed}  # a cost of speed alone
    rows += [
        baseline_row(name, preset, params, by_name.get(name, config), activation)
        for name in baselines
    ]
    if tuned_idm is not None:
        rows.append(rule_row(TUNED_IDM_ROW, "IDM", Yielding(idm=tuned_idm)))
    called = [row.name for row in rows]
    of_planners = called[len(rewards) + 2 * dp :]
    for (_, place), name in zip(planners, of_planners, strict=False):
        if called.count(name) > 1:
            raise InputError(
                f"planner: {place.removeprefix(PREFIX)}: it is called {name}: expected "
                "another name than other rows'"
            )
    return rows


@dataclasses.dataclass(frozen=True, kw_only=True)
class SuiteJob:
    """The rows and cases of a suite by name; hashable and small."""

    weights: tuple[str, ...]
    baselines: tuple[str, ...]
    refs: tuple[CaseRef, ...]
    duration_s: float
    plan_every: int = 1
    dp: bool = False
    names: tuple[str, ...] = ()  # of the learned rows; else after loss and shape
    tuned_idm: Idm | None = None  # of a further row
    track: str = "full"  # of the safety filter
    # programs and own costs: names of their rows, "" for their own, and places
    planners: tuple[tuple[str, str], ...] = ()
    mode: str | None = None  # of rows without weights, as in `table_rows`

    def __post_init__(self) -> None:
        """Refuses plans that are never made."""
        if self.plan_every < 1:
            raise InputError(f"plan_every: {self.plan_every}: expected at least 1")

    def rows(self) -> list[Row]:
        """A gate's candidate, learned rows, planners, then the baselines."""
        rows = table_rows(
            self.weights,
            self.baselines,
            dp=self.dp,
            names=self.names,
            track=self.track,
            tuned_idm=self.tuned_idm,
            planners=self.planners,
            mode=self.mode,
        )
        rows.sort(key=lambda row: row.name != CANDIDATE)
        return rows

    def planner_facts(self) -> dict[str, dict[str, str]]:
        """Name and sha256 of each planner by its place, for provenance."""
        found = {}
        for _, place in self.planners:
            one = own_cost(place) if is_place(place) else program(place)
            where = place.removeprefix(PREFIX)
            found[where] = {"name": one.name, "sha256": one.sha256}
        return found

    def cases(self) -> CaseSet:
        """The cases of the catalogue."""
        return catalogue_set(self.refs, self.duration_s)


@functools.lru_cache(maxsize=2)
def _made(job: SuiteJob) -> tuple[dict[str, Row], CaseSet]:
    rows = {row.name: row for row in [*judges(), *job.rows()]}
    return rows, job.cases()


def drive_piece(
    piece: tuple[str, int, int], job: SuiteJob, config: SuiteConfig
) -> Iterator[CaseMetrics]:
    """Metrics of the cases first .. last - 1 with the row of a name."""
    name, first, last = piece
    rows, cases = _made(job)
    row = rows[name]
    yield drive_row(
        row,
        lambda a, b: cases.build(first + a, first + b),
        last - first,
        rollout_config(row, cases.duration_s, config.plan_every),
        chunk=config.chunk,
    )


def drive_by(executor: Executor, job: SuiteJob) -> DriveRow:
    """Returns what drives a job's rows; the result does not depend on the executor."""
    if executor.workers == 1:
        return drive_here

    def drive(row: Row, cases: CaseSet, config: SuiteConfig) -> CaseMetrics:
        total, size = len(cases.ids), -(-config.chunk // LANES) * LANES
        # a rest that is shorter would be another shape for the compiler
        pieces = [
            (row.name, first, min(first + size, total))
            for first in range(0, total, size)
        ]
        piece = functools.partial(drive_piece, job=job, config=config)
        parts = []
        with bar_of(row, total) as bar:
            for made in executor.stream(piece, pieces):
                parts.append(made)
                bar.update(len(np.asarray(jax.tree.leaves(made)[0])))
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)

    return drive


def run_job(job: SuiteJob, executor: Executor) -> SuiteResult:
    """Drives a job's rows over its catalogue cases, wherever the executor runs them."""
    config = SuiteConfig(plan_every=job.plan_every)
    return run_suite(job.rows(), job.cases(), config, drive_by(executor, job))


def gate_baselines(candidate: str, config: GateConfig) -> tuple[str, ...]:
    """Returns a gate's baselines: IDM, MOBIL if paths are planned, trivial ones.

    Args:
      candidate: weights file, or a program that plans.
      config: names the trivial ones.
    """
    learned = not is_program(candidate) and Path(candidate).is_file()
    steers = learned and open_reward(candidate).mode == "path_speed"
    trivial = [name for name in config.trivial_baselines if name in KNOWN_BASELINES]
    return ("IDM", *([MOBIL_ROW] if steers else []), *trivial)


def write_tuned_idm(path: Path, idm: Idm) -> None:
    """Write the file, whole or not at all."""
    write_json(path, {name: float(getattr(idm, name)) for name in FIELDS})


def read_tuned_idm(path: Path) -> Idm:
    """The driver model of a file.

    Raises:
      InputError: unreadable, or a field that is missing, unknown, or not a finite
        number above 0; one line naming it.
    """
    found = checked(read_json(path, "JSON, a tuned IDM"), _IDM, path)
    return Idm(**msgspec.structs.asdict(found))


def gate_job(
    candidate: str,
    incumbent: str,
    *,
    suite: str,
    cases: int | None,
    duration_s: float | None,
    catalogue_seed: int,
    plan_every: int,
    baselines: Sequence[str] = ("IDM",),
    tuned_idm: Idm | None = None,
    track: str = "full",
    beside: Mapping[str, str] | None = None,
) -> tuple[SuiteJob, str]:
    """The suite that both drive, and the name of the incumbent's row.

    Args:
      candidate: weights file, place of an own cost (`planner.own_cost`), or a program
        that plans (`planner.program`).
      incumbent: one of these, or the name of a baseline.
      suite: full, smoke, or families with commas.
      cases: per family; None: as declared.
      duration_s: of a case; None: 120 s, smoke 20 s.
      catalogue_seed: of the cases.
      plan_every: steps of 0.1 s between two plans.
      baselines: further baselines.
      tuned_idm: of a further row.
      track: of the safety filter, `SafetyConfig.track`.
      beside: further rows: name -> weights file.

    Raises:
      InputError: a duration, suite or count that cannot be.
    """
    duration = case_duration(suite, duration_s)
    files: dict[str, str] = {}  # by name of the row, as planners
    planners: list[tuple[str, str]] = []
    rows = [*baselines]
    if is_program(candidate) or is_place(candidate):
        checked_planner(candidate)
        planners.append((CANDIDATE, candidate))
    else:
        files[CANDIDATE] = candidate  # which a tuning has yet to make
    name = INCUMBENT
    if is_place(incumbent):
        name = checked_own_cost(incumbent).name
        planners.append((name, incumbent))
    elif is_program(incumbent):
        checked_program(incumbent)
        planners.append((INCUMBENT, incumbent))
    elif incumbent in KNOWN_BASELINES:
        name, rows = incumbent, [incumbent, *rows]
    else:
        files[INCUMBENT] = weights_file(incumbent, "incumbent", KNOWN_BASELINES)
    files |= beside or {}
    job = SuiteJob(
        weights=tuple(files.values()),
        names=tuple(files),
        baselines=tuple(dict.fromkeys(rows)),
        refs=suite_refs(suite, cases, catalogue_seed),
        duration_s=duration,
        plan_every=plan_every,
        tuned_idm=tuned_idm,
        track=track,
        planners=tuple(planners),
    )
    return job, name


def weights_file(name: str, what: str, others: Sequence[str] = ()) -> str:
    """Returns the name of a file that may be weights.

    Raises:
      InputError: there is none, or it is code; says what else `what` may be.
    """
    is_there = Path(name).is_file()
    if is_there and Path(name).suffix not in (".py", ".c", ".cc", ".cpp", ".so"):
        return name
    kinds = ["a weights file", "FILE.py:FUNCTION or FILE.so of an own cost"]
    kinds += ["planner:COMMAND", *others]
    missing = "" if is_there else "no such file: "
    known = f"{', '.join(kinds[:-1])} or {kinds[-1]}"
    raise InputError(f"{what}: {name}: {missing}expected {known}")


CHECKED_PER_FAMILY = 10  # scenes of a family that own costs and terms are asked about


@functools.cache
def checked_own_cost(place: str) -> OwnCost:
    """The own cost at a place, asked about the first scenes of the catalogue.

    Raises:
      InputError: there is none, or no planner could rank by it (`check_own_cost`).
    """
    cost = own_cost(place)
    check_own_cost(cost, *_asked_about(), KNOWN_BASELINES)
    return cost


def _asked_about() -> tuple[Scene, Candidates]:
    """The first scenes of the catalogue and their candidates, leaves [n, ...]."""
    cases = build(suite_refs("full", CHECKED_PER_FAMILY, seed=1), 1.0)
    scenes = first_scenes(cases)
    keys = jax.random.split(jax.random.key(0), len(cases.steps))
    draw = jax.jit(jax.vmap(lambda key, scene: sample(key, scene, ONLINE)))
    return scenes, draw(keys, scenes)


def write_own_terms(path: Path, train: TrainConfig) -> Reward:
    """Writes own terms with given weights, `train.reward.today`, as a weights file.

    The terms are asked about the first scenes of the catalogue before.

    Args:
      path: file to write.
      train: `features` are the place of own terms, whose weights are learned.

    Raises:
      InputError: a term is not finite of a feasible candidate, or today's cost is the
        same for all candidates of most scenes.
    """
    features = feature_map(train.features)
    scenes, candidates = _asked_about()
    one = jax.tree.map(lambda x: x[0], (scenes, candidates))
    jax.eval_shape(features.of_candidates, *one)  # finds out whether JAX traces them
    if features.own and features.own.is_called_back:
        rows = features.own.called(scenes, candidates.trajectory)  # [S, F, T, K]
        x = rows.transpose(0, 3, 2, 1)
    else:
        x = np.asarray(jax.jit(jax.vmap(features.of_candidates))(scenes, candidates))
    feasible = np.asarray(candidates.feasible)
    wrong = ~np.isfinite(x).all(axis=2) & feasible[..., None]
    if wrong.any():
        scene, which, term = np.argwhere(wrong)[0]
        raise InputError(
            f"{features.preset}: {features.names[term]}: scene {scene}, candidate "
            f"{which}: expected a finite number for every feasible candidate"
        )
    cost = np.where(feasible, x.mean(axis=2) @ train.reward.today, np.nan)
    alike = np.nanmax(cost, axis=1) == np.nanmin(cost, axis=1)
    if np.mean(alike) > 0.5:
        raise InputError(
            f"{features.preset}: in {np.mean(alike):.0%} of {len(alike)} scenes all "
            "candidates cost the same today: expected terms that tell them apart"
        )
    rows = x[feasible].reshape(-1, features.num_features)
    normaliser = fit_normaliser(rows, features, train.reward.today)
    some = x[np.arange(NUM_SAMPLES), 0]
    provenance = {
        **dict.fromkeys(PROVENANCE_KEYS),
        "mode": train.sampler.mode,
        "metrics": {},
    }
    write_weights(
        path,
        init_params(jax.random.key(0), features.num_features, train.reward),
        normaliser,
        train,
        (some, np.ones(some.shape[:2], bool)),
        provenance,
        seen_range(rows, features),
    )
    return open_reward(str(path))


@functools.cache
def checked_sampler(config: SamplerConfig) -> SamplerConfig:
    """A sampler, asked about the first scenes of the catalogue if it is a user's own.

    Raises:
      InputError: there is none, or no planner could choose from its candidates
        (`check_own_sampler`).
    """
    if config.own:
        cases = build(suite_refs("full", CHECKED_PER_FAMILY, seed=1), 1.0)
        scenes = first_scenes(cases)
        keys = jax.random.split(jax.random.key(0), len(cases.steps))
        draw = jax.jit(jax.vmap(lambda key, scene: sample(key, scene, config)))
        made = draw(keys, scenes)
        check_own_sampler(config.own, config.mode == "speed", scenes, keys, made)
    return config


def checked_planner(place: str) -> Program | OwnCost:
    """The own cost or the program at a place, asked about scenes of the catalogue.

    Raises:
      InputError: there is none, or it gives no costs or plans.
    """
    return checked_own_cost(place) if is_place(place) else checked_program(place)


@functools.cache
def checked_program(place: str) -> Program:
    """The program at a place, asked about the first scene of every family.

    Raises:
      InputError: there is none, or an answer that is no plan.
    """
    one = program(place)
    refs = suite_refs("smoke", 1)
    catalogue_set(refs, 1.0)  # says how the cases are called
    cases = build(refs, 1.0)
    scenes = jax.tree.map(np.asarray, first_scenes(cases))
    check_program(one, scenes, np.asarray(cases.seed))
    return one


def drive_job(job: SuiteJob, executor: Executor) -> SuiteResult:
    """Drive the suite wherever the executor runs it, and the first cases twice.

    Raises:
      InputError: the candidate's drives do not repeat.
    """
    result = run_job(job, executor)
    repeats(job.rows()[0], result, SuiteConfig(plan_every=job.plan_every))
    return result


@dataclasses.dataclass(frozen=True, kw_only=True)
class Judged:
    """A verdict and what it rests on."""

    verdict: Verdict
    likeness: LikenessReport | None  # of the held-out drives, if there are any
    facts: Mapping[str, object]  # of the suite: hashes, memory


def judged(
    job: SuiteJob,
    incumbent: str,
    config: GateConfig,
    executor: Executor,
    sources: Sequence[Dataset] = (),
    drives: int = DRIVES,
) -> Judged:
    """Drive a gate's job and judge it.

    Args:
      job: of `gate_job`.
      incumbent: name of its row.
      config: margins.
      executor: where cases are driven.
      sources: datasets whose held-out drives measure human-likeness.
      drives: of them, in all.

    Raises:
      InputError: drives that do not repeat, too few cases or held-out drives.
    """
    if drives < 1:
        raise InputError(f"drives: {drives}: expected at least 1")
    if CANDIDATE in job.names:
        weights_file(job.weights[job.names.index(CANDIDATE)], CANDIDATE)
    result, report = drive_job(job, executor), None
    if sources:
        recorded = held_out(sources, drives)
        report = held_out_likeness(recorded, job.rows(), job.plan_every, incumbent)
    known = None if report is None else report.likeness
    if report and any(report.rows[x].not_driven for x in (CANDIDATE, incumbent)):
        known = None  # its text says how many drives there are no distances of
    pair = Pair(runs=result, name=incumbent, likeness=known)
    verdict = judge(pair, config, left_out(job))
    facts = {**result.facts, **suite_facts(job)}
    return Judged(verdict=verdict, likeness=report, facts=facts)


def suite_facts(job: SuiteJob) -> dict[str, object]:
    """Returns what a verdict states of the suite: files' hash, who plans paths."""
    names = dict.fromkeys(ref.family for ref in job.refs)
    paths = [row.name for row in job.rows() if row.steers]
    return {"families_sha256": families_sha256(names), "plan_paths": paths}


def left_out(job: SuiteJob) -> str:
    """Says how a job departs from the full suite; "" if it does not."""
    said = [left_out_of_suite((ref.family, ref.index) for ref in job.refs)]
    if job.duration_s < FULL_S:
        said.append(f"cases of {job.duration_s:g} s instead of {FULL_S:g} s")
    if job.plan_every > 1:
        said.append(f"a plan every {job.plan_every * STEP_S:g} s instead of {STEP_S:g}")
    if job.track != "full":
        said.append("a safety filter that only forbids collisions")
    return "; ".join(filter(None, said))
