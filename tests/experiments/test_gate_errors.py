"""Drivers of known truth: what the gate says of drives that are so by construction."""

import json

import jax
import numpy as np
import pytest

from experiments.known_drivers import (
    FAULTY,
    HAND_SET,
    IDM,
    KINDS,
    OTHER,
    SLOWER,
    made_rows,
    table,
    tallied,
    with_faults,
)
from rcirl_jax.evaluation.closed_loop.summary import SuiteRuns
from rcirl_jax.evaluation.gate.types import GateConfig
from tests.evaluation.gate.test_gate import CASES, broken, drives, pair
from tests.helpers.commands import succeeded

ALONE = GateConfig(trivial_baselines=())


@pytest.fixture(scope="module")
def suite():
    """Two seeds of 2,000 cases as the rows leave them; IDM is at fault in 40."""
    hand = drives(0)
    shorter = lambda share: hand.replace(progress=share * hand.progress)  # noqa: E731
    rows = {HAND_SET: hand, OTHER: drives(2)}
    rows |= {name: shorter(share) for name, share in SLOWER.items()}
    rows[IDM] = broken(drives(1), np.arange(40) * 99, at_fault=1)
    both = pair(hand, hand).runs
    halves = [*range(0, CASES, 2), *range(1, CASES, 2)]  # each has every family
    runs = SuiteRuns(
        rows=jax.tree.map(lambda x: np.asarray(x)[halves], rows),
        ids=tuple(both.ids[i] for i in halves),
        groups=tuple(both.groups[i] for i in halves),
        preventable=np.ones(CASES, bool),
        trivial=np.zeros(CASES, bool),
        reference=IDM,
        way=np.full(CASES, 1000.0),
    )
    return with_faults(runs)


def test_drivers_are_judged_by_what_they_are(suite):
    hand, idm, made = (suite.rows[name] for name in (HAND_SET, IDM, FAULTY))
    at_fault = np.asarray(idm.at_fault) > 0
    assert at_fault.sum() == 40
    for field in ("progress", "at_fault"):
        found, there, here = (getattr(x, field) for x in (made, idm, hand))
        np.testing.assert_array_equal(found, np.where(at_fault, there, here))
    found = {one["candidate"]: one for one in tallied(suite, 2, ALONE)}
    assert [one["truth"] for one in found.values()] == [truth for *_, truth in KINDS]
    decided = {name: (one["each"], one["together"]) for name, one in found.items()}
    assert decided[OTHER][1] == "no difference"
    assert "do not ship" not in decided[OTHER][0]
    for worse in (*SLOWER, FAULTY):
        assert decided[worse] == ({"do not ship": 2}, "do not ship")
    # without a fault where there were 40: safer, but that alone is no metric's gain
    assert "do not ship" not in decided[HAND_SET][0]
    for name, share in SLOWER.items():
        assert found[name]["way"] == pytest.approx(share)
    assert table([*found.values()])


def test_other_candidates_come_of_another_key_only(monkeypatch):
    monkeypatch.setattr(
        "rcirl_jax.planner.rank.rank_policy", lambda *_: lambda *seen: seen
    )
    rows, key = {row.name: row for row in made_rows()}, jax.random.key(5)
    seen = rows[OTHER].policy("params", "scene", key, "before")
    assert seen == ("params", "scene", jax.random.fold_in(key, 1), "before")
    assert list(rows) == [HAND_SET, OTHER, IDM, *SLOWER]
    shares = [float(rows[name].params["speed_share"]) for name in SLOWER]
    assert shares == pytest.approx([0.95, 0.8])


@pytest.mark.slow
@pytest.mark.multiprocess
def test_by_its_command(tmp_path):
    """Driven: other candidates drive otherwise and as far, slower ones less far."""
    out = tmp_path / "errors.json"
    short = ("--suite=free_cruise,curve_speed", "--cases=15", "--duration=10")
    succeeded("experiments.gate_errors", f"--output={out}", "--seeds=2", *short)
    body = json.loads(out.read_text())
    assert (body["cases"], body["made_by"]["flags"]["seeds"]) == (60, 2)
    found = {one["candidate"]: one for one in body["kinds"]}
    assert found[OTHER]["way"] == pytest.approx(1.0, abs=0.01)
    assert found[OTHER]["way"] != 1.0
    slower, slowest = (found[name] for name in SLOWER)
    assert slowest["way"] < slower["way"] < 0.99
    assert slowest["each"] == {"do not ship": 2}
    assert all("ship" not in found[name]["each"] for name in (*SLOWER, OTHER))
