"""Identifiability: oracles, coverage with dependent scenes, what cannot be told."""

import json

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.special import expit, ndtr
from scipy.stats import t as student

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.insight.identify import identify, to_json
from rcirl_jax.evaluation.insight.identify_text import format_report

NAMES = ("speed", "gap", "jerk", "offset")
UNITS = ("m/s", "m", "m/s^3", "m")
ONE = np.ones(4)


def simulated(rng, truth, vehicles=40, scenes=8, shared=0.7):
    """Pairs whose outcome follows Bradley-Terry, dependent within a vehicle.

    Each outcome's uniform number has a part that its vehicle shares (a Gaussian
    copula), and so have the features: the margins stay exactly logistic.
    """
    size = (vehicles, scenes)
    own = rng.normal(size=(*size, truth.size))
    common = rng.normal(size=(vehicles, 1, truth.size))
    d = np.sqrt(shared) * common + np.sqrt(1.0 - shared) * own
    noise = np.sqrt(shared) * rng.normal(size=(vehicles, 1))
    uniform = ndtr(noise + np.sqrt(1.0 - shared) * rng.normal(size=size))
    # the human chose the first of the two where the second's lead was not enough
    lost = uniform < expit(-d @ truth)
    d = np.where(lost[..., None], d, -d).reshape(-1, truth.size)
    return d, np.repeat(np.arange(vehicles), scenes)


def report_of(d, cluster, names=NAMES, units=UNITS, scale=ONE, **options):
    return identify(
        d, np.ones(d.shape[:-1], bool), cluster, scale, names, units, **options
    )


def test_fit_and_errors_against_plain_loops():
    rng = np.random.default_rng(0)
    ridge, scale = 0.03, np.array([0.5, 2.0, 1.0, 4.0])
    d = rng.normal(size=(30, 3, 4))
    feasible, cluster = rng.random((30, 3)) < 0.7, rng.integers(5, 12, 30)
    found = identify(
        np.where(feasible[..., None], d, np.nan),
        feasible,
        cluster,
        scale,
        NAMES,
        UNITS,
        ridge=ridge,
        confidence=0.9,
    )
    pairs, owner = d[feasible], np.repeat(cluster, feasible.sum(axis=1))
    loss = lambda w: np.logaddexp(0, pairs @ w).mean() + 0.5 * ridge * w @ w  # noqa: E731
    w = minimize(loss, np.zeros(4), tol=1e-12, method="BFGS", options={"gtol": 1e-7}).x
    hessian, scores = ridge * np.eye(4), {}
    for row, who in zip(pairs, owner, strict=True):
        p = 1.0 / (1.0 + np.exp(-row @ w))
        hessian = hessian + p * (1.0 - p) * np.outer(row, row) / len(pairs)
        scores[who] = scores.get(who, 0.0) + (p * row + ridge * w) / len(pairs)
    count = len(scores)
    middle = sum(np.outer(u, u) for u in scores.values()) * count / (count - 1)
    inverse = np.linalg.inv(hessian)
    se = np.sqrt(np.diag(inverse @ middle @ inverse))
    reach = student.ppf(0.95, count - 1)
    assert found.pairs == len(pairs)
    assert found.clusters == count
    bare = hessian - ridge * np.eye(4)
    values = np.linalg.eigvalsh(bare)
    assert found.condition_number == pytest.approx(values[-1] / values[0], rel=1e-4)
    for i, row in enumerate(found.features):
        assert row.normalised == pytest.approx(w[i], abs=1e-5)
        assert row.weight == pytest.approx(w[i] / scale[i], abs=1e-5)
        assert row.se == pytest.approx(se[i] / scale[i], rel=1e-4)
        assert row.low == pytest.approx((w[i] - reach * se[i]) / scale[i], abs=1e-5)
        assert row.high == pytest.approx((w[i] + reach * se[i]) / scale[i], abs=1e-5)
        inflation = bare[i, i] * np.linalg.inv(bare)[i, i]
        assert row.variance_inflation == pytest.approx(inflation, rel=1e-4)
        share = (inverse @ bare)[i, i]
        assert row.resolution == pytest.approx(share, rel=1e-4)


