"""The gate: worse is refused, the same is no difference, better ships."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.summary import SuiteRuns
from rcirl_jax.evaluation.gate.types import (
    EXIT_CODES,
    TRIVIAL_BASELINES,
    GateConfig,
    Likeness,
    Pair,
)
from rcirl_jax.evaluation.gate.verdict import judge, write_verdict
from rcirl_jax.evaluation.gate.words import format_verdict
from rcirl_jax.simulation.metrics import COLUMNS, CaseMetrics

FAMILIES, EACH = 20, 200  # 4,000 cases: about as many as the suite has
CASES = FAMILIES * EACH
DRIVES, RECORDINGS = 240, 12  # of the held-out drives
A, J = COLUMNS.index("a_station"), COLUMNS.index("j_station")


def drives(seed=0, jerky=0.4, hard=0.15, way=1000.0):
    """Faultless drives of which shares are jerky and brake or accelerate hard."""
    rng = np.random.default_rng(seed)
    values = {f.name: np.zeros(CASES) for f in dataclasses.fields(CaseMetrics)}
    holds = np.ones((CASES, len(COLUMNS)), bool)
    holds[:, J] = rng.uniform(size=CASES) >= jerky
    holds[:, A] = rng.uniform(size=CASES) >= hard
    good = ("no_fault", "drivable", "direction", "ttc_bound", "speed_compliance")
    good = (*good, "samples")
    values |= dict.fromkeys(good, np.ones(CASES))
    values |= {"holds": holds, "comfort": holds[:, J].astype(float)}
    progress = way * rng.uniform(0.8, 1.2, size=CASES)
    felt = rng.uniform(0.6, 1.0, size=(2, CASES))  # m/s^2, m/s^3
    values |= dict(zip(("rms_a", "rms_j"), felt * (0.6 + jerky), strict=True))
    return CaseMetrics(**{**values, "progress": progress})


def likeness(seed=0, name="incumbent", **factors):
    """Distances to the human: alike, or times a factor; the trivial ones twice."""
    rng = np.random.default_rng(seed)
    clusters = np.arange(DRIVES) % RECORDINGS
    hard = rng.uniform(1.0, 3.0, size=DRIVES)  # how hard a drive is to foresee
    rows = {
        "candidate": 1.0,
        name: 1.0,
        **dict.fromkeys(TRIVIAL_BASELINES, 2.0),
        **factors,
    }
    distance = {
        row: factor * hard * rng.uniform(0.9, 1.1, size=DRIVES)
        for row, factor in rows.items()
    }
    return Likeness(distance=distance, clusters=clusters, available=DRIVES)


def pair(candidate, incumbent, families=FAMILIES, **more):
    names = [f"family{i * families // CASES:02d}" for i in range(CASES)]
    rows = dict.fromkeys(TRIVIAL_BASELINES, incumbent)
    values = {"preventable": np.ones(CASES, bool), "rows": rows, **more}
    known = values.pop("likeness", likeness())
    values["rows"] |= {"candidate": candidate, "incumbent": incumbent}
    runs = SuiteRuns(
        ids=tuple(f"{name}/{i % EACH:03d}@{i // EACH}" for i, name in enumerate(names)),
        groups=tuple(names),
        trivial=np.zeros(CASES, bool),
        reference="IDM",
        way=np.full(CASES, 1000.0),
        **values,
    )
    return Pair(runs=runs, likeness=known)


def broken(metrics, cases, **values):
    """Another value in some cases."""
    changed = {}
    for name, value in values.items():
        array = np.array(getattr(metrics, name))
        array[cases] = value
        changed[name] = array
    return metrics.replace(**changed)


def smoother(metrics, share=0.95):
    """So much of the RMS jerk, and jerk within its bound in some more cases."""
    holds = np.array(metrics.holds)
    holds[::11, J] = True
    return metrics.replace(holds=holds, rms_j=share * np.asarray(metrics.rms_j))


def decide(candidate, incumbent, families=FAMILIES, **config):
    return judge(pair(candidate, incumbent, families), GateConfig(**config))


def failed(verdict):
    return {check.name for check in verdict.checks if check.outcome == "fail"}


def check_of(verdict, name):
    (found,) = [check for check in verdict.checks if check.name == name]
    return found


# ------------------------------------------------------------------- the decision


def further(metrics, factor, cases=slice(None)):
    """Progress times a factor, in some cases."""
    way = np.array(metrics.progress)
    way[cases] *= factor
    return metrics.replace(progress=way)


def test_the_same_is_no_difference_and_a_smoother_one_ships():
    verdict = decide(drives(), drives())
    assert (verdict.decision, verdict.exit_code) == ("no difference", 3)
    assert not verdict.look_at
    assert not verdict.new_faults
    assert all(check.outcome != "fail" for check in verdict.checks)
    better = decide(smoother(drives()), drives())
    assert (better.decision, better.exit_code) == ("ship", 0)
    assert "Better: RMS jerk 5.0 % lower" in better.sentence


def test_nothing_ships_on_a_part_of_the_suite():
    both = pair(smoother(drives()), drives())
    assert judge(both, GateConfig()).decision == "ship"
    verdict = judge(both, GateConfig(), "cases of 2 s instead of 120 s")
    assert verdict.decision == "could not judge"
    assert verdict.reasons[0].startswith("cases of 2 s instead of 120 s")


def test_exchangeable_rewards_hardly_ever_ship():
    """Two rewards of one quality, drawn anew: gains are false alarms, 5 % at most."""
    wide = dict.fromkeys(("collision_free", "min_ttc", "speed_limit", "on_road"), 0.5)
    wide |= {"progress": 0.5, "family_progress": 0.5, "family_clean": 0.5}
    drawn, shipped = 24, 0
    for seed in range(drawn):
        a, b = drives(2 * seed), drives(2 * seed + 1)
        shipped += decide(a, b, **wide).decision == "ship"
    # P(more than 4 of 24 at 5 %) = 0.6 %; the seeds are fixed
    assert shipped <= 4


# ------------------------------------------------------------ losses and families


def test_progress_is_compared_within_the_families():
    """Half of the families gain 4 % and half lose 4 %: no loss on this suite.

    Drawn as clusters the interval would reach below -1 %: 1.96 x 4 % / sqrt(20).
    """
    sign = np.where(np.arange(CASES) // EACH % 2, 1.04, 0.96)
    verdict = decide(further(drives(), sign), drives())
    checks = [c for c in verdict.checks if (c.kind, c.name) == ("no loss", "progress")]
    assert checks[0].outcome == "pass"
    assert abs(checks[0].low) < 0.003


def test_a_loss_in_one_family_alone_is_found_and_looked_at_first():
    """One family of twenty drives 40 % slower, all others a little faster."""
    base, some = drives(), slice(3 * EACH, 4 * EACH)
    assert failed(decide(further(base, 0.97), base)) == {"progress"}
    verdict = decide(further(further(base, 1.03), 0.6, some), base)
    assert failed(verdict) == {"family03, progress"}
    two = further(further(base, 0.8, some), 0.9, slice(5 * EACH, 6 * EACH))
    verdict = decide(two, base)
    assert {"family03, progress", "family05, progress"} <= failed(verdict)
    first = [case.partition("/")[0] for case in verdict.look_at[:2]]
    assert sorted(first) == ["family03", "family05"]


@pytest.mark.parametrize(("lost", "outcome"), [(9, "pass"), (12, "fail")])
def test_clean_drives_of_a_family(lost, outcome):
    """Of 200 nine lost are within 10 %, twelve are detected: 20 x 2^-11 < 0.05."""
    base = drives()
    near = broken(base, np.arange(3 * EACH, 3 * EACH + lost), ttc_bound=0)
    check = check_of(decide(near, base), "family03, clean drives")
    assert (check.outcome, check.lost) == (outcome, lost)


def test_a_family_whose_cases_prove_nothing_is_open():
    """Slower in one family by chance: neither lost for certain nor not lost."""
    noise = 0.93 + 0.4 * np.random.default_rng(9).normal(size=EACH)
    verdict = decide(further(drives(), noise, slice(EACH)), drives())
    assert check_of(verdict, "family00, progress").outcome == "open"


def test_a_gain_does_not_pay_for_comfort():
    """More progress, but a tenth more RMS acceleration; 1 % of jerk is none."""
    base = drives()
    harder = base.replace(rms_a=1.1 * base.rms_a, rms_j=1.01 * base.rms_j)
    verdict = decide(further(harder, 1.1), base)
    assert verdict.decision == "do not ship"
    assert failed(verdict) == {"rms_a"}
    assert "accelerates and brakes 10.0 % harder (RMS)" in verdict.sentence
    assert "But better: progress +10.0 %" in verdict.sentence


def test_the_best_arguments_against_a_candidate_that_ships():
    """It loses 4 % in a family, a driver may be as near to people, one scores more."""
    base, alone = drives(), dict.fromkeys(TRIVIAL_BASELINES, drives())
    mine = further(smoother(base), 0.96, slice(EACH))
    rows = alone | {"IDM": further(base, 1.5)}
    near = likeness(candidate=0.5, IDM=0.5)
    verdict = judge(pair(mine, base, rows=rows, likeness=near), GateConfig())
    assert verdict.decision == "ship"
    family, nearer, higher = verdict.against
    assert 'It loses most in "family00": 4.0 % less progress' in family
    assert "it is not shown to be nearer to" in nearer
    assert higher.startswith("IDM has more of nuPlan's points: by ")


def part_of(whole, at):
    """The same pair on some of its cases."""
    names = ("groups", "ids", "way", "preventable", "trivial")
    parts = {name: getattr(whole.runs, name)[at] for name in names}
    rows = jax.tree.map(lambda x: np.asarray(x)[at], dict(whole.runs.rows))
    runs = dataclasses.replace(whole.runs, rows=rows, **parts)
    return dataclasses.replace(whole, runs=runs)


def test_too_few_cases_cannot_be_judged():
    few = part_of(pair(drives(), drives()), slice(0, 600))
    verdict = judge(few, GateConfig())
    assert (verdict.decision, verdict.exit_code) == ("could not judge", 2)
    assert "600 cases can never prove" in verdict.reasons[0]
    margins = dict.fromkeys(
        ("collision", "vulnerable", "red_light", "stop_sign", "collision_free",
         "min_ttc", "speed_limit", "on_road"), 0.02,
    )  # fmt: skip
    assert judge(few, GateConfig(**margins)).decision == "no difference"


# --------------------------------------------------------------------- its words


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"min_ttc": 0}, "min_ttc: 0: expected within"),
        ({"primary": ()}, "primary: none: expected some"),
        ({"accept": tuple("abcd")}, "accept: 4 cases: expected at most 3"),
    ],
)
def test_bad_settings_are_one_line(wrong, says):
    with pytest.raises(InputError, match=says):
        GateConfig(**wrong)


def test_the_sentence_names_the_worst_family_and_the_json_says_the_same(tmp_path):
    config, some = GateConfig(), slice(3 * EACH, 4 * EACH)
    base = drives()
    mine = further(further(base, 0.8, some), 0.3, slice(3 * EACH, 3 * EACH + 12))
    verdict = judge(pair(mine, base), config)
    lost = 100.0 - 100.0 * mine.progress[some].sum() / np.sum(base.progress[some])
    assert f'{lost:.1f} % less progress in "family03"' in verdict.sentence
    assert verdict.sentence.endswith(f"Next: replay {verdict.look_at[0]}.")
    assert max(map(len, format_verdict(verdict).splitlines())) <= 132
    write_verdict(tmp_path / "verdict.json", verdict, config, {"files": {}})
    body = json.loads((tmp_path / "verdict.json").read_text())
    assert list(body)[:2] == ["sentence", "decision"]
    assert (body["sentence"], body["decision"]) == (verdict.sentence, "do not ship")
    assert body["exit_code"] == EXIT_CODES[verdict.decision] == 3
    assert len(body["checks"]) == len(verdict.checks)
    assert body["config"]["collision_free"] == config.collision_free
