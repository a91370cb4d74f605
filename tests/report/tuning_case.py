"""A small tuning report with everything in it: two rewards, drives, a sweep."""

import dataclasses
import json

import numpy as np

from rcirl_jax.data.importing import import_logs
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.evaluation.closed_loop.dial import FEW_SETTINGS, compare_settings
from rcirl_jax.evaluation.closed_loop.summary import SuiteRuns
from rcirl_jax.evaluation.gate.types import GateConfig, Pair
from rcirl_jax.evaluation.gate.verdict import judge
from rcirl_jax.evaluation.ranking.metrics import Outcomes, random_scorer, scene_metrics
from rcirl_jax.evaluation.ranking.report import Ranked, build_report
from rcirl_jax.export.loading import open_reward
from rcirl_jax.report.tuning_page import TuningReport
from rcirl_jax.simulation.metrics import COLUMNS, CaseMetrics
from rcirl_jax.simulation.rows import rule_row
from rcirl_jax.simulation.suite import catalogue_set, suite_refs
from tests.data.small_logs import CONFIG, write_logs
from tests.helpers.stored import sweep_result
from tests.helpers.weights_files import random_weights

FAMILIES, EACH = ("stop_and_go", "cut_in", "red_light"), 40
PLAYED = ("stop_and_go/001@0", "red_light/000@0")
SECONDS = 5.0
SHARE = {"moments": 20, "share": 0.25, "low": 0.1, "high": 0.4, "apart_m": 2.0}
ONE_CLUSTER = {**SHARE, "low": None, "high": None}
DECIDED = {
    "sites": {"all": SHARE, "0: US-101": ONE_CLUSTER},
    "families": {"all": SHARE, "cut_in": SHARE, "traffic": {**SHARE, "share": 0.5}},
}
WARNINGS = {"training": ["too few steps"], "sweep": ["its best is no better"]}


def metrics(seed, spoiled=None):
    """Made-up numbers of faultless drives; one family may be spoiled."""
    rng, count = np.random.default_rng(seed), len(FAMILIES) * EACH
    samples = 1200 * np.ones(count)
    values = {f.name: np.zeros(count) for f in dataclasses.fields(CaseMetrics)}
    holds = rng.uniform(size=(count, len(COLUMNS))) < 0.9
    holds[:, :2] = True
    faults = np.zeros(count)
    if spoiled is not None:
        first = FAMILIES.index(spoiled) * EACH
        faults[first : first + 12] = 1
    holds[faults > 0] = False
    values |= {
        "samples": samples, "inside": (samples[:, None] - 9 * ~holds).astype(int),
        "inside_filtered": np.tile(samples[:, None], 2).astype(int),
        "holds": holds, "holds_filtered": holds[:, 4:],
        "at_fault": faults, "collisions": faults, "no_fault": 1.0 - faults,
        "progress": 1000.0 * rng.uniform(0.8, 1.2, size=count),
        "rms_a": rng.uniform(0.7, 0.9, count), "rms_j": rng.uniform(0.5, 0.8, count),
        "min_ttc": rng.uniform(1.0, 9.0, size=count),
    }  # fmt: skip
    good = ("drivable", "direction", "ttc_bound", "speed_compliance", "comfort")
    return CaseMetrics(**{**values, **dict.fromkeys(good, np.ones(count))})


def suite_and_verdict():
    """The suite's drives and the gate's verdict of the same made-up drives."""
    names = [name for name in FAMILIES for _ in range(EACH)]
    ids = [f"{name}/{i % EACH:03d}@0" for i, name in enumerate(names)]
    spoiled = metrics(0, "stop_and_go")
    runs = {"candidate": spoiled, "hand-set": metrics(1), "IDM": metrics(2)}
    none, way = np.zeros(len(names), bool), np.full(len(names), 1100.0)
    suite = SuiteRuns(
        rows=runs, ids=tuple(ids), groups=tuple(names), preventable=none, trivial=none,
        reference="IDM", way=way,
    )  # fmt: skip
    pair = Pair(runs=dataclasses.replace(suite, preventable=~none), name="hand-set")
    verdict = judge(pair, GateConfig())
    return suite, dataclasses.replace(verdict, look_at=(*PLAYED, *verdict.look_at[:4]))


def ranking():
    rng, shape = np.random.default_rng(0), (60, 8)
    fde, every = rng.gamma(2.0, 2.0, shape), np.ones(shape, bool)
    outcomes = Outcomes(
        fde=fde, ade=0.4 * fde, crash=~every, feasible=every,
        cluster=np.arange(60) % 12, human_crash=np.zeros(60, bool),
    )  # fmt: skip
    table = {"candidate": [scene_metrics(-fde, np.ones(60), outcomes)]}
    table["random"] = [scene_metrics(*random_scorer(0, shape), outcomes)]
    return build_report(Ranked(table=table, outcomes=outcomes), num_resamples=200)


def dial_result():
    """A run's dial.json of made-up drives."""
    families = np.repeat(FAMILIES, EACH)
    vehicles = np.arange(20) // 2
    found = compare_settings(
        {x: metrics(number) for number, x in enumerate(FEW_SETTINGS)},
        families, np.full(families.size, 1100.0),
        {x: np.random.default_rng(3).gamma(2.0, 2.0, 20) - x for x in FEW_SETTINGS},
        vehicles,
    )  # fmt: skip
    files = {0.5: "dials/0.5.msgpack", 1.0: "weights.msgpack", 2.0: "dials/2.msgpack"}
    return {
        "own_cost": "hand-set", "cases": families.size, "families": len(FAMILIES),
        "duration_s": 120.0, "drives": 20, "vehicles": 10,
        "settings": [
            {"dial": x, "gain": [0.3 * x, 2.0 * x], "file": files.get(x), "measures": y}
            for x, y in found.items()
        ],
    }  # fmt: skip


def small_report(folder, replays):
    """The report; everything but the drives, the frames and the features is made up."""
    import_logs(write_logs(folder / "logs", 4), folder / "set", CONFIG)
    candidate = open_reward(str(random_weights(folder / "candidate.msgpack", 2)))
    kernels = (np.roll(candidate.kernels[0], 3, axis=0), *candidate.kernels[1:])
    incumbent = dataclasses.replace(
        candidate, kernels=kernels, gamma=candidate.gamma[::-1], file="incumbent"
    )
    workdir = folder / "run"
    workdir.mkdir()
    lines = [
        {"step": i, "loss": 1.0 / i, "pair_accuracy": 0.8, "queries_per_s": 1e5}
        for i in range(1, 9)
    ]
    (workdir / "metrics.jsonl").write_text("\n".join(map(json.dumps, lines)))
    suite, verdict = suite_and_verdict()
    return TuningReport(
        likeness="row  distance m\ncandidate  1.75\n", verdict=verdict,
        gate=GateConfig(), suite=suite, incumbent="hand-set", ranking=ranking(),
        rewards={"candidate": candidate, "incumbent": incumbent},
        dataset=open_dataset(folder / "set"), replays=replays, workdir=workdir,
        sweep=sweep_result(), dial=dial_result(), decided=DECIDED, training_runs=3,
        warnings=WARNINGS,
        facts={"flags": {"seed": 3}, "git_commit": "abc", "stages": {"train": "12ef"}},
    )  # fmt: skip


def cheap_rows():
    """Rows that compile fast; the candidate drives blindly on and crashes."""
    return [rule_row("candidate", "constant speed"), rule_row("hand-set", "IDM")]


def small_cases():
    refs = [ref for ref in suite_refs("stop_and_go,red_light", 2) if ref.id in PLAYED]
    return catalogue_set(refs, SECONDS)
