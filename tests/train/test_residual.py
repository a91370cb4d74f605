"""V as a residual on an own cost: what is positive, what is summed, what is written."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.export.closed_loop import score_of
from rcirl_jax.export.from_run import export_run
from rcirl_jax.features import feature_map
from rcirl_jax.planner.own_cost import own_cost
from rcirl_jax.planner.prediction import with_predicted_futures
from rcirl_jax.planner.rank import hand_score
from rcirl_jax.planner.safety import check
from rcirl_jax.train.featurise import candidates_of, featurise, host_batch
from rcirl_jax.train.loop import restore_run, train
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.train.step import init_state, loss_inputs
from rcirl_jax.types import Tag
from tests.helpers.stored import rows_of
from tests.train.test_step import SMALL, normaliser

CONFIG = TrainConfig(
    loss="listwise", positive="nearest", admissible_in="simulated", batch_size=16,
    residual_on="hand-set", own_unit=2.0, slowed=(0.0, 0.5), sampler=SMALL,
)  # fmt: skip
COUNT = 16


def batch():
    """Half of the scenes were driven in the simulator."""
    rows = rows_of(range(COUNT))
    tags = np.array(rows.scene.tags)
    tags[::2, Tag.SIMULATED] = True
    rows = rows.replace(scene=rows.scene.replace(tags=tags))
    return jax.device_put(host_batch(rows, np.ones(COUNT), np.arange(COUNT)))


@pytest.fixture(scope="module")
def made():
    given = batch()
    state = init_state(CONFIG, normaliser())
    features = feature_map(CONFIG.features)
    return given, jax.jit(lambda b: featurise(state.key, b, CONFIG, features))(given)


def test_where_nobody_was_recorded_the_own_cost_says_what_is_chosen(made):
    _, found = made
    own, feasible = np.asarray(found.info.own), np.asarray(found.feasible)
    mine, there = np.asarray(found.info.human_own), feasible.any(axis=1)
    assert np.isfinite(own).all()
    simulated = np.arange(COUNT) % 2 == 0
    best = np.where(feasible, own, -np.inf).max(axis=1)
    assert (mine >= best - 1e-6)[simulated & there].all()
    # what people did is not what the cost would have chosen
    assert (mine < best)[~simulated & there].any()


def test_only_simulated_scenes_are_slowed_and_their_candidates_admitted(made):
    given, found = made
    key = jax.random.fold_in(init_state(CONFIG, normaliser()).key, 1)
    recorded = jax.tree.map(lambda x: x[1], given.demonstrations)
    recorded = recorded.replace(scene=with_predicted_futures(recorded.scene))
    assert int(given.index[1]) == 1
    candidates = jax.jit(lambda *x: candidates_of(*x, CONFIG))(key, recorded)
    values = jax.jit(hand_score)(None, recorded.scene, candidates) / CONFIG.own_unit
    np.testing.assert_allclose(found.info.own[1], values, rtol=1e-4, atol=1e-4)
    speed = feature_map(CONFIG.features).names.index("velocity")
    shown = np.asarray(found.human)[:, 0, speed]
    share = shown / np.maximum(np.asarray(given.demonstrations.scene.ego.v), 1e-3)
    assert share[1::2] == pytest.approx(1.0, abs=1e-3)
    drawn = {round(float(x), 2) for x in share[::2]}
    assert drawn <= {0.0, 0.5, 1.0}
    assert len(drawn) == 3
    # the rows of the recorded scene count what the filter would refuse, too
    refused = ~np.asarray(jax.jit(check)(recorded.scene, candidates).admissible)
    assert (np.asarray(found.feasible)[1] & refused).any()


def test_what_is_compared_is_beta_own_plus_v(made):
    _, found = made
    state = init_state(CONFIG, normaliser())
    params = {**state.params, "log_beta": jnp.log(3.0)}
    alone = {name: x for name, x in params.items() if name != "log_beta"}
    of = state.apply_fn, state.normaliser, found
    both, v = (loss_inputs(of[0], p, *of[1:]) for p in (params, alone))
    expected = np.asarray(v.candidates) + 3.0 * np.asarray(found.info.own)
    np.testing.assert_allclose(both.candidates, expected, rtol=1e-5, atol=1e-5)
    expected = np.asarray(v.human) + 3.0 * np.asarray(found.info.human_own)
    np.testing.assert_allclose(both.human, expected, rtol=1e-5, atol=1e-5)


def test_the_file_says_the_gain_that_was_learned(simulated, tmp_path):
    config = dataclasses.replace(CONFIG, epochs=1, own_unit=0.5)
    config = dataclasses.replace(
        config, residual_on="tests/planner/costs/costs.py:headway_cost"
    )
    train(simulated, tmp_path / "run", config)
    reward = export_run(tmp_path / "run", simulated, tmp_path / "w.msgpack")
    beta = float(jnp.exp(restore_run(tmp_path / "run", config).params["log_beta"]))
    prior, own = reward.prior_cost, own_cost(config.residual_on)
    assert prior.incumbent == "headway_cost"
    assert prior.gain == pytest.approx(0.5 / beta, rel=1e-5)
    assert beta != 1.0
    assert reward.provenance["own_cost"]["sha256"] == own.sha256
    _, params = score_of(reward, own)
    assert float(params.gain) == pytest.approx(prior.gain)
