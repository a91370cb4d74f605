"""Members trained side by side on frozen candidates."""

import dataclasses

import jax
import numpy as np
import pytest

from rcirl_jax.features import feature_map
from rcirl_jax.train.state import TrainState
from rcirl_jax.train.step import (
    init_state,
    keep_hardest_negatives,
    loss_inputs,
    make_train_step,
)
from rcirl_jax.train.sweep import fit, freeze, members_of
from tests.train.test_step import CONFIG, batch, human_is_better, normaliser, rows

SHORT = dataclasses.replace(CONFIG, epochs=3)


def test_freezing_equals_featurising():
    made = freeze(rows(), np.arange(16), CONFIG)
    assert made.candidates.shape[0] == 16
    again = freeze(jax.tree.map(lambda x: x[4:7], rows()), np.arange(4, 7), CONFIG)
    times = again.candidates.shape[2]  # those valid in none of the three are cut off
    assert not made.time_valid[4:7, times:].any()
    np.testing.assert_allclose(
        again.candidates, made.candidates[4:7, :, :times], rtol=1e-5, atol=1e-4
    )
    names = feature_map(CONFIG.features).names
    place = [names.index("station"), names.index("l")]
    gap = np.asarray(made.points - made.human[:, None], np.float64)[..., place]
    seen = np.asarray(made.time_valid, np.float64)
    far = np.einsum("skt,st->sk", np.hypot(*np.moveaxis(gap, -1, 0)), seen)
    want = far / seen.sum(axis=1)[:, None]
    np.testing.assert_allclose(made.info.distance, want, atol=2e-3)
    assert want.max() > 1.0


def test_a_member_takes_the_steps_of_the_training_step():
    """Full batches, so that the order of scenes does not matter."""
    config = dataclasses.replace(SHORT, learning_rate=0.01, weight_decay=0.01)
    made = human_is_better()
    fitted = fit(made, normaliser(), config, members_of([config]))
    state: TrainState = init_state(config, normaliser())
    step = jax.jit(make_train_step(config))
    for epoch in range(3):
        state, metrics = step(state, made)
        assert float(fitted.loss[0, epoch]) == pytest.approx(
            float(metrics.loss_sum / metrics.terms), rel=1e-3, abs=1e-5
        )
    pairs = map(jax.tree.leaves, (fitted.params, state.params))
    for a, b in zip(*pairs, strict=True):
        np.testing.assert_allclose(a[0], b, rtol=2e-3, atol=2e-5)
    assert bool(fitted.finite.all())


def test_the_last_batch_may_be_short_and_counts_every_scene_once():
    config = dataclasses.replace(SHORT, batch_size=5, epochs=1, learning_rate=1e-9)
    made = human_is_better()
    fitted = fit(made, normaliser(), config, members_of([config]))
    whole = dataclasses.replace(config, batch_size=16)
    once = fit(made, normaliser(), whole, members_of([whole]))
    assert float(fitted.loss[0, 0]) == pytest.approx(float(once.loss[0, 0]), rel=1e-4)


def test_mining_keeps_what_the_reward_values_most():
    config = dataclasses.replace(CONFIG, hard_negatives=2, hard_pool=3)
    made = freeze(rows(), np.arange(16), config)
    state = init_state(config, normaliser())
    given = state.apply_fn, state.params, normaliser(), made
    kept = jax.jit(keep_hardest_negatives, static_argnums=(0, 4))(*given, config)
    values = jax.jit(loss_inputs, static_argnums=0)(*given).candidates
    pool = np.asarray(made.feasible)[:, -6:]
    chosen = np.asarray(kept.feasible)[:, -6:]
    assert (chosen.sum(axis=1) == np.minimum(2, pool.sum(axis=1))).all()
    for v, p, c in zip(np.asarray(values)[:, -6:], pool, chosen, strict=True):
        if c.any() and (p & ~c).any():
            assert v[c].min() >= v[p & ~c].max()
    np.testing.assert_array_equal(kept.feasible[:, :-6], made.feasible[:, :-6])
    _, metrics = jax.jit(make_train_step(config))(state, batch())
    assert bool(metrics.finite)
