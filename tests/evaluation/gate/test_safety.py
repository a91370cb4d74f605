"""Faults, accepted cases, trivial baselines and human-likeness in the gate."""

import dataclasses
import math
import statistics

import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.gate.types import GateConfig, Likeness
from rcirl_jax.evaluation.gate.verdict import judge
from rcirl_jax.evaluation.gate.words import format_verdict
from rcirl_jax.evaluation.statistics import (
    ALPHA,
    NUISANCE_ALPHA,
    NUISANCE_STEPS,
    clopper_pearson,
    no_more_faults,
    tango_score,
)
from rcirl_jax.simulation.rows import TRIVIAL_BASELINES
from tests.evaluation.gate.test_gate import (
    CASES,
    broken,
    check_of,
    decide,
    drives,
    failed,
    likeness,
    pair,
    smoother,
)

OFFENCES = [("at_fault_vru", "vulnerable"), ("red_lights", "red_light")]


def spread(count, start=0):
    """Cases far apart, so that no family has many of them."""
    return start + 97 * np.arange(count)


# ------------------------------------------------------------------- the exact test


@pytest.mark.parametrize(
    ("gained", "lost", "n", "margin"),
    [(2, 1, 40, 0.1), (3, 0, 30, 0.05)],
)
def test_the_tail_is_the_sum_over_all_outcomes(gained, lost, n, margin):
    """Every outcome of the trinomial listed, at the same nuisance values."""
    seen = tango_score(gained, lost, n, -margin)
    low, high = clopper_pearson(gained, n, 1.0 - NUISANCE_ALPHA)
    worst = 0.0
    for q in np.linspace(low, min(high, 1.0 - margin), NUISANCE_STEPS):
        if 2 * q + margin > 1.0:
            continue
        p, total = q + margin, 0.0
        for g in range(n + 1):
            for c in range(n + 1 - g):
                if tango_score(g, c, n, -margin) >= seen - 1e-9:
                    ways = math.comb(n, g) * math.comb(n - g, c)
                    total += ways * q**g * p**c * (1 - q - p) ** (n - g - c)
        worst = max(worst, total)
    found = no_more_faults(gained, lost, n, margin) - NUISANCE_ALPHA
    assert found == pytest.approx(worst, rel=1e-6)


def test_how_many_cases_without_any_fault_it_takes():
    """At least those of (1 - m)^n <= 2.5 %, at most those of Tango's interval."""
    least = math.ceil(math.log(0.025) / math.log(1 - 0.0025))
    most = math.ceil(
        statistics.NormalDist().inv_cdf(0.975) ** 2 * (1 - 0.0025) / 0.0025
    )
    assert (least, most) == (1474, 1533)
    assert no_more_faults(0, 0, least - 1, 0.0025) > ALPHA
    assert no_more_faults(0, 0, most, 0.0025) <= ALPHA


# -------------------------------------------------------------------------- safety


@pytest.mark.parametrize(("field", "name"), OFFENCES)
def test_clearly_more_faults_are_refused_and_as_many_are_no_difference(field, name):
    mine = broken(drives(), spread(3), **{field: 1})
    theirs = broken(drives(), spread(3, start=5), **{field: 1})
    verdict = decide(mine, theirs)
    check = check_of(verdict, name)
    assert (check.outcome, check.gained, check.lost) == ("pass", 3, 3)
    assert verdict.decision == "no difference"
    assert len(verdict.new_faults) == 3
    # McNemar, 8 against 1: p = 0.039; the trivial ones drive as the incumbent does here
    mine = smoother(broken(drives(), spread(8), **{field: 1}))
    theirs = broken(drives(), spread(1, start=5), **{field: 1})
    verdict = decide(mine, theirs)
    assert verdict.decision == "do not ship"
    behind = {f"{name}, {trivial}" for trivial in TRIVIAL_BASELINES}
    assert failed(verdict) == {name, *behind}
    assert verdict.look_at[0] == "family00/000@0"


def test_a_collision_that_nobody_prevents_is_listed_and_not_counted():
    mine = broken(drives(), spread(8), at_fault=1)
    preventable = np.ones(CASES, bool)
    preventable[spread(8)] = False
    verdict = judge(pair(mine, drives(), preventable=preventable), GateConfig())
    assert check_of(verdict, "collision").lost == 0
    assert check_of(verdict, "collision_free").lost == 8  # over all cases it is
    assert [fault.preventable for fault in verdict.new_faults] == [False] * 8
    assert "at-fault collision, not preventable" in format_verdict(verdict)
    # people count wherever they are hit
    hit = broken(mine, spread(8), at_fault_vru=1)
    verdict = judge(pair(hit, drives(), preventable=preventable), GateConfig())
    assert "vulnerable" in failed(verdict)


