"""The report: numbers traced back to the scenes, text that lines up."""

import dataclasses
import itertools
import json

import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.evaluate import pooled
from rcirl_jax.evaluation.ranking.metrics import (
    METRICS,
    Outcomes,
    fit_temperature,
    oracle_scorer,
    random_scorer,
    scene_metrics,
)
from rcirl_jax.evaluation.ranking.report import (
    BASELINE_ROWS,
    Ranked,
    build_report,
    format_table,
    from_json,
    ranking_warnings,
    to_json,
    verdict,
)
from rcirl_jax.evaluation.statistics import Difference

SCENES, CANDIDATES, VEHICLES = 240, 12, 40


@pytest.fixture(scope="module")
def outcomes():
    rng, shape = np.random.default_rng(0), (SCENES, CANDIDATES)
    fde = rng.gamma(2.0, 2.0, shape)
    crash, feasible = rng.random(shape) < 0.2, rng.random(shape) < 0.8
    cluster = rng.permutation(np.arange(SCENES) % VEHICLES)
    return Outcomes(
        fde=fde, ade=0.4 * fde, crash=crash, feasible=feasible, cluster=cluster,
        human_crash=np.zeros(SCENES, bool),
    )  # fmt: skip


def scored(outcomes, noise, seed, crash_weight=0.0):
    rng = np.random.default_rng(seed)
    values = -outcomes.fde - crash_weight * outcomes.crash
    values = values + noise * rng.normal(size=values.shape)
    human = noise * rng.normal(size=SCENES)
    return scene_metrics(values, human, outcomes, fit_temperature(values, outcomes))


@pytest.fixture(scope="module")
def scorers(outcomes):
    return {
        "rc-irl": [scored(outcomes, 1.0, s, 100.0) for s in range(3)],
        "twin": [scored(outcomes, 2.0, 50)],
        "random": [scene_metrics(*random_scorer(0, outcomes.fde.shape), outcomes)],
        "constant speed": [scored(outcomes, 4.0, 60)],
        "IDM": [scored(outcomes, 3.0, 70)],
        "hand-set": [scored(outcomes, 2.0, 80)],
        "oracle": [scene_metrics(*oracle_scorer(outcomes), outcomes)],
    }


def ranked(scorers, outcomes, group=None):
    return Ranked(table=scorers, outcomes=outcomes, group=group)


@pytest.fixture(scope="module")
def report(scorers, outcomes):
    group = outcomes.cluster % 5
    return build_report(ranked(scorers, outcomes, group), num_resamples=2000)


def test_estimates_are_plain_means_over_runs_and_scenes(report, scorers):
    for name, runs in scorers.items():
        for metric, how in METRICS.items():
            weight = runs[0][how.weight] if how.weight else None
            means = [np.average(run[metric], weights=weight) for run in runs]
            found = report.rows[name][metric]
            assert found.value == pytest.approx(np.mean(means), abs=1e-12)
            assert found.low <= found.value + 1e-12
            assert found.high >= found.value - 1e-12
            sd = np.std(means, ddof=1) if len(runs) > 1 else None
            assert found.seed_sd == (sd if sd is None else pytest.approx(sd))


def test_counts_and_oracle_floor(report, outcomes):
    assert report.counts == {
        "scenes": SCENES,
        "vehicles": VEHICLES,
        "groups": 5,
        "candidates": SCENES * CANDIDATES,
        "feasible": int(outcomes.feasible.sum()),
    }
    best = [min(d[ok]) for d, ok in zip(outcomes.fde, outcomes.feasible, strict=True)]
    assert report.oracle_floor.value == pytest.approx(np.mean(best))
    assert report.oracle_floor_median.value == pytest.approx(np.median(best))
    assert report.rows["oracle"]["top1_fde"].value == report.oracle_floor.value


def test_two_parts_pooled_are_the_whole(report, scorers, outcomes):
    def part(rows):
        of = lambda x: x[rows] if isinstance(x, np.ndarray) else x  # noqa: E731
        every = lambda found: {name: of(x) for name, x in found.items()}  # noqa: E731
        table = {name: [*map(every, runs)] for name, runs in scorers.items()}
        some = Outcomes(**every(vars(outcomes)))
        return ranked(table, some, of(outcomes.cluster % 5))

    joined = pooled([part(np.s_[:90]), part(np.s_[90:])])
    again = build_report(joined, num_resamples=2000)
    assert to_json(again) == to_json(report)
    assert list(again.rows) == list(report.rows)


def test_differences_are_row_minus_reference(report, scorers):
    compared = [name for name, how in METRICS.items() if how.compared]
    pairs = itertools.product(scorers, ("hand-set", "IDM", "random"))
    wanted = {pair for pair in pairs if pair[0] != pair[1]}
    assert {(c.row, c.reference) for c in report.comparisons} == wanted
    assert len(report.comparisons) == len(wanted) * len(compared)
    for c in report.comparisons:
        ours = np.mean([run[c.metric].mean() for run in scorers[c.row]])
        theirs = np.mean([run[c.metric].mean() for run in scorers[c.reference]])
        assert c.difference.mean == pytest.approx(ours - theirs, abs=1e-12)
        assert c.p_holm >= c.difference.p
    found = {(c.row, c.reference, c.metric): c.verdict for c in report.comparisons}
    assert found["rc-irl", "random", "top1_fde"] == "better"
    assert found["rc-irl", "random", "percentile_rank"] == "better"
    assert found["twin", "hand-set", "top1_fde"] == "no difference"
    assert found["random", "hand-set", "mrr"] == "worse"


