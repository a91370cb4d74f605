"""The training step: parallel equality, learning, guard, recompilation."""

import dataclasses
import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.features import feature_map
from rcirl_jax.reward import Normaliser
from rcirl_jax.sampling import SamplerConfig, num_candidates
from rcirl_jax.train import step as steps
from rcirl_jax.train.featurise import (
    OVER_LIMIT_MPS,
    _featurised,
    densities,
    featurise,
    featurised,
    host_batch,
    info_of,
    not_finite,
)
from rcirl_jax.train.parallel import parallelise
from rcirl_jax.train.state import TrainConfig, make_optimizer
from rcirl_jax.train.step import (
    init_state,
    make_train_step,
    unusable_scenes,
)
from tests.helpers.scenes import unfused
from tests.helpers.stored import rows_of

SMALL = SamplerConfig(num_random=4, cruise_times=(4.0,), edge_times=(4.0,))
CONFIG = TrainConfig(batch_size=16, sampler=SMALL)


@functools.cache
def rows():
    return rows_of(range(16))


def normaliser():
    features = feature_map("paper21")
    lower = jnp.array([s.lower for s in features.specs], jnp.float32)
    upper = jnp.array([s.upper for s in features.specs], jnp.float32)
    return Normaliser(
        lower=lower, upper=upper, location=0.5 * (lower + upper), scale=upper - lower
    )


def batch(weight=None):
    weight = np.ones(16) if weight is None else weight
    return jax.device_put(host_batch(rows(), weight, np.arange(16)))


@functools.cache
def cached():
    state = init_state(CONFIG, normaliser())
    return featurised(state.key, batch(), CONFIG)


def weights_of(state):
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(state.params)])


@pytest.mark.parametrize("how", ["pmap", "shard_map"])
def test_eight_devices_equal_one(how):
    """With uneven shards: weights that leave some devices nearly empty."""
    weight = np.ones(16)
    weight[[1, 2, 3, 4, 5, 9, 10, 11, 15]] = 0.0
    # plain gradient steps: Adam would hide a wrong scale of the gradient
    config = dataclasses.replace(CONFIG, optimizer="sgd", learning_rate=0.3)
    step = make_train_step(config)
    one, many = (parallelise(step, x, 16) for x in ("jit", how))
    a = b = init_state(config, normaliser())
    b = many.replicate(b)
    given = host_batch(rows(), weight, np.arange(16))
    for _ in range(3):
        a, metrics_a = one.step(a, one.place(given))
        b, metrics_b = many.step(b, many.place(given))
        np.testing.assert_allclose(weights_of(a), weights_of(b), rtol=2e-4, atol=2e-5)
        assert float(metrics_a.pairs) == float(metrics_b.pairs)
        assert float(metrics_a.grad_norm) == pytest.approx(
            float(metrics_b.grad_norm), rel=1e-3
        )
        assert float(metrics_a.loss_sum) == pytest.approx(
            float(metrics_b.loss_sum), rel=1e-3, abs=1e-3
        )


def test_runs_that_differ_in_other_settings_share_the_program_of_features():
    made = featurised(init_state(CONFIG, normaliser()).key, batch(), CONFIG)
    size = _featurised._cache_size()
    other = dataclasses.replace(CONFIG, seed=7, learning_rate=0.1, loss="logistic")
    same = featurised(init_state(CONFIG, normaliser()).key, batch(), other)
    assert _featurised._cache_size() == size
    np.testing.assert_array_equal(same.candidates, made.candidates)


def assert_same_step(one, other):
    np.testing.assert_allclose(
        weights_of(one[0]), weights_of(other[0]), rtol=1e-4, atol=1e-5
    )
    a, b = one[1], other[1]
    np.testing.assert_allclose(a.loss_sum, b.loss_sum, rtol=1e-5)
    assert (a.wins, a.pairs, a.terms) == (b.wins, b.pairs, b.terms)


