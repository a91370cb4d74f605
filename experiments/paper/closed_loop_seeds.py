"""RC-IRL against the GAN in the closed loop, over training seeds.

    python -m experiments.paper.closed_loop_seeds --data=DRIVES[,DRIVES] --output=DIR

Both are trained on the same drives (`experiments.drive_logs`, or the folders drives
and takeovers of `experiments.paper.table2`) with every seed, as table II trains them,
and drive the same catalogue cases beside hand-set and IDM. Differences are paired by
case; their intervals resample families and seeds together, as `human_likeness`
resamples vehicles and seeds. Weights that are there are kept and reused.
Expected with three seeds of each loss and 230 cases of 120 s: 45 minutes of a core
with the drives of table II; RC-IRL goes 5 % farther, which three seeds do not settle,
and no other measure tells the two apart.
`--quick`: two minutes, numbers without meaning.
"""

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from absl import flags

from experiments.common import run
from experiments.paper.common import (
    DATA,
    OUTPUT,
    QUICK,
    dataset,
    picture,
    unread,
    write,
)
from experiments.paper.weights import QUICK_S, drives_config, trained_weights
from rcirl_jax.data.store.joined import open_datasets
from rcirl_jax.evaluation.closed_loop.suite import SuiteConfig, SuiteResult, run_suite
from rcirl_jax.evaluation.exact import holm
from rcirl_jax.evaluation.statistics import (
    Difference,
    combine_seeds,
    family_clusters,
    paired_difference,
)
from rcirl_jax.export.closed_loop import table_rows
from rcirl_jax.report.ranking.intervals import interval_chart
from rcirl_jax.simulation.metrics import COLUMNS, CaseMetrics, nuplan_score
from rcirl_jax.simulation.suite import FULL_S, catalogue_set, suite_refs

_RUNS = flags.DEFINE_integer("runs", 3, "training seeds of each loss", lower_bound=2)
_CASES = flags.DEFINE_integer("cases", 10, "of each family", lower_bound=1)
_SEED = flags.DEFINE_integer("catalogue_seed", 0, "of the cases", lower_bound=0)
# `drives_config` says how
unread("recipe", "seeds", "epochs", "horizon", "positive")

LOSSES = {"RC-IRL": "rank", "GAN": "gan"}
RIVALS = ("hand-set", "IDM")
UNITS = {**{name: "share of drives" for name in COLUMNS}, "progress": "m"}
UNITS |= {"no fault": "share of drives", "nuPlan": "score"}
# drawn: (unit, how many of the measure's)
DRAWN = {
    "a_station": ("share of drives", 1.0),
    "j_station": ("share of drives", 1.0),
    "progress": ("km", 1000.0),
    "nuPlan": ("score", 1.0),
}


def _measures(metrics: CaseMetrics, way: np.ndarray) -> dict[str, np.ndarray]:
    """[C] of every measure of one row."""
    holds = np.asarray(metrics.holds, np.float64)
    found = {name: holds[:, i] for i, name in enumerate(COLUMNS)}
    found["no fault"] = np.asarray(metrics.at_fault) == 0
    found["progress"] = np.asarray(metrics.progress)
    found["nuPlan"] = np.asarray(nuplan_score(metrics, jnp.asarray(way))[0])
    return {name: np.asarray(x, np.float64) for name, x in found.items()}


def _by_row(
    result: SuiteResult, names: Mapping[str, Sequence[str]]
) -> dict[str, dict[str, np.ndarray]]:
    """Row -> measure -> [runs, C], from the names of each row's runs."""
    rows = {}
    for row, own in names.items():
        runs = [_measures(result.runs[name], result.way) for name in own]
        rows[row] = {key: np.stack([x[key] for x in runs]) for key in UNITS}
    return rows


def differences(
    rows: Mapping[str, Mapping[str, np.ndarray]], a: str, b: str, cluster: np.ndarray
) -> dict[str, tuple[Difference, float]]:
    """Measure -> (a minus b, p after Holm over the measures that differ at all)."""
    found = {}
    for key in UNITS:
        pair = rows[a][key], rows[b][key]
        found[key] = paired_difference(*pair, cluster)
    asked = [key for key, d in found.items() if d.se > 0.0]
    adjusted = holm(np.array([found[key].p for key in asked])) if asked else []
    p = {key: float(x) for key, x in zip(asked, adjusted, strict=True)}
    return {key: (d, p.get(key, 1.0)) for key, d in found.items()}


def main() -> None:
    """Train, drive, compare, draw."""
    quick, folder = QUICK.value, Path(OUTPUT.value)
    runs, cases = (2, 1) if quick else (_RUNS.value, _CASES.value)
    data = open_datasets(DATA.value.split(",")) if DATA.value else dataset()
    files: list[str] = []
    names: dict[str, list[str]] = {row: [] for row in LOSSES}
    for row, loss in LOSSES.items():
        for seed in range(runs):
            config = drives_config(quick=quick, seed=seed, loss=loss)
            # other data or settings are other files
            key = hashlib.sha256(f"{data.hash} {config}".encode()).hexdigest()[:8]
            name = f"{loss}_{seed}_{key}"
            file = trained_weights(folder, name, lambda: data, config)
            files.append(str(file))
            names[row].append(f"{row} (seed {seed})")
    which, duration = (
        ("free_cruise,stopped_lead", QUICK_S) if quick else ("full", FULL_S)
    )
    refs = suite_refs(which, cases, _SEED.value)
    drivers = table_rows(
        files, RIVALS, names=[x for own in names.values() for x in own]
    )
    result = run_suite(drivers, catalogue_set(refs, duration), SuiteConfig())
    names |= {row: [row] for row in RIVALS}
    rows, cluster = _by_row(result, names), family_clusters(result.cases.groups)
    table = {
        row: {key: combine_seeds(x, cluster) for key, x in found.items()}
        for row, found in rows.items()
    }
    tests = {
        f"{a} minus {b}": differences(rows, a, b, cluster)
        for a, b in (("RC-IRL", "GAN"), ("RC-IRL", "hand-set"), ("GAN", "hand-set"))
    }
    for words, found in tests.items():
        for key, (d, p) in found.items():
            apart = f"{d.mean:+.3f} [{d.low:+.3f}, {d.high:+.3f}]"
            print(f"{words}: {key}: {apart} {UNITS[key]}, Holm p {p:.3f}")
    interval_chart(
        picture("closed_loop_seeds"),
        {key: (key, unit) for key, (unit, _) in DRAWN.items()},
        {
            row: {
                key: (found[key].value / of, found[key].low / of, found[key].high / of)
                for key, (_, of) in DRAWN.items()
            }
            for row, found in table.items()
        },
        3.2,
    )
    trained = drives_config(quick=quick)
    body = {
        "trained": {"epochs": trained.epochs, "positive": trained.positive},
        "cases": len(result.cases.ids),
        "duration_s": duration,
        "rows": {
            row: {k: dataclasses.asdict(e) for k, e in found.items()}
            for row, found in table.items()
        },
        "runs": {
            row: {key: x.mean(axis=1).tolist() for key, x in found.items()}
            for row, found in rows.items()
        },
        "tests": {
            words: {
                k: {**dataclasses.asdict(d), "p_holm": p} for k, (d, p) in x.items()
            }
            for words, x in tests.items()
        },
    }
    write("closed_loop_seeds", body, data, files, runs=runs, cases=cases)


if __name__ == "__main__":
    run(main)
