"""The tuned hand-set cost: the search, its objectives, its file, its rows."""

import dataclasses
import functools
import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.score import candidates_key
from rcirl_jax.evaluation.rivals.cma_es import equal_budget, tune
from rcirl_jax.evaluation.rivals.objectives import (
    RankedScenes,
    drive_value,
    mean_fde,
    ranked_scenes,
    suite_problem,
)
from rcirl_jax.export.hand_weights import load_hand_weights, write_hand_weights
from rcirl_jax.planner.rank import RankConfig
from rcirl_jax.reward import (
    TUNABLE,
    TUNED_ROW,
    LatticeCost,
    lattice_cost,
    tuned,
    weighted_cost,
)
from rcirl_jax.reward.hand import LatticeTerms
from rcirl_jax.sampling import SamplerConfig, sample
from rcirl_jax.simulation.rows import baseline_row, tuned_row
from tests.evaluation.driven import long_rows, mean_chosen_fde, scored_rivals
from tests.helpers.scenes import T, unfused

D = len(TUNABLE)
SMALL = SamplerConfig(num_random=16, cruise_times=(4.0,), edge_times=(4.0,))
HIDDEN = np.array([-2.0, 1.5, -2.0, 1.5, 0.0, -1.0, 2.0, -0.7])
SCENES = 40
INDEX = np.arange(SCENES)


# ------------------------------------------------------------------ the search


class Counted:
    def __init__(self, function):
        self.function, self.used = function, 0

    def __call__(self, vectors):
        self.used += len(vectors)
        return np.array([self.function(x) for x in vectors])


def sphere(x):
    return float(np.sum((x - np.arange(x.size) / 3.0) ** 2))


def search(function, budget, seed=0, d=D):
    return tune(function, np.zeros(d), 0.5, budget, seed, progress=False)


def test_it_finds_the_minimum_of_a_shifted_sphere():
    counted = Counted(sphere)
    result = search(counted, 1500)
    np.testing.assert_allclose(result.vector, np.arange(D) / 3.0, atol=1e-3)
    assert result.value < 1e-6
    assert counted.used == result.evaluations == 1500
    best = [generation["best"] for generation in result.history]
    assert best == sorted(best, reverse=True)
    assert best[0] == pytest.approx(sphere(np.zeros(D)))
    assert best[-1] == result.value
    json.dumps(result.history, allow_nan=False)


@pytest.mark.parametrize("budget", [1, 2, 10, 11, 12, 57])
def test_it_never_exceeds_the_budget(budget):
    counted = Counted(sphere)
    result = search(counted, budget)
    assert counted.used == result.evaluations == budget
    assert result.value <= sphere(np.zeros(D))


def test_the_seed_alone_decides():
    first = search(Counted(sphere), 90, seed=3)
    np.random.seed(17)  # noqa: NPY002  # a state that must not matter
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    again = search(Counted(sphere), 90, seed=3)
    np.testing.assert_array_equal(before, np.random.get_state()[1])  # noqa: NPY002
    np.testing.assert_array_equal(first.vector, again.vector)
    assert first.history == again.history
    assert search(Counted(sphere), 90, seed=4).value != first.value


def test_nan_is_the_worst_and_flat_is_no_trap():
    """Where half the space is NaN the other half's minimum is found."""
    walled = Counted(lambda x: sphere(x) if x[1] < 0.2 else np.nan)
    result = search(walled, 900)
    assert result.value == pytest.approx((1.0 / 3.0 - 0.2) ** 2, rel=0.1)
    stepped = search(Counted(lambda x: np.floor(sphere(x) / 50.0)), 300)
    assert stepped.evaluations == 300
    assert stepped.history[-1]["restart"] > 0
    with pytest.raises(InputError, match="nowhere finite"):
        search(Counted(lambda _: np.nan), 30)


def test_what_a_search_refuses(monkeypatch):
    with pytest.raises(InputError, match="--budget: 0: expected at least 1"):
        search(sphere, 0)
    with pytest.raises(InputError, match="--sigma: 0"):
        tune(Counted(sphere), np.zeros(D), 0.0, 10, 0, progress=False)
    monkeypatch.setitem(sys.modules, "cma", None)
    with pytest.raises(InputError, match=r"pip install 'rcirl-jax\[tune\]'"):
        search(sphere, 10)