def test_more_of_an_offence_that_both_commit_is_new():
    """A cone touched by both is no excuse for a pedestrian hit by one."""
    both = broken(drives(), [7], at_fault=1, red_lights=1)
    worse = broken(both, [7], at_fault_vru=1)
    assert [f.faults for f in decide(worse, both).new_faults] == [("vulnerable",)]
    more = decide(broken(both, [7], red_lights=3), both)
    assert [f.faults for f in more.new_faults] == [("red_light",)]
    assert decide(both, both).new_faults == ()


def test_a_few_new_faults_are_open_and_an_accepted_case_does_not_count():
    """Five lost and none gained: p = 0.06, but not less than ten for certain."""
    mine, theirs = smoother(broken(drives(), spread(5), at_fault=1)), drives()
    verdict = decide(mine, theirs)
    assert verdict.decision == "could not judge"
    assert check_of(verdict, "collision").outcome == "open"
    assert "family00/097@0: preventable at-fault" in format_verdict(verdict)
    ids = [fault.case for fault in verdict.new_faults]
    verdict = decide(mine, theirs, accept=tuple(ids[:2]))
    check = check_of(verdict, "collision")
    assert (check.outcome, check.lost) == ("pass", 3)
    assert verdict.decision == "ship"
    assert [fault.accepted for fault in verdict.new_faults] == [True] * 2 + [False] * 3
    assert f"but for accepted faults in {ids[0]}, {ids[1]}." in verdict.sentence
    with pytest.raises(InputError, match=r"accept: family01/000@1: .*expected some of"):
        decide(mine, theirs, accept=("family01/000@1",))


@pytest.mark.parametrize(
    ("mine", "theirs", "outcome"),
    [
        ([30.0] * 10, [0.3] * 10, "fail"),
        ([0.3] * 10, [30.0] * 10, "pass"),
        ([30.0] * 2, [], "open"),
    ],
)
def test_a_harder_impact_counts_more(mine, theirs, outcome):
    """Disjoint cases; a margin of ten of 10 m/s in 4,000 cases."""
    both = []
    for speeds, start in ((mine, 0), (theirs, 5)):
        at = spread(len(speeds), start)
        both.append(broken(drives(), at, at_fault=1, impact_speed=np.array(speeds)))
    # who is hit by another may be hit hard
    both[0] = broken(both[0], [90, 91], impact_speed=40.0)
    verdict = decide(*both)
    check = check_of(verdict, "impact")
    assert check.outcome == outcome
    total = (sum(theirs) - sum(mine)) / 10.0
    assert check.difference == pytest.approx(total / CASES)
    if outcome == "fail":
        assert "hits harder at fault, by 74 m/s in 1,000 cases" in verdict.sentence


# ------------------------------------------------ trivial baselines and likeness


def test_what_was_not_measured_is_open_and_says_what_to_do():
    mine = smoother(drives())
    verdict = judge(pair(mine, drives(), likeness=None), GateConfig())
    assert verdict.decision == "could not judge"
    unmeasured = {c.name for c in verdict.checks if not c.measured}
    trivial = {f"likeness, {name}" for name in TRIVIAL_BASELINES}
    assert unmeasured == {"likeness", *trivial}
    assert "Next: measure human-likeness" in verdict.sentence
    verdict = judge(pair(mine, drives(), rows={}), GateConfig())
    assert verdict.decision == "could not judge"
    assert "drive constant V on the same cases" in verdict.reasons[0]


def test_behind_a_trivial_baseline_in_safety_is_refused():
    mine = smoother(broken(drives(), spread(12), red_lights=1))
    trivial = {"constant V": mine, "+velocity": drives()}
    verdict = judge(pair(mine, mine, rows=trivial), GateConfig())
    assert failed(verdict) == {"red_light, +velocity"}
    assert "is not as safe as +velocity: red lights run" in verdict.sentence


@pytest.mark.parametrize(
    ("factors", "outcome"),
    [({}, "pass"), ({"+velocity": 1.0}, "open"), ({"+velocity": 0.9}, "fail")],
)
def test_the_candidate_is_nearer_than_every_trivial_baseline(factors, outcome):
    known = likeness(**factors)
    verdict = judge(pair(smoother(drives()), drives(), likeness=known), GateConfig())
    assert check_of(verdict, "likeness, +velocity").outcome == outcome
    assert check_of(verdict, "likeness, constant V").outcome == "pass"
    decisions = {"pass": "ship", "open": "could not judge", "fail": "do not ship"}
    assert verdict.decision == decisions[outcome]


