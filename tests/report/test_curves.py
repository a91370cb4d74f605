"""Response curves of a reward whose answer is known."""

import dataclasses

import numpy as np
import pytest

from rcirl_jax.export.loading import open_reward
from rcirl_jax.report.tuning.curves import responses
from tests.helpers.weights_files import random_weights


def test_a_linear_reward_answers_along_a_line_and_not_beyond_its_range(tmp_path):
    """R_i(u) = w_i sum_t gamma_t (clip(u) - median) / scale_i / spread."""
    reward = open_reward(str(random_weights(tmp_path / "w.msgpack", 1)))
    rng = np.random.default_rng(0)
    weight = rng.normal(size=(len(reward.names), 1)).astype(np.float32)
    lower, upper = reward.lower.copy(), reward.upper.copy()
    lower[0], upper[0] = -1.0, 2.0
    lower[1] = upper[1]  # without effect
    linear = dataclasses.replace(
        reward, kernels=(weight,), biases=(np.zeros(1, np.float32),),
        activation="identity", lower=lower, upper=upper, context=None,
    )  # fmt: skip
    shape = (30, 18, len(reward.names))
    mine = rng.normal(0.0, 2.0, shape).astype(np.float32)
    theirs = rng.normal(0.0, 2.0, (30, 8, *shape[1:])).astype(np.float32)
    valid = np.ones(shape[:2], bool)
    valid[3, 10:] = False
    found = responses(linear, mine, theirs, valid)
    assert set(found) == set(reward.names) - {reward.names[1]}
    one = found[reward.names[0]]
    assert one.at[0] < -1.0
    assert one.at[-1] > 2.0
    spread = np.mean(np.std(linear.value(theirs, valid[:, None]), axis=1))
    gamma = np.where(valid, linear.gamma, 0.0).sum(axis=1).mean()
    moved = np.clip(one.at, -1.0, 2.0) - np.clip(np.median(mine[..., 0][valid]), -1, 2)
    wanted = weight[0, 0] * gamma * moved / linear.scale[0] / spread
    assert one.value == pytest.approx(wanted, rel=1e-3, abs=1e-4)