def test_equal_budget_is_stated_in_queries():
    learner = {"scenes": 2000, "candidates": 100, "epochs": 20}
    assert equal_budget(**learner, queries_per_evaluation=256 * 100) == 156
    assert equal_budget(**learner, queries_per_evaluation=4_000_000) == 1
    with pytest.raises(InputError, match="--epochs: 20: 4,000,000 queries"):
        equal_budget(**learner, queries_per_evaluation=4_000_001)


# -------------------------------------------------------------------- the cost


@functools.cache
def some_rows():
    """Demonstrations in random scenes, all of 8 s, and their candidates [S, K]."""
    rows = long_rows(SCENES)
    make = jax.jit(jax.vmap(lambda i, s: sample(candidates_key(i), s, SMALL)))
    return rows, make(INDEX, rows.scene)


def ranked(rows):
    return ranked_scenes(rows, INDEX, SMALL, 8.0)


def costs(terms, weights):
    """[S, K], eagerly: nothing is fused."""
    return jax.vmap(jax.vmap(lambda x: weighted_cost(x, weights)))(terms)


def test_zeros_are_apollos_weights_exactly():
    weights = tuned(jnp.zeros(D))
    for name, value in LatticeCost().fields().items():
        assert float(getattr(weights, name)) == float(value)
    terms = ranked(some_rows()[0]).terms
    for same in (weights, LatticeCost(**LatticeCost().fields())):
        expected = costs(terms, LatticeCost())
        np.testing.assert_array_equal(costs(terms, same), expected)
    rows, candidates = some_rows()
    pick = lambda tree, *at: jax.tree.map(lambda x: jnp.asarray(x)[at], tree)  # noqa: E731
    drive = pick(rows.scene, 1), pick(candidates.trajectory, 1, 20)
    cost = unfused(lambda fields, *x: lattice_cost(*x, LatticeCost(**fields)))
    found, wanted = (cost(w.fields(), *drive) for w in (weights, LatticeCost()))
    assert float(found) == float(wanted)


def test_one_program_scores_any_weights():
    terms = ranked(some_rows()[0]).terms
    compiled = jax.jit(lambda x: costs(terms, tuned(x)))
    for seed in range(4):
        x = jnp.asarray(np.random.default_rng(seed).normal(size=D), jnp.float32)
        expected = costs(terms, tuned(x))
        np.testing.assert_allclose(compiled(x), expected, rtol=1e-5)
    assert compiled._cache_size() == 1


def test_tuned_weights_stay_in_their_ranges():
    far = tuned(jnp.full(D, 50.0))
    assert float(far.speed_share) == pytest.approx(2.0)
    assert float(far.jerk) == pytest.approx(np.exp(10.0), rel=1e-5)
    assert float(far.collision_check) == pytest.approx(1e3 * np.exp(10.0), rel=1e-5)
    near = tuned(jnp.full(D, -50.0))
    assert float(near.speed_share) == pytest.approx(0.05)
    assert float(near.collision_check) == 1e3
    with pytest.raises(ValueError, match="expected 8"):
        tuned(jnp.zeros(3))


def test_a_lower_share_wants_a_lower_speed():
    terms, speeds = ranked(some_rows()[0]).terms, []
    for share in (0.3, 0.5, 0.8):
        only = dict.fromkeys(("objective_distance", "collision_check"), 0.0)
        weights = LatticeCost(speed_share=share, objective=1e4, **only)
        chosen = jnp.argmin(costs(terms, weights), axis=1)
        speeds.append(float(terms.speed[INDEX, chosen].mean()))
    assert speeds[0] < speeds[1] < speeds[2]


# -------------------------------------------------------------- the objectives


@functools.cache
def driven_by_the_hidden_cost():
    """Demonstrations whose human is the candidate that a hidden cost chooses."""
    rows, candidates = some_rows()
    scenes, weights = ranked(rows), tuned(jnp.asarray(HIDDEN, jnp.float32))
    cost = costs(scenes.terms, weights)
    best = np.argmin(np.where(scenes.feasible, cost, np.inf), axis=1)
    human = jax.tree.map(lambda x: np.asarray(x)[INDEX, best], candidates.trajectory)
    return rows.replace(human=human)


