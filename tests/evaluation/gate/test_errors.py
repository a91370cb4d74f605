"""How often the gate is wrong: pairs of known truth, and what is counted of them."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.files import SuiteRuns, write_runs
from rcirl_jax.evaluation.exact import clopper_pearson
from rcirl_jax.evaluation.gate import checks as gate_checks
from rcirl_jax.evaluation.gate.checks import gains
from rcirl_jax.evaluation.gate.errors import (
    DECISIONS,
    as_driven,
    clustered_rate,
    constructed,
    equal_pairs,
    every_pair,
    format_errors,
)
from rcirl_jax.evaluation.gate.pairs import (
    COINS,
    CONSTRUCTED,
    IDM,
    constructed_rows,
    joined,
    mixed,
    other_candidates,
    pair_between,
    redrawn,
    swapped,
)
from rcirl_jax.evaluation.gate.types import GateConfig
from rcirl_jax.export.gate_job import ErrorsJob, gate_job
from rcirl_jax.simulation.metrics import CaseMetrics
from tests.evaluation.gate.test_gate import CASES, EACH, FAMILIES, broken, drives, pair
from tests.helpers.commands import command
from tests.helpers.weights_files import random_weights


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


@pytest.mark.parametrize(("share", "count"), [(0.05, 10), (1.0, 200)])
def test_some_drives_of_another_driver(share, count):
    """So many, of the cases named, in every field; all others as they were."""
    mine, others = drives(0), slow_and_jerky(1)
    among = np.arange(CASES) < 200
    made = mixed(mine, others, among, share, np.random.default_rng(0))
    exchanged = np.asarray(made.progress) == others.progress
    assert exchanged.sum() == count
    assert not exchanged[200:].any()
    for field in dataclasses.fields(CaseMetrics):
        found, here, there = (
            getattr(x, field.name) for x in (made, mine, others)
        )  # fmt: skip
        np.testing.assert_array_equal(found[exchanged], there[exchanged])
        np.testing.assert_array_equal(found[~exchanged], here[~exchanged])
    none = mixed(mine, others, among & ~among, share, np.random.default_rng(0))
    np.testing.assert_array_equal(none.progress, mine.progress)


NAMES = [made.name for made in CONSTRUCTED]
EQUAL, SLOWER, SLOWEST, FIVE, FAULTY, BETTER, SOUND = NAMES


def suite_of(seed):
    """Drives as the rows of constructed drivers leave them; IDM is at fault in 40."""
    hand = drives(10 * seed)
    shorter = lambda share: hand.replace(progress=share * hand.progress)  # noqa: E731
    at_fault = broken(drives(10 * seed + 1), np.arange(40) * 100, at_fault=1)
    ids = tuple(f"{x}/{seed}" for x in pair(hand, hand).ids)
    rows = ("hand-set", EQUAL, SLOWER, SLOWEST, IDM)
    found = (hand, drives(10 * seed + 2), shorter(0.95), shorter(0.8), at_fault)
    return SuiteRuns(
        rows=dict(zip(rows, found, strict=True)),
        ids=ids,
        groups=tuple(pair(hand, hand).families),
        preventable=np.ones(CASES, bool),
        trivial=np.zeros(CASES, bool),
        reference=IDM,
        way=np.full(CASES, 1000.0),
    )


def test_constructed_drivers_are_judged_by_what_they_are():
    suites, config = [suite_of(i) for i in range(3)], GateConfig(nulls=())
    tallies = constructed(suites, config, together=2)
    assert [x.name for x in tallies] == NAMES * 2
    found = dict(zip(NAMES, tallies, strict=False))
    assert {x.said.shape[:2] for x in tallies[: len(NAMES)]} == {(3, 1)}
    assert {x.cases for x in tallies[: len(NAMES)]} == {CASES}
    assert found[EQUAL].decisions == {"no difference": 3}
    assert found[SLOWER].decisions == found[SLOWEST].decisions == {"do not ship": 3}
    assert found[BETTER].decisions == {"ship": 3}
    assert found[BETTER].rate("ship")[0] == found[BETTER].rate("gain")[0] == 1.0
    # 2 faults of 4,000 are within the margin, 40 are not
    assert found[FIVE].rate("refused")[0] == 0.0
    assert found[FAULTY].decisions == {"do not ship": 3}
    assert found[FAULTY].rate("safety")[0] == 1.0
    assert found[SOUND].rate("refused")[0] == 0.0
    assert found[SOUND].drives["cases_with_own_fault"] == [0, 3 * 40]
    for tally in found.values():
        assert sum(tally.rate(what)[0] for what in DECISIONS) == pytest.approx(1.0)
    # what was driven
    assert found[SLOWER].drives["way"] == pytest.approx(0.95)
    assert found[BETTER].drives["way"] == pytest.approx(1.0 / 0.95)
    assert found[EQUAL].drives["cases_that_differ"] == 3 * CASES
    assert found[FIVE].drives["cases_that_differ"] == 3 * CASES // 20
    assert found[FAULTY].drives["cases_with_own_fault"] == [3 * 40, 0]
    # two of the three seeds as one suite
    large = dict(zip(NAMES, tallies[len(NAMES) :], strict=True))
    assert {x.said.shape[:2] for x in large.values()} == {(1, 1)}
    assert {x.cases for x in large.values()} == {2 * CASES}
    assert large[BETTER].decisions == {"ship": 1}
    text = format_errors(tallies)
    assert text.count(BETTER) == 4
    assert "could not judge" in text
    with pytest.raises(InputError, match="--together: 4: expected at most 3"):
        constructed(suites, config, together=4)


def test_nulls_are_refused_where_nobody_drives_them():
    with pytest.raises(InputError, match="likeness: constant V: expected a row"):
        constructed([suite_of(0)], GateConfig())


def test_suites_joined_are_all_their_cases():
    pairs = [pair_between(suite_of(i), SLOWER, "hand-set") for i in range(2)]
    both = joined(pairs)
    assert both.ids == [*pairs[0].ids, *pairs[1].ids]
    np.testing.assert_array_equal(
        both.candidate.holds,
        np.concatenate([one.candidate.holds for one in pairs]),
    )
    with pytest.raises(InputError, match="nobody: expected a row of hand-set, "):
        pair_between(suite_of(0), "nobody", "hand-set")


def test_other_candidates_come_of_another_key_only():
    policy = other_candidates(lambda *seen: seen, 3)
    key = jax.random.key(5)
    params, scene, other, before = policy("params", "scene", key, "before")
    assert (params, scene, before) == ("params", "scene", "before")
    assert other == jax.random.fold_in(key, 3)
    # one object per stream, or the rollout compiles anew for every seed
    once, again = constructed_rows(), constructed_rows()
    assert [row.policy for row in once] == [row.policy for row in again]
    assert len({row.name for row in once}) == len(once) == 5
    shares = [float(row.params["speed_share"]) for row in once if row.params]
    assert shares == pytest.approx([0.95, 0.8])


def test_a_job_without_weights_has_the_constructed_rows():
    asked, _ = gate_job(
        None, "hand-set", suite="free_cruise", cases=2, duration_s=2.0,
        catalogue_seed=3, plan_every=1,
    )  # fmt: skip
    job = ErrorsJob(**vars(asked))
    assert [row.name for row in job.rows()] == [row.name for row in constructed_rows()]
    assert job.cases().ids == ("free_cruise/000@3", "free_cruise/001@3")
    assert hash(job) == hash(ErrorsJob(**vars(asked)))
    with pytest.raises(InputError, match="--weights: none"):
        asked.rows()


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
    assert [one["verdicts"] for one in found.values()] == [2] * 7 + [4, 4, 1, 2, 2, 2]
    assert found["random weights, hand-set"]["rates"]["refused"][0] == 1.0
    assert found["hand-set, random weights"]["rates"]["refused"][0] == 0.0
    assert body["cases"] == 30
    assert body["made_by"]["flags"]["swaps"] == 2


@pytest.mark.multiprocess
def test_driven_suites_by_its_command(tmp_path):
    """A better candidate ships; the incumbent of a file is the row of that name."""
    out, file = tmp_path / "errors.json", random_weights(tmp_path / "w.msgpack")
    made, zeros = suite_of(0), lambda n: np.zeros((CASES, n))
    unread = {"inside": zeros(6), "inside_filtered": zeros(2)}
    unread["holds_filtered"] = zeros(2)
    names = {"candidate": "hand-set", "incumbent": SLOWER, "random weights": SLOWEST}
    rows = {name: made.rows[row].replace(**unread) for name, row in names.items()}
    write_runs(tmp_path / "metrics.npz", dataclasses.replace(made, rows=rows))
    flags = (f"--driven={tmp_path}/metrics.npz", f"--output={out}", "--swaps=2")
    done = command("experiments.gate_errors", *flags, f"--incumbent={file}")
    assert done.returncode == 0, done.stderr[-2000:]
    body = json.loads(out.read_text())
    found = {one["name"]: one for one in body["tallies"]}
    assert found["candidate, incumbent"]["decisions"] == {"ship": 1}
    assert found["incumbent, random weights"]["rates"]["ship"][0] == 1.0
    assert found["random weights, incumbent"]["rates"]["do not ship"][0] == 1.0
    assert not set(found) & set(NAMES)
    assert "of 6 pairs of its rows 3 ship" in done.stdout


@pytest.mark.multiprocess
@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("--incumbent=IDM",), "--incumbent: IDM: expected --candidate or --driven"),
        (("--seeds=2", "--together=3"), "--together: 3: expected at most 2 seeds"),
        (("--driven=x", "--together=2"), "--together: 2: expected none beside"),
    ],
)
def test_flags_that_do_not_fit(tmp_path, flags, said):
    done = command("experiments.gate_errors", f"--output={tmp_path}/x.json", *flags)
    assert done.returncode == 2
    assert said in done.stderr


@pytest.mark.slow
@pytest.mark.multiprocess
def test_constructed_drivers_by_its_command(tmp_path):
    """Driven: other candidates drive otherwise and as far, slower ones less far."""
    out = tmp_path / "errors.json"
    short = ("--suite=free_cruise,curve_speed", "--cases=15", "--duration=10")
    flags = (f"--output={out}", "--seeds=2", "--together=2")
    done = command("experiments.gate_errors", *flags, *short)
    assert done.returncode == 0, done.stderr[-2000:]
    body = json.loads(out.read_text())
    assert [one["name"] for one in body["tallies"]] == NAMES * 2
    assert [one["verdicts"] for one in body["tallies"]] == [2] * 6 + [1] * 6
    assert [one["cases"] for one in body["tallies"]] == [30] * 6 + [60] * 6
    found = {one["name"]: one for one in body["tallies"][:6]}
    drove = {name: one["drives"] for name, one in found.items()}
    assert drove[EQUAL]["cases_that_differ"] > 10
    assert drove[EQUAL]["way"] == pytest.approx(1.0, abs=0.01)
    assert drove[SLOWEST]["way"] < drove[SLOWER]["way"] < 0.99
    assert drove[BETTER]["way"] == pytest.approx(1.0 / drove[SLOWER]["way"])
    # round(0.05 * 30) of each seed
    assert drove[FIVE]["cases_that_differ"] <= 2 * 2
    assert found[SLOWEST]["decisions"] == {"do not ship": 2}
    for name in (SLOWER, SLOWEST, EQUAL):
        assert found[name]["rates"]["ship"][0] == 0.0