def test_nearer_to_the_human_is_a_gain_and_farther_a_loss():
    nearer, farther = (likeness(candidate=factor) for factor in (0.9, 1.1))
    verdict = judge(pair(drives(), drives(), likeness=nearer), GateConfig())
    assert verdict.decision == "ship"
    verdict = judge(pair(smoother(drives()), drives(), likeness=farther), GateConfig())
    assert failed(verdict) == {"likeness"}


def test_the_interval_of_likeness_is_over_recordings():
    """Nearer in nearly every drive of one recording says little of others."""
    known = likeness()
    distance = dict(known.distance)
    factor = np.where(known.clusters == 0, 0.5, 1.0)
    distance["candidate"] = factor * np.asarray(distance["incumbent"])
    near = dataclasses.replace(known, distance=distance)
    verdict = judge(pair(drives(), drives(), likeness=near), GateConfig())
    gains = [c for c in verdict.checks if c.kind == "gain" and c.name == "likeness"]
    assert gains[0].difference > 0.0
    assert gains[0].outcome == "open"
    alone = dataclasses.replace(known, clusters=known.clusters % 3)
    few = judge(pair(drives(), drives(), likeness=alone), GateConfig())
    assert few.decision == "could not judge"
    assert any("3 vehicles are too few" in reason for reason in few.reasons)


@pytest.mark.parametrize(
    ("driven", "available", "says"),
    [(12, 2000, "12 held-out drives instead of 2000"), (100, 100, "")],
)
def test_a_part_of_the_held_out_drives_does_not_ship(driven, available, says):
    known = likeness(candidate=0.5)
    some = Likeness(
        distance={name: x[:driven] for name, x in known.distance.items()},
        clusters=known.clusters[:driven],
        available=available,
    )
    verdict = judge(pair(smoother(drives()), drives(), likeness=some), GateConfig())
    assert verdict.part == says
    assert verdict.decision == ("could not judge" if says else "ship")


@pytest.mark.parametrize(
    ("mine", "theirs", "outcomes"),
    [
        ({}, {}, ("pass",) * 4),
        ({"collision": 6}, {}, ("fail", "pass", "pass", "pass")),
        ({"ttc": 6, "braking": 12}, {"ttc": 6}, ("pass", "open", "fail", "pass")),
        ({"collision": 2, "headway": 40}, {}, ("open", "pass", "pass", "fail")),
    ],
)
def test_safety_among_recorded_traffic(mine, theirs, outcomes):
    """240 vehicles of a drive each; the first, or of the incumbent the last, offend.

    Six lost and none gained fail by McNemar's test; two leave 0.8 % [0.1, 3.0].
    """
    names = ("collision", "ttc", "braking", "headway")

    def row(counts, way):
        row = {name: np.zeros(240) for name in names}
        for name, count in counts.items():
            row[name][::way][:count] = 1.0
        return row

    known = likeness(candidate=0.5)
    rows = {"candidate": row(mine, 1), "incumbent": row(theirs, -1)}
    known = dataclasses.replace(known, traffic=rows, clusters=np.arange(240))
    verdict = judge(pair(smoother(drives()), drives(), likeness=known), GateConfig())
    found = [check_of(verdict, f"recorded {name}") for name in names]
    assert tuple(check.outcome for check in found) == outcomes
    if "fail" in outcomes:
        assert "among recorded traffic" in verdict.sentence
        assert verdict.decision == "do not ship"


@pytest.mark.parametrize(
    ("count", "outcomes"),
    [(147, ("open",) * 3), (148, ("pass", "open", "open")), (150, ("pass",) * 3)],
)
def test_too_few_vehicles_to_pass_are_said_to_be_too_few(count, outcomes):
    """Nobody offends: collisions pass by the exact test, the others by Tango's."""
    names = ("collision", "ttc", "braking")
    row = {name: np.zeros(count) for name in (*names, "headway")}
    known = likeness(candidate=0.5)
    known = Likeness(
        distance={name: x[:count] for name, x in known.distance.items()},
        clusters=np.arange(count),
        available=count,
        traffic={"candidate": row, "incumbent": row},
    )
    verdict = judge(pair(smoother(drives()), drives(), likeness=known), GateConfig())
    found = [check_of(verdict, f"recorded {name}") for name in names]
    assert tuple(check.outcome for check in found) == outcomes
    never = f"{count} vehicles can never prove a margin of 2.5 %"
    notes = {"open": never, "pass": ""}
    assert [check.note for check in found] == [notes[x] for x in outcomes]