def test_the_search_comes_close_to_a_hidden_cost():
    scenes = ranked(driven_by_the_hidden_cost())
    default, hidden = mean_fde(scenes, np.stack([np.zeros(D), HIDDEN]))
    assert default > 10.0
    assert hidden < 0.05  # near ties
    result = tune(lambda x: mean_fde(scenes, x), np.zeros(D), 1.0, 400, 0, False)
    assert result.value < 0.2 * default


def random_ranked(scenes, candidates, seed=0):
    rng = np.random.default_rng(seed)
    shape = (scenes, candidates)
    draw = lambda *tail: jnp.asarray(rng.uniform(0.1, 20.0, (*shape, *tail)), "float32")  # noqa: E731
    approach = jnp.where(draw(T) > 6.0, jnp.inf, draw(T))
    terms = {name: draw(T) for name in ("limit", "speed", "early")}
    for name in LatticeTerms._fields[4:-1]:
        terms[name] = draw()
    collides = jnp.asarray(rng.uniform(size=shape) < 0.1)
    terms = LatticeTerms(**terms, approach=approach, collides=collides)
    feasible = jnp.asarray(rng.uniform(size=shape) < 0.7).at[0].set(False)
    return RankedScenes(terms=terms, fde=draw(), feasible=feasible)


def slowly(scenes, vector):
    """Mean FDE in float64 numpy."""
    t = {k: np.asarray(x, np.float64) for k, x in scenes.terms._asdict().items()}
    weights = tuned(jnp.asarray(vector, jnp.float32)).fields()
    w = {name: float(x) for name, x in weights.items()}
    reference = np.minimum(w["speed_share"] * t["limit"], t["approach"])
    off = np.sum(t["early"] * np.abs(reference - t["speed"]), -1) / t["early"].sum(-1)
    near, far = w["objective_speed"], w["objective_distance"]
    cost = w["objective"] * (near * off + far / (1 + t["travelled"])) / (near + far)
    for name in LatticeTerms._fields[5:-1]:
        cost = cost + w[name] * t[name]
    cost = cost + w["collision_check"] * t["collides"]
    cost = np.where(np.asarray(scenes.feasible), cost, np.inf)
    return np.asarray(scenes.fde)[np.arange(len(cost)), cost.argmin(axis=1)].mean()


def test_mean_fde_against_numpy_in_any_company():
    """More sums in one program than jaxlib 0.10.2 gets right at once on a CPU."""
    scenes = random_ranked(600, 70)
    vectors = np.random.default_rng(1).normal(size=(11, D))
    together = mean_fde(scenes, vectors)
    expected = [slowly(scenes, x) for x in vectors]
    np.testing.assert_allclose(together, expected, atol=0.02)  # near ties
    np.testing.assert_array_equal(together[::-1], mean_fde(scenes, vectors[::-1]))
    np.testing.assert_array_equal(together[3:4], mean_fde(scenes, vectors[3:4]))


def test_the_objective_is_what_the_ranking_report_measures():
    rows = driven_by_the_hidden_cost()
    cost = tuned(jnp.asarray(HIDDEN, jnp.float32))
    scored = scored_rivals(rows, SMALL, {TUNED_ROW: cost, "again": LatticeCost()})
    np.testing.assert_allclose(
        scored.values["again"], scored.values["hand-set"], rtol=1e-5, atol=1e-3
    )
    found = [mean_chosen_fde(scored, name) for name in ("hand-set", TUNED_ROW)]
    expected = mean_fde(ranked(rows), np.stack([np.zeros(D), HIDDEN]))
    np.testing.assert_allclose(found, expected, atol=0.05)


def test_drive_value_charges_faults_twice():
    @dataclasses.dataclass
    class Metrics:
        progress: np.ndarray
        at_fault: np.ndarray

        def __getattr__(self, name):
            return np.ones(4)

        @property
        def no_fault(self):
            return np.where(self.at_fault > 0, 0.0, 1.0)

    reference = np.full(4, 100.0)
    clean = Metrics(np.full(4, 100.0), np.zeros(4))
    assert drive_value(clean, reference) == pytest.approx(1.0)
    crashed = Metrics(np.full(4, 100.0), np.array([0, 2, 0, 0]))
    assert drive_value(crashed, reference) == pytest.approx(0.75 - 0.25)
    slow = Metrics(np.full(4, 50.0), np.zeros(4))
    assert drive_value(slow, reference) == pytest.approx(1.0 - 2.5 / 16.0)