def test_scene_by_scene_and_block_by_block_is_the_step_of_the_whole(monkeypatch):
    """Of features, and of features made for a few scenes at a time."""
    state, scenes, made = init_state(CONFIG, normaliser()), batch(), cached()
    scanned, sizes = steps.scan_sum, set()
    with monkeypatch.context() as patch:
        patch.setattr(steps, "scan_sum", lambda work, batch, size: work(batch))
        whole = jax.jit(make_train_step(CONFIG))
        of_scenes, of_features = whole(state, scenes), whole(state, made)

    def noted(work, batch, size):
        sizes.add((batch.weight.shape[0], size))
        return scanned(work, batch, size)

    monkeypatch.setattr(steps, "scan_sum", noted)
    most = num_candidates(CONFIG.sampler)
    monkeypatch.setattr(steps, "TRAJECTORIES", 2 * most)
    step = jax.jit(make_train_step(CONFIG))
    assert_same_step(step(state, made), of_features)
    assert_same_step(step(state, scenes), of_scenes)
    assert sizes == {(16, 1), (16, 2), (2, 1)}
    key = jax.random.fold_in(state.key, state.step)
    assert_same_step(step(state, featurised(key, scenes, CONFIG)), of_scenes)
    broken = scenes.demonstrations.human.s.at[3, 2].set(jnp.nan)
    human = scenes.demonstrations.human.replace(s=broken)
    made = scenes.demonstrations.replace(human=human)
    assert not step(state, scenes.replace(demonstrations=made))[1].finite


@pytest.mark.parametrize(
    ("value", "weight", "found"),
    [(-np.inf, 1.0, True), (np.nan, 1.0, True), (3e38, 1.0, False),
     (np.nan, 0.0, False)],
)  # fmt: skip
def test_bad_values_are_those_that_are_not_finite(value, weight, found):
    made = cached()
    candidates = made.candidates.at[4, 2, 7, 1].set(value)
    made = made.replace(candidates=candidates, weight=made.weight.at[4].set(weight))
    assert int(unusable_scenes(made)) == found
    bad = not_finite(made, CONFIG.features)
    assert sum(x.sum() for x in bad.values()) == (not np.isfinite(value))


@pytest.mark.parametrize(
    ("loss", "field", "value"),
    [("listwise", "density", np.nan), ("soft", "distance", np.inf)],
)  # fmt: skip
def test_what_only_the_loss_reads_is_no_finite_step(loss, field, value):
    """Such a loss may well be finite, and the reward learned from it wrong."""
    config = dataclasses.replace(CONFIG, loss=loss)
    made = cached()
    info = made.info.replace(**{field: getattr(made.info, field).at[3, 0].set(value)})
    made = made.replace(info=info, feasible=made.feasible.at[3, 0].set(True))
    state, step = init_state(config, normaliser()), jax.jit(make_train_step(config))
    assert not step(state, made)[1].finite
    (bad,) = (x for x in not_finite(made, config.features).values() if x.any())
    assert np.flatnonzero(bad).tolist() == [3]
    others = made.replace(feasible=made.feasible.at[3, 0].set(False))
    assert step(state, others)[1].finite


def test_either_future_is_learned_from():
    """With "both" a scene is seen as predicted or as recorded, another time anew."""

    def made(futures, key=0):
        config = dataclasses.replace(CONFIG, futures=futures)
        return np.asarray(featurised(jax.random.key(key), batch(), config).candidates)

    same = lambda x, y: np.isclose(x, y, atol=1e-4).all(axis=(1, 2, 3))  # noqa: E731
    as_predicted = same(made("both"), made("predicted"))
    as_recorded = same(made("both"), made("recorded"))
    assert (as_predicted | as_recorded).all()
    assert 0 < np.sum(as_predicted & ~as_recorded) < 16
    again = same(made("both", key=1), made("predicted", key=1))
    assert (again != as_predicted).any()


def test_candidates_of_a_scene_do_not_depend_on_the_batch():
    state = init_state(CONFIG, normaliser())
    some = jax.tree.map(lambda x: x[4:8], batch())
    alone = featurised(state.key, some, CONFIG)
    np.testing.assert_allclose(
        alone.candidates, cached().candidates[4:8], rtol=1e-5, atol=1e-4
    )
    # to the bit: operations that are not fused round alike in every batch
    made = unfused(lambda *x: featurise(*x, CONFIG, feature_map(CONFIG.features)))
    alone, among = made(state.key, some), made(state.key, batch())
    np.testing.assert_array_equal(alone.candidates, among.candidates[4:8])


def human_is_better():
    """Features in which the human differs from all candidates by a direction."""
    rng = np.random.default_rng(0)
    base = cached()
    lower, upper = np.asarray(normaliser().lower), np.asarray(normaliser().upper)
    middle, width = 0.5 * (lower + upper), upper - lower
    direction = 0.1 * width * np.sign(rng.normal(size=21))

    def around(shape, shift):
        noise = 0.05 * width * rng.normal(size=shape)
        return jnp.asarray(middle + shift + noise, jnp.float32)

    return base.replace(
        human=around(base.human.shape, direction),
        candidates=around(base.points.shape, -direction).transpose(0, 3, 2, 1),
        feasible=jnp.ones_like(base.feasible),
        time_valid=jnp.ones_like(base.time_valid),
    )


