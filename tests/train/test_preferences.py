"""Preferences: read strictly, compared with the same loss, all of them in turn."""

import dataclasses
import json

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.data.store.preferences import SCHEMA, read_preferences
from rcirl_jax.errors import InputError
from rcirl_jax.train.loop import host_batch, train
from rcirl_jax.train.parallel import pmapped, sharded, single
from rcirl_jax.train.preferences import featurise_preferences, pairs_of_step
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.train.step import gradient_sums, init_state, make_train_step
from rcirl_jax.units import NUM_TIMES, TIMES_S
from tests.train.test_step import CONFIG, batch, cached, normaliser, rows, weights_of

HASH = "d" * 64


class Scenes:
    """The scenes of the step's tests as a dataset; the last four are held out."""

    hash = HASH

    def indices(self, split):
        return {"train": np.arange(12), None: np.arange(16)}[split]

    def weights(self, indices):
        return np.ones(len(indices), np.float32)

    def blocks(self, indices):
        return np.zeros(indices.size, np.int64)

    def read(self, indices):
        return jax.tree.map(lambda x: x[np.asarray(indices)], rows())

    def load(self, split):
        return self.read(self.indices(split))


def line(scene=3, better="human", worse=None, **more):
    worse = {"s": (4.0 * TIMES_S).tolist()} if worse is None else worse
    return {"scene": scene, "better": better, "worse": worse, **more}


def written(folder, *lines, **head):
    first = {"schema": SCHEMA, "schema_version": 1, "dataset_sha256": HASH, **head}
    path = folder / "preferences.jsonl"
    texts = [x if isinstance(x, str) else json.dumps(x) for x in (first, *lines)]
    path.write_text("\n".join(texts) + "\n")
    return path


def read(folder, *lines, **head):
    return read_preferences(written(folder, *lines, **head), Scenes())


@pytest.fixture
def judged(tmp_path):
    """In twelve scenes the slow trajectory is better than what the human did."""
    slow = {"s": np.minimum(2.0 * TIMES_S, 6.0).tolist()}
    lines = [line(i, better=slow, worse="human", weight=1.0 + i) for i in range(12)]
    return read(tmp_path, *lines)


def test_what_is_read_is_what_was_written(judged):
    human = np.asarray(rows().human.s)
    assert judged.row.tolist() == list(range(12))
    np.testing.assert_allclose(judged.s[:, 1], human[:12])
    np.testing.assert_allclose(
        judged.s[:, 0], np.tile(np.minimum(2.0 * TIMES_S, 6.0), (12, 1)), rtol=1e-6
    )
    assert judged.weight.tolist() == [1.0 + i for i in range(12)]


SHORT = {"s": [0.0] * (NUM_TIMES - 1)}


@pytest.mark.parametrize(
    ("lines", "head", "message"),
    [
        ((), {}, "1 lines: expected a head and preferences"),
        ((line(),), {"schema": "other"}, "line 1: schema: other: expected rcirl"),
        ((line(),), {"schema_version": 2}, "line 1: schema_version: 2: expected 1"),
        ((line(),), {"dataset_sha256": "x"}, "line 1: dataset_sha256: x: expected d"),
        (("{",), {}, "line 2: expected JSON"),
        (("[" * 100000,), {}, "line 2: expected JSON"),
        ((line(better="\ud800"),), {}, "line 2: expected JSON"),
        ((line(), "3"), {}, "line 3: expected an object"),
        ((line(scene="3"),), {}, "line 2: scene: 3: expected a row number"),
        ((line(scene=12),), {}, "scene: 12: expected a row of the train split"),
        ((line(scene=-1),), {}, "scene: -1: expected a row of the train split"),
        ((line(weight=0),), {}, "weight: 0: expected above 0"),
        ((line(weight=float("nan")),), {}, "weight: nan: expected above 0"),
        ((line(colour=1),), {}, "colour: expected scene, better, worse, weight"),
        ((line(worse="human"),), {}, "the same: expected two trajectories"),
        ((line(better="me"),), {}, 'better: expected "human", or an object'),
        ((line(worse=SHORT),), {}, "worse: s: expected 18 numbers"),
        ((line(worse={"s": ["a"] * 18}),), {}, "worse: s: a: expected a number"),
        ((line(worse={"s": [1e9] * 18}),), {}, "expected within 1000 m"),
        ((line(worse={"s": [9.0] * 18}),), {}, "expected to start at 0 and not fall"),
    ],
)
def test_a_bad_file_is_one_line(tmp_path, lines, head, message):
    with pytest.raises(InputError) as caught:
        read(tmp_path, *lines, **head)
    assert message in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_features_are_those_of_the_step(judged):
    """The human of a preference has the features it has as a demonstration."""
    made = featurise_preferences(judged, Scenes(), CONFIG)
    whole = cached()
    human = np.asarray(made.candidates)[:, :, :, 0].transpose(0, 2, 1)
    np.testing.assert_allclose(human, np.asarray(whole.human)[:12], atol=1e-5)
    assert np.array_equal(made.time_valid, np.asarray(whole.time_valid)[:12])


