"""A small suite from rows to files: the numbers, their hash, what is refused."""

import csv
import json

import numpy as np
import pytest

from rcirl_jax.evaluation.closed_loop.suite import (
    SuiteConfig,
    run_suite,
    worst_cases,
    write_suite,
)
from rcirl_jax.evaluation.closed_loop.summary import SuiteRuns, summarise
from rcirl_jax.evaluation.statistics import cluster_t
from rcirl_jax.planner.baselines import Idm, Yielding
from rcirl_jax.simulation.metrics import COLUMNS
from rcirl_jax.simulation.rows import rule_row
from rcirl_jax.simulation.suite import catalogue_set, suite_refs
from tests.report.tuning_case import metrics

FAMILIES = "free_cruise,stopped_lead"
ROWS = [
    rule_row("careful", "IDM", Yielding(idm=Idm(headway=2.5, standstill_gap=5.0))),
    rule_row("IDM", "IDM"),
    rule_row("constant speed", "constant speed"),
]


@pytest.fixture(scope="module")
def result():
    cases = catalogue_set(suite_refs(FAMILIES, 3), 20.0)
    return run_suite(ROWS, cases, SuiteConfig(plan_every=2, chunk=4))


def test_rates_are_those_of_the_metrics(result):
    report = result.report
    assert report.cases == 6
    assert set(report.rows) == {row.name for row in ROWS}
    for name, row in report.rows.items():
        metrics = result.rows[name]
        for i, column in enumerate(COLUMNS):
            found = row.per_case[column]
            assert (found.k, found.n) == (metrics.holds[:, i].sum(), 6)
            assert found.low <= found.rate <= found.high
            assert row.per_sample[column].k == metrics.inside[:, i].sum()
        assert row.at_fault == (metrics.at_fault > 0).sum()
    assert report.rows["IDM"].progress_ratio == pytest.approx(1.0)
    assert report.rows["constant speed"].at_fault == 3  # the standing leaders


def test_starts_are_the_cases_with_one():
    """Median and number of the cases with a start on a free road."""
    some, none = metrics(0), metrics(1)
    seconds = np.full(some.samples.size, -1.0)
    runs = {"none": none.replace(start_time=seconds.copy())}
    seconds[:3] = 4.0, 5.5, 30.0
    runs["IDM"] = some.replace(start_time=seconds)
    flags, way = np.zeros(seconds.size, bool), np.full(seconds.size, 1000.0)
    names = [f"family {i % 2}" for i in range(seconds.size)]
    report = summarise(
        SuiteRuns(
            rows=runs, ids=(), groups=tuple(names), preventable=flags, trivial=flags,
            reference="IDM", way=way,
        )
    )  # fmt: skip
    found = {name: row.physical for name, row in report.rows.items()}
    assert [found[name]["starts"] for name in runs] == [0, 3]
    assert [found[name]["start_s_median"] for name in runs] == [-1.0, 5.5]


def test_differences_over_families_are_those_of_family_means(result):
    """Two families of three cases each: Student's t with one degree of freedom."""
    groups = np.asarray(result.cases.groups)
    first = result.rows["careful"]
    for item in result.report.comparisons:
        other = result.rows[item.b]
        assert item.progress_m == cluster_t(first.progress, other.progress, groups)
        share = (first.holds.mean(axis=0) - other.holds.mean(axis=0)).tolist()
        over = [found.mean for found in item.over_families.values()]
        assert over == pytest.approx(share)


def test_files_say_the_same(result, tmp_path):
    text = write_suite(result, tmp_path, {"git": "none"})
    assert (tmp_path / "table.txt").read_text() == text
    assert all(row.name in text for row in ROWS)
    body = json.loads((tmp_path / "suite.json").read_text())
    assert body["report"]["cases"] == 6
    hashes = result.facts["result_sha256"]
    assert len(set(hashes.values())) == len(ROWS)
    with (tmp_path / "cases.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6 * len(ROWS)
    faults = [int(r["at_fault"]) for r in rows if r["row"] == "constant speed"]
    np.testing.assert_array_equal(faults, result.rows["constant speed"].at_fault)
    assert {r["case"] for r in rows} == set(result.cases.ids)
    worst = worst_cases(result, "constant speed", 3)
    assert all(name.startswith("stopped_lead/") for name in worst)
