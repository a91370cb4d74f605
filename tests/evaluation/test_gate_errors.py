"""How often the gate is wrong: pairs of known truth, and what is counted of them."""

import dataclasses
import json

import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation import gate_checks
from rcirl_jax.evaluation.exact import clopper_pearson
from rcirl_jax.evaluation.gate_checks import gains
from rcirl_jax.evaluation.gate_errors import (
    COINS,
    as_driven,
    clustered_rate,
    equal_pairs,
    every_pair,
    format_errors,
    redrawn,
    swapped,
)
from rcirl_jax.evaluation.gate_types import GateConfig
from rcirl_jax.simulation.metrics import CaseMetrics
from tests.commands import command
from tests.evaluation.test_gate import CASES, EACH, FAMILIES, broken, drives, pair
from tests.weights_files import random_weights


def slow_and_jerky(seed):
    """Half of the way, twice as often jerky and hard."""
    return drives(seed, jerky=0.8, hard=0.3, way=500.0)


def test_swapped_drives_are_the_same_drives():
    both = pair(slow_and_jerky(0), drives(1))
    made = swapped(both, np.random.default_rng(0))
    for field in dataclasses.fields(CaseMetrics):
        mine, theirs = (
            getattr(p, field.name) for p in (made.candidate, both.incumbent)
        )
        other, before = (
            getattr(p, field.name) for p in (made.incumbent, both.candidate)
        )
        exchanged = np.asarray(made.candidate.progress) == both.incumbent.progress
        np.testing.assert_array_equal(mine[exchanged], theirs[exchanged])
        np.testing.assert_array_equal(other[exchanged], before[exchanged])
    assert 0.45 * CASES < exchanged.sum() < 0.55 * CASES
    assert made.ids == both.ids


def test_a_coin_for_each_family():
    both = pair(slow_and_jerky(0), drives(1))
    made = swapped(both, np.random.default_rng(0), by_family=True)
    exchanged = np.asarray(made.candidate.progress) == both.incumbent.progress
    by_family = exchanged.reshape(FAMILIES, EACH)
    assert (by_family.all(axis=1) | ~by_family.any(axis=1)).all()
    assert 5 < by_family.all(axis=1).sum() < 15


def gains_claimed(pairs, config, draws):
    """Share of swapped pairs in which a gain is claimed."""
    rng = np.random.default_rng([1, COINS])
    claimed = [
        any(check.outcome == "pass" for check in gains(swapped(one, rng), config))
        for one in pairs
        for _ in range(draws)
    ]
    return sum(claimed), len(claimed)


def test_gains_of_equal_pairs_are_rarer_than_they_may_be(monkeypatch):
    """5 % at most: of 400, 34 or more come with p < 0.002; and a gate that does not
    adjust for the number of metrics, at four times the level, is found out."""
    pairs = [pair(slow_and_jerky(100 + 2 * i), drives(101 + 2 * i)) for i in range(4)]
    claimed, total = gains_claimed(pairs, GateConfig(), 100)
    assert total == 400
    assert claimed < 34
    monkeypatch.setattr(gate_checks, "holm", lambda p: p)
    monkeypatch.setattr(gate_checks, "LEVEL", 0.2)
    claimed, _ = gains_claimed(pairs, GateConfig(), 25)
    assert claimed > 8  # of 100; none by the gate as it is


def test_what_is_better_or_worse_is_seen():
    pairs = [pair(slow_and_jerky(2 * i), drives(2 * i + 1)) for i in range(3)]
    back = [dataclasses.replace(p, candidate=p.incumbent, incumbent=p.candidate)
            for p in pairs]  # fmt: skip
    worse = as_driven("slow", "worse", pairs, GateConfig())
    assert worse.rate("refused")[0] == 1.0
    assert worse.rate("gain")[0] == 0.0
    assert worse.decisions == {"do not ship": 3}
    better = as_driven("smooth", "better", back, GateConfig())
    assert better.rate("gain")[0] == 1.0
    assert better.decisions == {"ship": 3}
    wide = GateConfig(family_clean=0.2, family_progress=0.2)
    swaps, by_family, twice = equal_pairs(pairs, wide, swaps=2)
    assert [x.said.shape[:2] for x in (swaps, by_family, twice)] == [
        (3, 2), (3, 2), (1, 1),
    ]  # fmt: skip
    # half of the way in half of the families: each loses, all together do not
    assert by_family.rate("families")[0] == 1.0
    assert by_family.rate("gain")[0] < 1.0
    text = format_errors([swaps, worse])
    assert "100.0 % [29.2, 100.0]" in text


