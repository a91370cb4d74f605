"""Table II of the paper: closed-loop rates of every row, from drives to table.

    python -m experiments.paper.table2 --output=DIR [--quick]

    drives     a driver model drives catalogue cases of another seed
    weights    RC-IRL 21-15-1 is trained on them and drives, the driver takes over;
               RC-IRL, the GAN and linear RC-IRL are trained on both sets
    table      every row over the suite; DP rows on `--dp_cases` of each family
    recorded   with --input: the same rows and the recorded human on its drives

Finished parts are kept and reused. Expected: two hours on one core,
most of it the suite; RC-IRL above the paper's row per sample, with few faults, over
families ahead of IDM and not to be told from hand-set. `--quick` makes the same
files from a few cases in about two minutes; its numbers mean nothing.
"""

import functools
from collections.abc import Sequence
from pathlib import Path

from absl import flags

from experiments.common import alone, made_by_file, provenance, run
from experiments.paper.weights import QUICK_S, drives_config, trained_weights
from rcirl_jax.data.importers import IMPORTERS
from rcirl_jax.data.parts import Part, parts_of, recordings_of_all
from rcirl_jax.data.store.joined import open_datasets
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.suite import SuiteConfig, run_suite, write_suite
from rcirl_jax.export.closed_loop import table_rows
from rcirl_jax.report.ranking.intervals import suite_chart
from rcirl_jax.reward import RewardConfig
from rcirl_jax.runtime.atomic_files import read_json, write_json
from rcirl_jax.simulation.cases import STEP_S
from rcirl_jax.simulation.demonstrations import DriveConfig, drive_catalogue
from rcirl_jax.simulation.recorded.config import RecordedConfig
from rcirl_jax.simulation.rows import BASELINES, human_row
from rcirl_jax.simulation.suite import (
    FULL_S,
    CaseSet,
    catalogue_set,
    recorded_set,
    suite_refs,
)

_OUTPUT = flags.DEFINE_string("output", "out/table2", "folder for everything")
_WEIGHTS = flags.DEFINE_list("weights", None, "weights files instead of training")
_INPUT = flags.DEFINE_string("input", None, "recordings for the recorded rows")
_FORMAT = flags.DEFINE_enum("format", "commonroad", sorted(IMPORTERS), "of --input")
_DP_CASES = flags.DEFINE_integer("dp_cases", 2, "cases per family of the DP rows")
_EVERY = flags.DEFINE_integer("plan_every", 1, "steps of 0.1 s between two plans")
_SEED = flags.DEFINE_integer("seed", 0, "of training", 0)
_QUICK = flags.DEFINE_bool("quick", False, "a few short cases and one epoch")

# rows that are trained; what differs from the paper's own
LEARNED: dict[str, dict] = {
    "rcirl": {},
    "gan": {"loss": "gan"},
    "linear": {"reward": RewardConfig(hidden=())},
}


def _same_run(folder: Path) -> None:
    """Parts are reused, but not those of a quick run or of another seed."""
    made, file = {"quick": _QUICK.value, "seed": _SEED.value}, folder / "run.json"
    before = read_json(file, "the flags of a run") if file.exists() else made
    found = {name: before.get(name) for name in made}
    if found != made:
        raise InputError(
            f"{folder}: made with {found}: expected {made}, or a new folder"
        )
    folder.mkdir(parents=True, exist_ok=True)
    write_json(file, {**made, "made_by": provenance(_WEIGHTS.value or ())})


def _drives(folder: Path, seed: int, learner: Path | None) -> Path:
    """The demonstrations, made once."""
    if not (folder / "manifest.json").exists():
        duration = 40.0 if _QUICK.value else FULL_S
        config = DriveConfig(duration_s=duration, stride_s=1.0 if learner else 3.0)
        refs = suite_refs("full", 1 if _QUICK.value else 60, seed)
        row = None
        if learner:
            row = table_rows([str(learner)], (), round(config.period_s / STEP_S))[0]
        by = (row.policy, row.params) if row else None
        note = made_by_file([str(learner)] if learner else [])
        drive_catalogue(refs, folder, config, learner=by, before_commit=note)
    return folder


def _weights(folder: Path, name: str, data: Sequence[Path]) -> Path:
    """One shape trained on drives and exported, made once."""
    changes = LEARNED[name.split("-")[0]]
    config = drives_config(quick=_QUICK.value, seed=_SEED.value, **changes)
    opened = functools.partial(open_datasets, [str(path) for path in data])
    return trained_weights(folder, name, opened, config)


def _trained(folder: Path) -> list[str]:
    first = _drives(folder / "drives", 1000, None)
    start = _weights(folder, "rcirl-first", [first])
    takeovers = _drives(folder / "takeovers", 2000, start)
    return [str(_weights(folder, name, [first, takeovers])) for name in LEARNED]


def _table(
    name: str,
    cases: CaseSet,
    weights: Sequence[str],
    *,
    dp: bool = False,
    logs: Sequence[Part] = (),
) -> None:
    """FOLDER/NAME; with `logs`, whose drives the cases are, also the human's row."""
    rivals = ("hand-set", "IDM") if dp else BASELINES
    rows = table_rows(weights, rivals, _EVERY.value, dp=dp)
    rows += [human_row()] if logs else []
    folder, made_by = Path(_OUTPUT.value) / name, provenance(weights, logs=logs)
    result = run_suite(rows, cases, SuiteConfig(plan_every=_EVERY.value))
    print(f"--- {name}\n{write_suite(result, folder, made_by)}")
    suite_chart(folder / "table.png", result.report)


def _logs() -> list[Part]:
    """--input."""
    return parts_of(_FORMAT.value, Path(_INPUT.value)) if _INPUT.value else []


def _recorded(logs: Sequence[Part]) -> CaseSet | None:
    """Cases cut from --input; read first, for what is wrong with it to show at once."""
    config = RecordedConfig(max_cases=5 if _QUICK.value else None)
    return recorded_set(recordings_of_all(logs), config) if logs else None


def main() -> None:
    """All tables, one folder each."""
    if _WEIGHTS.value:
        alone("weights", "seed")
    folder, logs = Path(_OUTPUT.value), _logs()
    recorded = _recorded(logs)
    _same_run(folder)
    weights = _WEIGHTS.value or _trained(folder)
    duration = QUICK_S if _QUICK.value else FULL_S
    full = suite_refs("full", 1 if _QUICK.value else None)
    _table("suite", catalogue_set(full, duration), weights)
    which = "free_cruise,stopped_lead" if _QUICK.value else "full"
    few = suite_refs(which, 1 if _QUICK.value else _DP_CASES.value)
    # a plan by DP takes half a second
    _table("dp", catalogue_set(few, duration), weights[:1], dp=True)
    if recorded:
        _table("recorded", recorded, weights, logs=logs)


if __name__ == "__main__":
    run(main)