def test_all_are_compared_in_turn(judged):
    made = featurise_preferences(judged, Scenes(), CONFIG)
    seen = []
    for step in range(3):
        part = pairs_of_step(made, step, most=8, devices=1, process=0, processes=1)
        seen += part.index.tolist()
    assert sorted(seen) == sorted(2 * list(range(12)))
    whole = pairs_of_step(made, 5, most=6, devices=4, process=0, processes=1)
    assert whole.weight.size == 8
    assert np.count_nonzero(whole.weight) == 6
    halves = [pairs_of_step(made, 5, 6, 4, process=i, processes=2) for i in (0, 1)]
    joined = jax.tree.map(lambda *x: np.concatenate(x), *halves)
    chex.assert_trees_all_equal(joined, whole)


def step_with(judged, how, config):
    made = featurise_preferences(judged, Scenes(), config)
    part = pairs_of_step(made, 0, most=12, devices=8, process=0, processes=1)
    given = host_batch(rows(), np.ones(16), np.arange(16), part)
    state = init_state(config, normaliser())
    return how(make_train_step(config))(state, given), part, state


def test_their_mean_loss_is_added_with_its_weight(judged):
    config = dataclasses.replace(
        CONFIG, optimizer="sgd", learning_rate=0.3, preference_weight=0.7
    )
    (after, metrics), part, state = step_with(judged, single, config)
    plain, _ = single(make_train_step(config))(state, batch())
    part = jax.tree.map(jnp.asarray, part)
    gradients = jax.jit(gradient_sums, static_argnums=3)
    more, sums = gradients(state.params, state.normaliser, part, config)
    want = jax.tree.map(lambda p, g: p - 0.3 * 0.7 * g / sums.terms, plain.params, more)
    chex.assert_trees_all_close(after.params, want, atol=1e-6)
    assert float(metrics.preferred[1]) == pytest.approx(float(part.weight.sum()))


@pytest.mark.parametrize("how", [pmapped, sharded])
def test_eight_devices_equal_one_with_preferences(how, judged):
    config = dataclasses.replace(CONFIG, optimizer="sgd", learning_rate=0.3)
    (one, a), *_ = step_with(judged, single, config)
    (many, b), *_ = step_with(judged, lambda step: how(step, 8), config)
    np.testing.assert_allclose(weights_of(one), weights_of(many), atol=2e-6)
    np.testing.assert_allclose(a.preferred, b.preferred, rtol=1e-6)


def test_training_learns_what_people_prefer(judged, tmp_path):
    """The humans drive on; people say that slow is better, and win."""

    def won(name, weight):
        config = TrainConfig(
            batch_size=12,
            epochs=15,
            learning_rate=0.02,
            sampler=CONFIG.sampler,
            loss="logistic",
            preferences=judged.sha256,
            preference_weight=weight,
        )
        train(Scenes(), tmp_path / name, config, preferences=judged)
        lines = (tmp_path / name / "metrics.jsonl").read_text().splitlines()
        return json.loads(lines[-1])["preferences_won"]

    assert won("strong", 20.0) > 0.95
    assert won("weak", 1e-6) < 0.5
