"""Drive rewards and baselines through the closed-loop suite; print the paper's table.

    rcirl simulate --weights=FILE[,FILE...] --suite=full|smoke|FAMILY --output=DIR
    rcirl simulate --weights=FILE --suite=recorded|heldout --data=DATASET --output=DIR
    rcirl simulate --planner="./my_planner --flag" --suite=smoke --output=DIR
    rcirl simulate --planner=costs.py:my_cost --suite=smoke --output=DIR

Every case is driven at 10 Hz; safety filter and candidates are the same for all
rows. Writes table.txt, suite.json and cases.csv. A case is drawn by `rcirl replay`
from its id. Held-out drives of datasets, up to 8 s among the recorded traffic, have the
recorded human as one of the rows: `recorded` says the same of them as of the other
suites, `heldout` how near to the human each row is (table.txt and likeness.json). A
planner is an own cost (docs/own_cost.md), or any program that speaks the protocol of
docs/own_process.md: its plans are followed as they are, behind no filter of ours.
"""

from pathlib import Path

from absl import flags

from rcirl_jax.cli import flags as shared
from rcirl_jax.cli.running import provenance
from rcirl_jax.data.store.dataset import JoinedDatasets, open_datasets
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.likeness import (
    LikenessReport,
    held_out_likeness,
)
from rcirl_jax.evaluation.closed_loop.suite import (
    SuiteConfig,
    run_suite,
    worst_cases,
    write_suite,
)
from rcirl_jax.evaluation.gate.types import DRIVES
from rcirl_jax.export.closed_loop import (
    SuiteJob,
    checked_planner,
    drive_by,
    read_tuned_idm,
)
from rcirl_jax.export.loading import open_reward
from rcirl_jax.planner.own_cost import OwnCost, words
from rcirl_jax.planner.program import processes_of
from rcirl_jax.planner.safety import TRACKS
from rcirl_jax.runtime.atomic_files import write_json, write_whole
from rcirl_jax.sampling.sampler import MODES
from rcirl_jax.simulation.recorded import held_out
from rcirl_jax.simulation.rows import BASELINES, baselines_of, human_row
from rcirl_jax.simulation.suite import case_duration, recorded_set, suite_refs

USUAL = (
    *("weights", "planner", "output", "suite", "cases", "duration", "data"),
    *("baselines", "tuned_idm", "dp", "workers"),
)
_WEIGHTS = flags.DEFINE_list("weights", [], "weights files, with commas")
_PLANNERS = flags.DEFINE_multi_string(
    "planner",
    [],
    f"{shared.PLANNER}; may be given several times",
)
_DATA = flags.DEFINE_list(
    "data", [], "datasets of --suite=recorded or heldout, with commas"
)
_OUTPUT = flags.DEFINE_string("output", None, "folder to write", required=True)
_BASELINES = flags.DEFINE_list(
    "baselines",
    ",".join(BASELINES),
    "baselines that drive too; fewer are quicker; IDM + MOBIL too where paths are "
    "planned",
)
_IDM = flags.DEFINE_string(
    "tuned_idm", None, "RUN/tuned_idm.json of autotune: a tuned IDM drives too"
)
_DP = flags.DEFINE_bool(
    "dp",
    False,
    "the first weights also drive with dynamic programming, beside the sampled "
    "candidates and alone",
)
_FILTER = flags.DEFINE_enum(
    "filter", "full", TRACKS, "full, or collision: the reward decides the rest"
)
_CHUNK = flags.DEFINE_integer("chunk", 180, "cases driven together; bounds memory")
_MODE = flags.DEFINE_enum(
    "mode",
    None,
    MODES,
    "what baselines that rank candidates plan: speed along the given path, or the path "
    "too; default: what the first weights were trained for",
)
_EXECUTOR = shared.executor()
_CASES = shared.suite("smoke")
OF_DATA = ("recorded", "heldout")  # suites of --data


