"""A learned score on top of the incumbent's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.export.closed_loop import anchored_row, table_rows
from rcirl_jax.export.loading import open_reward, reward_params
from rcirl_jax.features import feature_map
from rcirl_jax.planner.anchor import anchored_score
from rcirl_jax.planner.guard import Ranges, worst_share
from rcirl_jax.planner.rank import ONLINE, hand_score, learned_score
from rcirl_jax.rehearsal import Rehearsal, teacher_of
from tests.scenes import random_scene, sampled
from tests.weights_files import random_weights

FEATURES = feature_map("paper21")


def everywhere(low, high):
    count = FEATURES.num_features
    return Ranges(low=jnp.full(count, low), high=jnp.full(count, high))


@pytest.mark.parametrize(("low", "high", "support"), [(-1e9, 1e9, 1.0), (9e9, 9e9, 0)])
def test_the_learned_value_counts_as_far_as_the_data_reach(
    tmp_path, low, high, support
):
    reward = open_reward(str(random_weights(tmp_path / "w.msgpack")))
    params = anchored_row("a", reward, "hand-set", 0.3).params
    params = params.replace(ranges=everywhere(low, high))
    scene = random_scene(3)
    candidates = sampled(jax.random.key(0), scene, ONLINE)
    score = anchored_score(FEATURES, reward.activation, hand_score)
    ours = learned_score(FEATURES, reward.activation)(
        reward_params(reward), scene, candidates
    )
    theirs = hand_score(None, scene, candidates)
    found = jax.jit(score)(params, scene, candidates)
    np.testing.assert_allclose(found, theirs + 0.3 * support * ours, rtol=1e-4)


def test_half_a_feature_out_of_the_data_halves_the_gain():
    rows = jnp.zeros((2, 18, 4)).at[1, :, :2].set(5.0)
    counts = jnp.ones((18, 4), bool)
    ranges = Ranges(low=-jnp.ones(2), high=jnp.ones(2))
    assert float(worst_share(ranges, rows, counts)) == 0.5
    assert np.isinf(worst_share(ranges, rows.at[0, 0, 0].set(jnp.nan), counts))


def test_a_table_may_have_an_anchored_row(tmp_path):
    path, other = (str(random_weights(tmp_path / f"{i}.msgpack", i)) for i in (1, 2))
    for incumbent, has_weights in (("hand-set", False), (other, True)):
        drivers = table_rows([path], ["IDM"], anchor=(incumbent, 0.3))
        assert [row.name for row in drivers][1] == f"{drivers[0].name} anchored"
        assert (drivers[1].params.incumbent is not None) == has_weights


def test_the_anchored_teacher_drives_by_both(tmp_path):
    file = random_weights(tmp_path / "w.msgpack")
    rehearsal = Rehearsal(teacher="anchored", anchor_gain=0.5)
    teacher = teacher_of(rehearsal, "hand-set", file)
    assert teacher is not None
    policy, params = teacher
    row = anchored_row("teacher", open_reward(str(file)), "hand-set", 0.5)
    assert policy is row.policy
    assert float(params.gain) == 0.5