def test_intervals_cover_the_truth_where_fishers_do_not():
    rng = np.random.default_rng(1)
    truth, repeats = np.array([0.8, -0.5, 0.0, 0.3]), 200
    covered, fisher = np.zeros(4), np.zeros(4)
    for _ in range(repeats):
        d, cluster = simulated(rng, truth)
        rows = report_of(d, cluster).features
        w = np.array([row.weight for row in rows])
        low, high = (
            np.array([getattr(r, end) for r in rows]) for end in ("low", "high")
        )
        covered += (low <= truth) & (truth <= high)
        p = expit(d @ w)
        plain = np.linalg.inv((d.T * (p * (1.0 - p))) @ d)
        fisher += np.abs(w - truth) <= 1.96 * np.sqrt(np.diag(plain))
    assert np.all(covered / repeats >= 0.88)
    assert np.all(covered / repeats <= 0.99)
    assert np.all(fisher / repeats < 0.80)


def test_what_is_supported_on_much_data():
    rng = np.random.default_rng(2)
    d, cluster = simulated(rng, np.array([0.8, -0.5, 0.0, 0.3]), vehicles=400)
    found = report_of(d, cluster)
    verdicts = [row.verdict for row in found.features]
    assert verdicts == ["supported", "supported", "may be 0", "supported"]
    assert found.loss < np.log(2.0)
    assert found.condition_number < 5.0
    assert all(row.variance_inflation < 1.2 for row in found.features)


@pytest.mark.parametrize("ridge", [1e-8, 1e-2])
def test_collinear_features_are_not_identified(ridge):
    """Whatever the ridge, and although the sandwich finds narrow intervals."""
    rng = np.random.default_rng(3)
    d, cluster = simulated(rng, np.array([0.8, -0.5, 0.4, 0.9]), vehicles=200)
    d[:, 3] = 2.0 * d[:, 0]
    found = report_of(d, cluster, ridge=ridge)
    assert found.condition_number > 1e12
    weakest = found.weak_directions[0]
    assert set(weakest.features[:2]) == {"speed", "offset"}
    np.testing.assert_allclose(weakest.loadings[:2], [2 / 5**0.5, -1 / 5**0.5])
    assert weakest.curvature < 1e-12
    verdicts = {row.name: row.verdict for row in found.features}
    assert verdicts["speed"] == verdicts["offset"] == "not identified"
    inflation = {row.name: row.variance_inflation for row in found.features}
    assert min(inflation["speed"], inflation["offset"]) > 1e9
    assert max(inflation["gap"], inflation["jerk"]) < 2.0
    if ridge == 1e-8:
        assert verdicts["gap"] == verdicts["jerk"] == "supported"


def test_nearly_collinear_features_widen_their_intervals():
    rng = np.random.default_rng(4)
    d, cluster = simulated(rng, np.array([0.8, -0.5, 0.4, 0.0]), vehicles=200)
    d[:, 3] = d[:, 0] + 0.1 * rng.normal(size=len(d))
    found = report_of(d, cluster)
    assert found.weak_directions[0].features[:2] in (
        ("speed", "offset"),
        ("offset", "speed"),
    )
    speed, gap = found.features[0], found.features[1]
    assert speed.variance_inflation > 50.0 > 2.0 > gap.variance_inflation
    assert speed.se > 4.0 * gap.se
    assert not speed.supported
    assert speed.verdict == "may be 0"


def test_a_feature_that_never_differs_is_not_supported():
    rng = np.random.default_rng(5)
    d, cluster = simulated(rng, np.array([0.8, -0.5, 0.4, 0.3]), vehicles=100)
    want = report_of(d[:, [0, 1, 3]], cluster, ("a", "b", "c"), ("m",) * 3, ONE[:3])
    d[:, 2] = 0.0
    found = report_of(d, cluster)
    constant = found.features[2]
    assert constant.verdict == "never differs"
    assert not constant.supported
    assert (constant.weight, constant.variance_inflation) == (0.0, None)
    assert constant.resolution == pytest.approx(0.0, abs=1e-9)
    # it says nothing about the others
    assert found.condition_number == pytest.approx(want.condition_number)
    assert all("jerk" not in row.features for row in found.weak_directions)
    assert found.features[3].low == pytest.approx(want.features[2].low)


def test_no_feature_differs():
    cluster = np.arange(6)
    found = report_of(np.zeros((6, 4)), cluster)
    assert [row.verdict for row in found.features] == ["never differs"] * 4
    assert found.weak_directions == ()
    assert "0 of 4 weights" in format_report(found)


def test_a_feature_by_which_the_human_always_wins_has_no_size():
    """The more it costs the better the fit, until the ridge holds the weight."""
    rng = np.random.default_rng(9)
    d, cluster = simulated(rng, np.array([0.8, -0.5, 0.4, 0.0]), vehicles=200)
    active = rng.random(len(d)) < 0.2
    d[:, 3] = np.where(active, rng.uniform(0.2, 1.0, len(d)), 0.0)
    found = report_of(d, cluster)
    assert found.features[3].weight < -10.0
    verdicts = [row.verdict for row in found.features]
    assert verdicts == [*["supported"] * 3, "not identified"]


