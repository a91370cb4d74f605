"""Response curves of a reward whose answer is known."""

import dataclasses

import numpy as np
import pytest

from rcirl_jax.export.loading import open_reward
from rcirl_jax.export.responses import prices, responses
from tests.helpers.weights_files import LOWER, UPPER, random_weights


def linear(tmp_path, **ends):
    """A linear reward, its weights [F, 1], and other ends of features' ranges."""
    reward = open_reward(str(random_weights(tmp_path / "w.msgpack", 1)))
    draw = np.random.default_rng(0).normal
    weight = draw(size=(len(reward.names), 1)).astype(np.float32)
    made = dataclasses.replace(
        reward, kernels=(weight,), biases=(np.zeros(1, np.float32),),
        activation="identity", scene_gating=None, **ends,
    )  # fmt: skip
    return made, weight


def test_a_linear_reward_answers_along_a_line_and_not_beyond_its_range(tmp_path):
    """R_i(u) = w_i sum_t gamma_t (clip(u) - median) / scale_i / spread."""
    lower, upper = LOWER.copy(), UPPER.copy()
    lower[0], upper[0] = -1.0, 2.0
    lower[1] = upper[1]  # without effect
    reward, weight = linear(tmp_path, lower=lower, upper=upper)
    rng = np.random.default_rng(1)
    shape = (30, 18, len(reward.names))
    mine = rng.normal(0.0, 2.0, shape).astype(np.float32)
    theirs = rng.normal(0.0, 2.0, (30, 8, *shape[1:])).astype(np.float32)
    valid = np.ones(shape[:2], bool)
    valid[3, 10:] = False
    found = responses(reward, mine, theirs, valid)
    assert set(found) == set(reward.names) - {reward.names[1]}
    one = found[reward.names[0]]
    assert one.at[0] < -1.0
    assert one.at[-1] > 2.0
    spread = np.mean(np.std(reward.value(theirs, valid[:, None]), axis=1))
    gamma = np.where(valid, reward.gamma, 0.0).sum(axis=1).mean()
    moved = np.clip(one.at, -1.0, 2.0) - np.clip(np.median(mine[..., 0][valid]), -1, 2)
    wanted = weight[0, 0] * gamma * moved / reward.scale[0] / spread
    assert one.value == pytest.approx(wanted, rel=1e-3, abs=1e-4)


def test_the_price_of_a_linear_reward_is_its_weight(tmp_path):
    """p_i = w_i sum_t gamma_t / scale_i inside of the range, 0 without effect."""
    upper = UPPER.copy()
    upper[1] = LOWER[1]
    reward, weight = linear(tmp_path, upper=upper)
    middle = np.broadcast_to(0.5 * (LOWER + UPPER), (5, 18, LOWER.size))
    valid = np.ones((5, 18), bool)
    valid[:, 12:] = False
    found = prices(reward, middle.astype(np.float32), valid)
    wanted = weight[:, 0] * reward.gamma[:12].sum() / reward.scale
    assert reward.names[1] not in found
    for i, name in enumerate(reward.names):
        if i != 1:
            assert found[name] == pytest.approx(wanted[i], rel=1e-2, abs=1e-4), name
    beyond = prices(reward, middle.astype(np.float32) + 1e4, valid)
    assert set(beyond.values()) == {0.0}