def test_faults_refuse_a_swap_only_if_they_are_many():
    """One fault of either is chance; ten of one and none of the other are not."""
    one = [pair(broken(drives(i), [7], at_fault=1), drives(i)) for i in range(2)]
    swaps, *_ = equal_pairs(one, GateConfig(), swaps=20)
    assert swaps.said[:, :, 0].sum() == 0
    bad = pair(broken(drives(0), list(range(10)), at_fault=1), drives(0))
    found = as_driven("broken", "worse", [bad], GateConfig())
    assert found.rate("safety")[0] == 1.0
    assert found.decisions == {"do not ship": 1}


def test_every_row_against_every_other():
    rows = {"good": drives(0), "slow": slow_and_jerky(1), "again": drives(0)}
    found = every_pair(pair(drives(0), drives(0)), rows, GateConfig())
    said = {(one["candidate"], one["incumbent"]): one for one in found}
    assert len(said) == 6
    assert said["good", "slow"]["decision"] == "ship"
    assert said["slow", "good"]["decision"] == "do not ship"
    assert said["good", "again"]["decision"] == "no difference"
    assert said["slow", "good"]["way"] == pytest.approx(0.5, abs=0.02)
    assert said["good", "slow"]["cases_with_own_fault"] == [0, 0]


def test_draws_of_one_suite_count_for_less_if_they_agree():
    """Ten suites that each say one thing ten times are ten draws, not a hundred."""
    agree = np.repeat(np.arange(10) < 3, 10).reshape(10, 10)
    share, low, high = clustered_rate(agree)
    exact = clopper_pearson(3, 10)
    assert share == pytest.approx(0.3)
    assert (low, high) == pytest.approx(exact, abs=0.03)
    apart = np.tile(np.arange(10) < 3, (10, 1))
    assert clustered_rate(apart)[1:] == pytest.approx(clopper_pearson(30, 100))
    none = clustered_rate(np.zeros((12, 25), bool))
    assert none == pytest.approx((0.0, *clopper_pearson(0, 12)))
    one = clustered_rate(np.zeros((1, 25), bool))
    assert one == pytest.approx((0.0, *clopper_pearson(0, 25)))


def test_bad_input_is_one_line():
    both = pair(drives(0), drives(1))
    others = pair(drives(0), drives(1), families=FAMILIES // 2)
    with pytest.raises(InputError, match="expected two suites of the same families"):
        redrawn(both, others)
    assert EACH == CASES // FAMILIES


@pytest.mark.slow
@pytest.mark.multiprocess
def test_by_its_command(tmp_path):
    file, out = random_weights(tmp_path / "w.msgpack"), tmp_path / "errors.json"
    # random weights mostly stand still
    short = ("--suite=free_cruise,stopped_lead", "--cases=15", "--duration=10")
    flags = (f"--candidate={file}", f"--output={out}", "--seeds=2", "--swaps=2")
    done = command("experiments.gate_errors", *flags, *short)
    assert done.returncode == 0, done.stderr[-2000:]
    body = json.loads(out.read_text())
    found = {one["name"]: one for one in body["tallies"]}
    assert [one["verdicts"] for one in found.values()] == [4, 4, 1, 2, 2, 2]
    assert found["random weights, hand-set"]["rates"]["refused"][0] == 1.0
    assert found["hand-set, random weights"]["rates"]["refused"][0] == 0.0
    assert body["cases"] == 30
    assert body["made_by"]["flags"]["swaps"] == 2