def test_a_feature_that_is_seldom_active_can_be_supported():
    rng = np.random.default_rng(10)
    d, cluster = simulated(rng, np.array([0.8, -0.5, 0.4, 0.0]), vehicles=4000)
    rare = rng.random(len(d)) < 2e-3
    side = np.where(rng.random(len(d)) < 0.8, 1.0, -1.0)  # the human wins 4 of 5
    d[:, 3] = np.where(rare, side, 0.0)
    row = report_of(d, cluster).features[3]
    assert row.verdict == "supported"
    assert row.low < -np.log(4.0) < row.high


@pytest.mark.parametrize("seed", range(4))
def test_perfectly_ranked_pairs_are_not_mistaken_for_knowledge(seed):
    """Every pair is won: the weights grow until the ridge holds them."""
    rng = np.random.default_rng(seed)
    d, w = rng.normal(size=(60, 4)), rng.normal(size=4)
    found = report_of(-np.sign(d @ w)[:, None] * d, np.arange(60))
    assert found.separated
    assert found.loss < 1e-3
    assert {row.verdict for row in found.features} == {"not identified"}
    assert "wins every pair" in format_report(found)


def test_scale_turns_normalised_weights_into_physical_ones():
    rng = np.random.default_rng(7)
    d, cluster = simulated(rng, np.array([0.8, -0.5, 0.0, 0.3]))
    one, two = (report_of(d, cluster, scale=ONE * s) for s in (1.0, 2.0))
    # and the same data in other units mean the same weight
    same = report_of(d / 2.0, cluster, scale=ONE * 2.0)
    for a, b, c in zip(one.features, two.features, same.features, strict=True):
        assert b.weight == pytest.approx(0.5 * a.weight)
        assert b.high - b.low == pytest.approx(0.5 * (a.high - a.low))
        assert b.normalised == a.normalised
        assert b.supported == a.supported
        assert c.weight == pytest.approx(a.weight, rel=1e-3, abs=1e-5)


def test_json_and_text():
    rng = np.random.default_rng(8)
    names = ("a_feature_with_a_name_much_too_long_for_any_table_of_numbers", *NAMES[1:])
    d, cluster = simulated(rng, np.array([0.8, -0.5, 0.0, 0.3]), vehicles=12)
    d[:, 3] = 0.0
    found = report_of(d, cluster, names)
    body = json.loads(json.dumps(to_json(found), allow_nan=False))
    assert body["features"][0]["weight"] == found.features[0].weight
    assert body["features"][3]["verdict"] == "never differs"
    assert body["features"][3]["variance_inflation"] is None
    assert body["weak_directions"][0]["features"][0] in names
    assert body["clusters"] == 12
    for width in (90, 100, 140):
        text = format_report(found, width)
        assert all(len(line) <= width for line in text.splitlines())
        assert "never differs" in text
        assert "Fewer than 20 vehicles" in text
    with pytest.raises(InputError, match="width: 60: expected at least 90"):
        format_report(found, 60)


def test_input_that_does_not_fit_is_refused():
    good = {
        "differences": np.ones((6, 2, 4)),
        "feasible": np.ones((6, 2), bool),
        "cluster": np.arange(6),
        "scale": ONE,
        "names": NAMES,
        "units": UNITS,
    }
    bad_pair = np.ones((6, 2, 4))
    bad_pair[0, 0, 0] = np.nan
    cases = {
        "shapes": {"differences": np.ones((6, 2, 3))},
        "shapes .*": {"feasible": np.ones((6, 3), bool)},
        "shapes .* .*": {"cluster": np.arange(5)},
        "NaN or infinite": {"differences": bad_pair},
        "1 vehicles": {"cluster": np.zeros(6)},
        "0 vehicles": {"feasible": np.zeros((6, 2), bool)},
        "scale": {"scale": np.array([1.0, 0.0, 1.0, 1.0])},
        "names": {"names": ("a", "a", "b", "c")},
        "units": {"units": ("m",)},
        "ridge: 0": {"ridge": 0.0},
        "confidence: 1": {"confidence": 1.0},
    }
    for message, change in cases.items():
        with pytest.raises(InputError, match=f"^identify: .*{message}"):
            identify(**{**good, **change})