def test_a_step_that_is_not_finite_leaves_all_but_its_number():
    """Also where clipping hides an infinite feature from the loss."""
    made, config = cached(), dataclasses.replace(CONFIG, halve_every=5)
    state, step = init_state(config, normaliser()), jax.jit(make_train_step(config))
    state, _ = step(state, made)
    for value in (jnp.nan, jnp.inf):
        broken = made.candidates.at[3, 9, 2, 0].set(value)
        after, metrics = step(state, made.replace(candidates=broken))
        assert not metrics.finite
        assert int(after.step) == 2
        np.testing.assert_array_equal(weights_of(after), weights_of(state))
        before, kept = state.opt_state.inner_state, after.opt_state.inner_state
        for a, b in zip(*map(jax.tree.leaves, (before, kept)), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: parallelise(make_train_step(CONFIG), "pmap", 12),
         "batch_size: 12: expected a multiple of 8"),
        (lambda: parallelise(make_train_step(CONFIG), "ring", 16),
         "parallel: ring: expected one of"),
        *(
            (lambda setting=setting: TrainConfig(**setting), message)
            for setting, message in (
                ({"loss": "hope"}, "loss: hope: expected one of"),
                ({"leaky_rate": 2.0}, "leaky_rate: 2.0: expected between 0 and 1"),
                ({"optimizer": "radom"}, "radom: .*; did you mean radam?"),
                ({"seed": 2**31}, "seed: .*: expected 0 to 2147483647"),
                ({"loss": "listwise", "hard_negatives": 4, "hard_pool": 3},
                 "hard_pool: 3: expected 1 with"),
                ({"residual_on": "hand-set"}, "positive: human: expected nearest"),
                ({"slowed": (1.5,)}, r"slowed: \[1.5\]: expected shares"),
            )
        ),
    ],
)  # fmt: skip
def test_bad_settings_are_one_line(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_a_hard_negative_is_never_the_positive_nor_better_than_it():
    """Some are nearer to the human than any sampled candidate."""
    config = dataclasses.replace(CONFIG, positive="nearest", hard_negatives=12)
    key = init_state(config, normaliser()).key
    made = featurised(key, batch(), config)
    plain = featurised(key, batch(), dataclasses.replace(config, hard_negatives=0))
    np.testing.assert_allclose(made.human, plain.human, rtol=1e-4, atol=1e-4)
    sampled = plain.feasible.shape[1]
    assert made.feasible.shape[1] == sampled + 12
    np.testing.assert_array_equal(made.feasible[:, :sampled], plain.feasible)
    own, near = np.asarray(made.info.distance), np.asarray(made.info.human_distance)
    hard = own[:, sampled:]
    # else the test shows nothing: some are nearer than the positive, and do not count
    assert (hard < near[:, None]).any()
    assert not np.asarray(made.feasible)[:, sampled:][hard <= near[:, None]].any()
    assert made.feasible[:, sampled:].any()


def test_densities_are_of_the_candidates_that_count():
    """Hard negatives nearer than the positive are no samples of the proposal."""
    config = dataclasses.replace(
        CONFIG, loss="listwise", positive="nearest", hard_negatives=12
    )
    key = init_state(config, normaliser()).key
    made = featurised(key, batch(), config)
    plain = featurised(key, batch(), dataclasses.replace(config, positive="human"))
    left_out = np.asarray(plain.feasible & ~made.feasible)  # the positive among them
    most = np.log(1.0 + np.asarray(made.feasible).sum(axis=1) + 1.0)
    for b in range(made.human.shape[0]):
        assert (np.asarray(made.info.density)[b] <= most[b] + 1e-5).all()
        fell = np.asarray(made.info.density - plain.info.density)[b]
        assert (fell <= 1e-5).all()
        if left_out[b].sum() > 1:
            assert fell.min() < -1e-4
    assert (left_out.sum(axis=1) > 1).any()


def test_decay_pulls_kernels_and_biases_only():
    config = dataclasses.replace(
        CONFIG, loss="gan", weight_decay=0.1, learning_rate=0.5
    )
    params = jax.tree.map(lambda x: x + 1.0, init_state(config, normaliser()).params)
    optimizer = make_optimizer(config)
    still = jax.tree.map(jnp.zeros_like, params)
    moved, _ = optimizer.update(still, optimizer.init(params), params)
    assert all((np.asarray(x) != 0.0).all() for x in jax.tree.leaves(moved["point"]))
    assert (np.asarray(moved["gamma"]) == 0.0).all()
    assert moved["offset"] == 0.0


def test_the_gradient_is_cut_down_to_its_norm():
    config = TrainConfig(optimizer="sgd", learning_rate=0.5, clip_norm=0.5)
    for size, want in ((10.0, 0.25), (0.1, 0.05)):
        slope = {"a": jnp.array([0.6 * size]), "b": jnp.array([0.8 * size])}
        rule = make_optimizer(config)
        updates, _ = rule.update(slope, rule.init(slope), slope)
        assert float(optax.tree.norm(updates)) == pytest.approx(want, rel=1e-5)


def test_densities_are_those_of_a_gaussian_kernel_pair_by_pair():
    """exp(-d^2 / 8) of RMS distances over the valid times, summed by loops."""
    rng = np.random.default_rng(0)
    count, times = 7, 6
    s, l = rng.normal(0.0, 3.0, (2, count + 1, times)) + 200.0
    counts, valid = rng.random(count) > 0.3, np.arange(times) < 4

    def curve(at):
        return SimpleNamespace(
            s=jnp.asarray(s[at], jnp.float32), l=jnp.asarray(l[at], jnp.float32)
        )

    human, own = densities(
        curve(-1), curve(slice(0, -1)), jnp.asarray(counts), jnp.asarray(valid)
    )

    def kernel(i, j):
        gap = (s[i] - s[j]) ** 2 + (l[i] - l[j]) ** 2
        return np.exp(-gap[valid].mean() / (2.0 * 2.0**2))

    def density(i):
        return np.log(1.0 + sum(kernel(i, j) for j in np.nonzero(counts)[0] if j != i))

    np.testing.assert_allclose(own, [density(i) for i in range(count)], atol=2e-5)
    np.testing.assert_allclose(human, density(count), atol=2e-5)


def test_nearest_positive_is_a_feasible_candidate_and_not_its_own_rival():
    config = dataclasses.replace(CONFIG, positive="nearest")
    features = feature_map("paper21")
    key = init_state(config, normaliser()).key
    made = featurised(key, batch(), config)
    plain = featurised(key, batch(), CONFIG)
    for b in range(made.human.shape[0]):
        same = np.all(np.asarray(made.points[b]) == made.human[b], axis=(1, 2))
        before, after = np.asarray(plain.feasible[b]), np.asarray(made.feasible[b])
        ((changed,),) = np.nonzero(before != after)
        assert same[changed]
        # no feasible rival ends nearer to the human over the valid times
        scene_s = np.asarray(made.points[b, :, :, features.names.index("station")])
        human_s = np.asarray(plain.human[b, :, features.names.index("station")])
        valid = np.asarray(made.time_valid[b])
        apart = np.abs(scene_s - human_s)[:, valid].mean(axis=1)
        assert apart[changed] <= apart[after].min() + 0.05


T, LIMIT = 18, 10.0


def info_at(speeds, overrun, valid=None):
    """Information on candidates [K] that drive at `speeds` [T, K] past a line."""
    shape = speeds.shape
    still = SimpleNamespace(s=jnp.zeros(shape[::-1]), l=jnp.zeros(shape[::-1]))
    frames = SimpleNamespace(
        point=SimpleNamespace(v=jnp.asarray(speeds)),
        path=SimpleNamespace(speed_limit=jnp.full(shape, LIMIT)),
        relations=SimpleNamespace(
            line_overrun=jnp.asarray(overrun), body=jnp.ones(shape)
        ),
    )
    human = SimpleNamespace(s=jnp.zeros(T), l=jnp.zeros(T))
    seen = jnp.ones(T, bool) if valid is None else jnp.asarray(valid)
    return info_of(human, SimpleNamespace(trajectory=still), frames, seen)


def test_a_line_is_run_at_one_time_and_counts_in_full():
    """And what comes after the recorded times breaks no rule."""
    speeds, overrun = np.full((T, 3), LIMIT), np.zeros((T, 3))
    speeds[:6, 1] += 2.0 * OVER_LIMIT_MPS
    overrun[11, 2] = 0.4
    broken = info_at(speeds, overrun).breaks_rule
    np.testing.assert_allclose(broken, [0.0, 6 / T, 1.0], rtol=1e-6)
    broken = info_at(speeds, overrun, np.arange(T) < 11).breaks_rule
    np.testing.assert_allclose(broken, [0.0, 6 / 11, 0.0], rtol=1e-6)