def test_a_suite_that_cannot_be_driven_is_one_line():
    with pytest.raises(InputError, match="--suite: hope: expected full, smoke or"):
        suite_problem("hope", 1, 5.0, 0)
    with pytest.raises(InputError, match=r"--duration: 0\.5: expected 1 to 120 s"):
        suite_problem("smoke", 1, 0.5, 0)


@pytest.mark.slow
def test_driving_is_scored_case_by_case_with_one_program():
    problem = suite_problem("free_cruise,stopped_lead", 2, 20.0, 0)
    assert problem.queries == 4 * 200 * 64
    lazy = np.zeros(D)
    lazy[-1] = np.log(0.4)
    default, again, slower = problem.objective(
        np.stack([np.zeros(D), np.zeros(D), lazy])
    )
    assert default == again < slower  # lower is better
    assert -1.0 <= default < -0.5


# ---------------------------------------------------------------- file and rows


def test_tuned_rows_share_the_policy_of_the_hand_set_row():
    config = RankConfig()
    row = tuned_row(LatticeCost(jerk=3.0), config)
    hand = baseline_row("hand-set", "paper21", None, config)  # type: ignore[arg-type]
    assert row.policy is hand.policy
    assert row.name == TUNED_ROW
    assert float(row.params["jerk"]) == 3.0


def test_file_round_trip(tmp_path):
    cost = tuned(jnp.asarray(HIDDEN, jnp.float32))
    path = tmp_path / "new" / "tuned.json"
    write_hand_weights(path, cost, {"made_by": {"git": "none"}})
    found = load_hand_weights(path)
    for name, value in cost.fields().items():
        assert np.float32(getattr(found, name)) == np.asarray(value)
    assert json.loads(path.read_text())["made_by"] == {"git": "none"}
    assert [p.name for p in path.parent.iterdir()] == ["tuned.json"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda b: b.update(schema="other"), "schema: other: expected rcirl-jax/hand"),
        (lambda b: b.update(schema_version=2), "schema_version: 2: expected 1"),
        (lambda b: b.pop("weights"), "weights: None: expected an object"),
        (lambda b: b["weights"].update(jerk=10**400), "jerk: 1.*out of range"),
        (lambda b: b["weights"].pop("jerk"), "weights: jerk: missing: expected"),
        (lambda b: b["weights"].update(jrk=1.0), "weights: jrk: unknown: expected"),
        (lambda b: b["weights"].update(jerk="1"), "jerk: 1: expected a number"),
        (lambda b: b["weights"].update(jerk=True), "jerk: True: expected a num"),
        (
            lambda b: b["weights"].update(jerk=float("nan")),
            "jerk: nan: expected a num",
        ),
        (
            lambda b: b["weights"].update(jerk=-1.0),
            r"jerk: -1\.0: expected a num",
        ),
        (
            lambda b: b["weights"].update(speed_share=0),
            "speed_share: 0: expected a number > 0",
        ),
    ],
)
def test_files_that_are_refused(tmp_path, change, message):
    path = tmp_path / "tuned.json"
    write_hand_weights(path, LatticeCost(), {})
    body = json.loads(path.read_text())
    change(body)
    path.write_text(json.dumps(body))
    with pytest.raises(InputError, match=message) as caught:
        load_hand_weights(path)
    assert str(path) in str(caught.value)


def test_files_that_are_no_files(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.json: No such file"):
        load_hand_weights(tmp_path / "nowhere.json")
    (tmp_path / "text.json").write_text("{")
    with pytest.raises(InputError, match=r"text\.json: .*expected JSON"):
        load_hand_weights(tmp_path / "text.json")
    (tmp_path / "list.json").write_text("[]")
    with pytest.raises(InputError, match="schema: None"):
        load_hand_weights(tmp_path / "list.json")
