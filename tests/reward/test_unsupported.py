"""Nothing untrained drives: a feature that never varied in training has no effect."""

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.features import feature_map
from rcirl_jax.reward import (
    RewardConfig,
    RewardModel,
    fit_normaliser,
    init_params,
    value,
)
from rcirl_jax.reward.normaliser import VARYING_SHARE, supported, unsupported

FEATURES = feature_map("paper21")
NEVER = ("stop_distance", "stop_speed", "virtual_distance", "virtual_speed")
GATED = RewardConfig(
    hidden=(32, 16), scale_constraint="none", scene_gating=FEATURES.context
)


def rows(count=4000):
    """Training features: all vary but those of lines and destinations."""
    rng = np.random.default_rng(0)
    lower = np.array([s.lower for s in FEATURES.specs])
    upper = np.array([s.upper for s in FEATURES.specs])
    made = rng.uniform(lower, upper, (count, FEATURES.num_features))
    for name in NEVER:
        at = FEATURES.names.index(name)
        made[:, at] = FEATURES.specs[at].none
    return made


def redrawn(params, seed):
    """The same reward but for the weights that read the unsupported columns."""
    at = jnp.asarray([FEATURES.names.index(name) for name in NEVER])
    draw = lambda x: 5.0 * jax.random.normal(jax.random.key(seed), x.shape)  # noqa: E731
    first = params["point"]["hidden_0"]
    first = {**first, "kernel": first["kernel"].at[at].set(draw(first["kernel"][at]))}
    context = params["scene_gating"]
    context = context.at[at].set(draw(context[at]))
    context = context.at[:, at].set(draw(context[:, at]))
    point = {**params["point"], "hidden_0": first}
    return {**params, "point": point, "scene_gating": context}


def weights():
    key = jax.random.key(1)
    params = init_params(key, FEATURES.num_features, GATED)
    shape = params["scene_gating"].shape
    params["scene_gating"] = 0.1 * jax.random.normal(key, shape)
    return params, fit_normaliser(rows(), FEATURES)


def test_they_are_found_and_named():
    _, norm = weights()
    assert unsupported(norm.lower, norm.upper, FEATURES.names) == list(NEVER)
    # one in 500 rows is enough, fewer are not
    made = rows(10_000)
    at = FEATURES.names.index("stop_distance")
    made[: round(VARYING_SHARE * 10_000), at] = 12.0
    found = fit_normaliser(made, FEATURES)
    assert "stop_distance" not in unsupported(found.lower, found.upper, FEATURES.names)
    made[0, at] = made[-1, at]
    found = fit_normaliser(made, FEATURES)
    assert "stop_distance" in unsupported(found.lower, found.upper, FEATURES.names)


def test_their_weights_change_no_value_and_get_no_gradient():
    (params, norm), seed = weights(), 0
    x = np.random.default_rng(seed).uniform(-50.0, 120.0, (7, 18, 21))
    x, valid = jnp.asarray(x, jnp.float32), jnp.ones((7, 18), bool)
    of = lambda p: value(RewardModel(GATED), p, norm, x, valid)  # noqa: E731
    np.testing.assert_array_equal(of(params), of(redrawn(params, seed)))
    grad = jax.grad(lambda p: jnp.sum(of(p) ** 2))(params)
    at = [FEATURES.names.index(name) for name in NEVER]
    slope = np.asarray(grad["point"]["hidden_0"]["kernel"])
    assert not np.any(slope[at])
    assert np.all(np.any(slope, axis=1)[: FEATURES.num_features - 8])


def test_a_scene_is_known_while_they_are_as_they_always_were():
    _, norm = weights()
    usual = norm.location.at[FEATURES.names.index("velocity")].set(1e3)  # it varies
    assert bool(supported(norm, usual))
    at = FEATURES.names.index("stop_distance")
    assert float(norm.location[at]) == 60.0  # m: no line
    for distance, known in ((59.0, True), (58.0, False), (0.0, False)):
        assert bool(supported(norm, usual.at[at].set(distance))) == known
    assert not bool(supported(norm, usual.at[at + 1].set(-10.0)))