def main() -> None:
    """Flags -> one suite."""
    if _CHUNK.value < 1:
        raise InputError(f"--chunk: {_CHUNK.value}: expected at least 1")
    asked, places = _CASES.settings(), _EXECUTOR()
    suite, cases, seed = asked["suite"], asked["cases"], asked["catalogue_seed"]
    of_data = suite in OF_DATA
    if of_data and cases is not None and cases < 1:
        raise InputError(f"--cases: {cases}: expected at least 1")
    job = SuiteJob(
        weights=tuple(_WEIGHTS.value),
        baselines=tuple(
            _BASELINES.value if _BASELINES.present else baselines_of(_mode())
        ),
        refs=() if of_data else suite_refs(suite, cases, seed),
        duration_s=case_duration(suite, asked["duration_s"]),
        plan_every=asked["plan_every"],
        dp=_DP.value,
        tuned_idm=read_tuned_idm(Path(_IDM.value)) if _IDM.value else None,
        track=_FILTER.value,
        planners=tuple(("", place) for place in _PLANNERS.value),
        mode=_MODE.value,
    )
    for place in _PLANNERS.value:
        if isinstance(one := checked_planner(place), OwnCost):
            print(words(one))
    if said := shared.idm_left_out(_IDM.value):
        print(said)
    if of_data and places.workers > 1:
        raise InputError(f"--suite: {suite}: expected --workers=1: drives run here")
    if of_data and asked["duration_s"] is not None:
        raise InputError(f"--duration: of --suite={suite}: they last as their records")
    if _DATA.value and not of_data:
        known = " or ".join(OF_DATA)
        raise InputError(f"--data: with --suite={suite}: expected {known}")
    # of the files as they are read, not hours later
    made_by, rows = provenance(_WEIGHTS.value), job.rows()
    if job.planners:
        made_by["planners"] = job.planner_facts()
    if of_data:
        data = open_datasets(_DATA.value)
        made_by["data_hash"] = data.hash
        parts = data.parts if isinstance(data, JoinedDatasets) else [data]
        drives = held_out(parts, cases or DRIVES, seed)
        if suite == "heldout":
            _likeness(held_out_likeness(drives, rows, job.plan_every), made_by)
            return
        driven = recorded_set(drives)
        rows.append(human_row())
    else:
        driven = job.cases()
    config = SuiteConfig(plan_every=job.plan_every, chunk=_CHUNK.value)
    result = run_suite(rows, driven, config, drive_by(places, job))
    print(write_suite(result, Path(_OUTPUT.value), made_by))
    for name, facts in result.timings.items():
        print(f"{name}: {facts['seconds']} s, {facts['plans_per_s']:,} plans/s")
    for row in rows:
        if row.program and (times := processes_of(row.program).times())["answers"]:
            print(
                f"{row.name}: {times['answers']:,} answers, median "
                f"{times['median_ms']:g} ms, 99 % in {times['p99_ms']:g} ms, longest "
                f"{times['longest_ms']:g} ms; {times['failures']} failures"
            )
    print(f"peak memory: {result.facts['peak_memory_gib']} GiB")
    print(f"look first at: {', '.join(worst_cases(result, rows[0].name, 5))}")
    print(f"written: {_OUTPUT.value}/table.txt, suite.json, cases.csv")


def _mode() -> str:
    """Returns the mode of baselines that rank candidates."""
    files = _WEIGHTS.value
    return _MODE.value or (open_reward(files[0]).mode if files else "speed")


def _likeness(report: LikenessReport, made_by: dict) -> None:
    """Every row, and the recorded human, over held-out drives."""
    folder = Path(_OUTPUT.value)
    write_whole(folder / "table.txt", report.text())
    write_json(folder / "likeness.json", {**report.facts, "made_by": made_by})
    print(report.text())
    print(f"written: {_OUTPUT.value}/table.txt, likeness.json")