def test_many_rows_can_still_differ_after_holms_correction(outcomes):
    """With a fixed number of resamples, rows enough make every adjusted p large."""
    many = {f"learner {i}": [scored(outcomes, 0.1, i)] for i in range(12)}
    many["random"] = [scene_metrics(*random_scorer(0, outcomes.fde.shape), outcomes)]
    found = build_report(ranked(many, outcomes))
    assert max(c.p_holm for c in found.comparisons if c.metric == "top1_fde") <= 0.01
    fixed = build_report(ranked(many, outcomes), num_resamples=500)
    assert min(c.p_holm for c in fixed.comparisons) > 0.01


@pytest.mark.parametrize(
    ("mean", "p_holm", "higher_is_better", "word"),
    [
        (0.21, 0.04, True, "better"),
        (0.21, 0.04, False, "worse"),
        (-0.21, 0.04, False, "better"),
        (0.21, 0.05, True, "no difference"),
    ],
)
def test_a_word_needs_a_small_adjusted_p(mean, p_holm, higher_is_better, word):
    """Not the difference's own p, nor standard errors: many are looked at."""
    d = Difference(mean=mean, low=0.1, high=1.0, se=0.01, p=0.001)
    assert verdict(d, p_holm, higher_is_better) == word


def test_rates_at_the_ends_carry_the_exact_bound_of_vehicles(report):
    bound = 1.0 - 0.05 ** (1.0 / VEHICLES)
    crash = report.rows["rc-irl"]["crash_rate"]
    assert crash.exact
    assert (crash.value, crash.low) == (0.0, 0.0)
    assert crash.high == pytest.approx(bound)
    rank = report.rows["oracle"]["percentile_rank"]
    assert rank.exact
    assert (rank.value, rank.high) == (1.0, 1.0)
    assert rank.low == pytest.approx(1.0 - bound)
    assert not report.rows["random"]["crash_rate"].exact


def test_table_fits_and_has_the_numbers_of_the_report(report):
    text = format_table(report, 100)
    assert max(len(line) for line in text.splitlines()) <= 100
    found = report.rows["hand-set"]["top1_fde"]
    assert f"{found.value:.2f} [{found.low:.2f}, {found.high:.2f}]" in text
    for c in report.comparisons:
        shown = f"{c.difference.mean:+.3f} [" in text
        assert shown or c.row in BASELINE_ROWS or c.metric != "top1_fde"
    bound = 100.0 - 100.0 * 0.05 ** (1.0 / VEHICLES)
    assert f"0 (<= {bound:.1f})" in text
    assert f"100 (>= {100.0 - bound:.1f})" in text


def test_json_is_plain_versioned_and_complete(report):
    made = to_json(report)
    assert json.loads(json.dumps(made, allow_nan=False)) == made
    assert (made["schema"], made["schema_version"]) == ("rcirl-jax/ranking-report", 1)
    assert (made["miss_threshold_m"], made["failure_m"]) == (6.0, 10.0)
    assert set(made["rows"]["rc-irl"]) == set(METRICS) == set(made["metrics"])
    found = dataclasses.asdict(report.rows["rc-irl"]["top1_fde"])
    assert made["rows"]["rc-irl"]["top1_fde"] == pytest.approx(found, rel=1e-8)
    assert to_json(from_json(made)) == made
    with pytest.raises(InputError, match=r"report: schema: .*, 2\): expected .*, 1\)"):
        from_json({**made, "schema_version": 2, "added": 1})
    broken = dataclasses.replace(report.oracle_floor, se=float("nan"))
    with pytest.raises(InputError, match=r"oracle_floor\.se: nan"):
        to_json(dataclasses.replace(report, oracle_floor=broken))


def test_a_row_that_is_not_ahead_of_an_easy_one_is_told(scorers, outcomes, report):
    easy = ("random", "hand-set")
    assert not ranking_warnings(report, ["rc-irl"], easy)
    (same,) = ranking_warnings(report, ["twin"], easy)  # as noisy as hand-set
    assert same.startswith("ranking: twin is not shown to be better than hand-set, ")
    worst = scene_metrics(outcomes.fde, outcomes.fde[:, 0], outcomes)
    found = build_report(ranked({**scorers, "twin": [worst]}, outcomes))
    said = ranking_warnings(found, ["twin"], easy)
    again = from_json(to_json(dataclasses.replace(found, warnings=said)))
    assert "warning: ranking: twin is worse than hand-set, " in format_table(again)
    assert "worse than random, " in again.warnings[0]
