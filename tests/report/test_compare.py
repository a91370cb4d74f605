"""Runs side by side: what differs, their numbers, files that were changed."""

import json
import re

import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.gate.types import GateConfig
from rcirl_jax.evaluation.gate.verdict import write_verdict
from rcirl_jax.evaluation.statistics import clopper_pearson
from rcirl_jax.report.compare import read_run
from rcirl_jax.runtime.pipeline import file_sha256
from tests.helpers.commands import succeeded
from tests.report.test_data_page import Page
from tests.report.tuning_case import suite_and_verdict


def write_run(
    folder, *, recipe="tuned", rate=0.01, data="ab" * 32, nuplan=0.9, drives=True
):
    """A run folder with the files that a comparison reads, made up."""
    _, verdict = suite_and_verdict()
    (folder / "suite").mkdir(parents=True)
    write_verdict(folder / "verdict.json", verdict, GateConfig(), {})
    row = {
        "at_fault": 12, "nuplan": nuplan,
        "nuplan_low": nuplan - 0.02, "nuplan_high": nuplan + 0.01,
    }  # fmt: skip
    config = {"learning_rate": rate, "reward": {"hidden": [32, 16]}}
    flags = {"recipe": recipe, "drives": 240, "output": str(folder)}
    stage = {"key": "", "outputs": {}}
    stages = {
        "train 0": {**stage, "inputs": {"config": config, "dataset": data}},
        "gate": {
            **stage, "inputs": {"incumbent": "hand-set"},
            "made_by": {"flags": flags, "git_commit": "c0ffee"},
        },
    }  # fmt: skip
    top1 = {"value": 2.5, "low": 2.3, "high": 2.7}
    distance = {"distance_m": {"mean": 1.6, "low": 1.2, "high": 2}}
    for name, rows_of in {
        "suite/suite.json": {"report": {"rows": {"candidate": row}}},
        "likeness.json": {"rows": {"candidate": distance}},
        "ranking.json": {"rows": {"candidate": {"top1_fde": top1}}},
    }.items():
        if drives or name != "likeness.json":
            (folder / name).write_text(json.dumps(rows_of))
    made = [x for x in folder.rglob("*.json")]
    names = {x.relative_to(folder).as_posix(): file_sha256(x) for x in made}
    stages["gate"]["outputs"] = names
    body = {"schema_version": 1, "stages": stages}
    (folder / "stages.json").write_text(json.dumps(body))
    return folder, verdict


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """The page of two runs, its path, and the verdict of both."""
    folder = tmp_path_factory.mktemp("runs")
    first, verdict = write_run(folder / "first")
    second, _ = write_run(
        folder / "second", recipe="paper", rate=0.02, data="cd" * 32, nuplan=0.8,
        drives=False,
    )  # fmt: skip
    page = folder / "compare.html"
    succeeded("rcirl_jax", "compare", str(first), str(second), f"--output={page}")
    return page, verdict


def rows(page):
    return [row for row in Page(page.read_text()).rows if row]


def test_settings_that_differ_and_no_others(compared):
    found = {row[0]: row[1:] for row in rows(compared[0])}
    assert found["recipe"] == ["tuned", "paper"]
    assert found["data, sha256"] == ["ab" * 6, "cd" * 6]
    assert found["commit"] == ["c0ffee", "c0ffee"]
    assert found["training: learning_rate"] == ["0.01", "0.02"]
    assert not any("hidden" in name or "drives" in name for name in found)


def test_numbers_of_the_runs_with_their_intervals(compared):
    page, verdict = compared
    first, second = (
        [row[-1] for row in rows(page) if row[0].endswith(name) and len(row) == 3]
        for name in ("/first", "/second")
    )
    gains = {c.name: c.difference for c in verdict.checks if c.kind == "gain"}
    low, high = (100.0 * x for x in clopper_pearson(12, 120))
    assert first[0] == "90.0 [88.0, 91.0] points"
    assert second[0] == "80.0 [78.0, 81.0] points"
    for cell, name in zip(first[1:3], ("rms_a", "progress"), strict=True):
        assert float(re.match(r"[+−][\d.]+", cell)[0].replace("−", "-")) == (
            pytest.approx(100.0 * gains[name], abs=0.051)
        )
    assert first[3] == f"10.00 [{low:.2f}, {high:.2f}] %"
    assert first[4:] == ["1.60 [1.20, 2.00] m", "2.50 [2.30, 2.70] m"]
    assert second[4] == "not measured"


@pytest.mark.parametrize("name", ["verdict.json", "likeness.json"])
def test_a_file_that_was_edited_or_removed_is_refused(name, tmp_path):
    run, verdict = write_run(tmp_path / "run")
    assert read_run(run).decision == verdict.decision
    path = run / name
    path.write_text(path.read_text().replace(verdict.decision, "ship") + " ")
    with pytest.raises(InputError, match=f"{name}: changed since the run wrote it"):
        read_run(run)
    path.unlink()
    with pytest.raises(InputError, match=r"no verdict|changed since"):
        read_run(run)
