"""Values and gradients stay finite where divisions, norms and masks degenerate."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rcirl_jax.features import feature_map
from rcirl_jax.features.columns import relate, slots
from rcirl_jax.planner.rank import hand_score, learned_score
from rcirl_jax.reward import RewardConfig, effective_params, init_params
from rcirl_jax.sampling import SamplerConfig, trajectory_on_path
from rcirl_jax.sampling.sampler import as_candidates
from rcirl_jax.train import featurise as making
from rcirl_jax.train.featurise import featurise, host_batch
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.train.step import gradient_sums, init_state
from rcirl_jax.types import Kind
from rcirl_jax.units import NUM_OBSTACLES, NUM_TIMES, TIMES_S
from tests.features.oracle import motion
from tests.helpers.scenes import (
    batch,
    demonstration,
    random_positions,
    random_scene,
    scene,
)
from tests.train.test_step import SMALL, normaliser

LEAD = {"s": 30.0, "speed": 5.0}
LINE = {"length": 0.0, "width": 40.0, "kind": Kind.STOP}
# the ego's box is 4.9 m by 2 m at s = 0
SCENES = {
    "standstill": scene(v=0.0, boxes=[LEAD]),
    "standstill behind a line": scene(v=0.0, boxes=[{"s": 2.45, **LINE}]),
    "straight": scene(boxes=[LEAD]),
    "no obstacle": scene(),
    "one obstacle": scene(kappa=0.01, boxes=[LEAD]),
    "bumpers touch": scene(v=0.0, boxes=[{"s": 4.7, "length": 4.5}]),
    "sides touch": scene(v=0.0, boxes=[{"s": 0.0, "l": 1.9}]),
    "corners touch": scene(v=0.0, boxes=[{"s": 4.7, "length": 4.5, "l": 1.9}]),
    "inside another": scene(v=0.0, boxes=[{"s": 0.0, "length": 4.9, "width": 2.0}]),
    "two alike": scene(boxes=[LEAD, LEAD]),
    "every slot": scene(boxes=[{"s": 9.0 * i} for i in range(1, NUM_OBSTACLES + 1)]),
    "one valid time": scene(boxes=[LEAD], num_valid=1),
    "curvature at its limit": scene(kappa=0.19, l=5.0, boxes=[LEAD]),
}
REWARD = RewardConfig()


@functools.cache
def weights():
    count = feature_map("paper21").num_features
    with jax.ensure_compile_time_eval():  # asked for inside of traced functions
        params = init_params(jax.random.key(1), count, REWARD)
        return effective_params(params, REWARD), normaliser()


LEARNED = learned_score(feature_map("paper21"), "tanh")


@jax.jit
def slope(made, s):
    """V of stations [T] and its gradient."""

    def value(s):
        return LEARNED(weights(), made, as_candidates(trajectory_on_path(made, s)))[0]

    return jax.value_and_grad(value)(s)


@jax.jit
def columns(made, s):
    """Features [T, F] of the other preset, and the slope of their sum."""
    of = lambda s: feature_map("apollo21")(made, trajectory_on_path(made, s))  # noqa: E731
    found, pull = jax.vjp(of, s)
    return found, pull(jnp.ones_like(found))


@jax.jit
def hand_value(made, s):
    return hand_score(None, made, as_candidates(trajectory_on_path(made, s)))


def drives(made):
    """Stations [T]: at rest, at the ego's speed, braking to rest."""
    v, t = float(made.ego.v), TIMES_S
    brakes = np.minimum(t, v / 3.0)
    way = v * brakes - 1.5 * brakes**2
    return [jnp.asarray(x, jnp.float32) for x in (0.0 * t, v * t, way)]


def finite(tree):
    return all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(tree))


@pytest.mark.parametrize("name", SCENES)
def test_values_and_slopes_by_position_are_finite(name):
    made = SCENES[name]
    for s in drives(made):
        assert finite(slope(made, s))
        assert finite(columns(made, s))
        assert finite(hand_value(made, s))


@given(seed=st.integers(0, 10_000), moves=st.booleans(), num=st.integers(1, NUM_TIMES))
def test_random_scenes_have_finite_slopes(seed, moves, num):
    made = random_scene(seed).replace(time_valid=jnp.arange(NUM_TIMES) < num)
    s = random_positions(seed, made)[0] * moves
    assert finite(slope(made, s))


# ------------------------------------------------------------------- the losses


def demonstrations():
    """The scenes, each with a human who keeps the ego's speed."""
    like = jax.tree.map(jnp.asarray, demonstration(0))
    rows = [
        like.replace(scene=made, human=trajectory_on_path(made, drives(made)[1]))
        for made in SCENES.values()
    ]
    return jax.tree.map(np.asarray, batch(rows))


def featurised(alike=False, **changes):
    """Features of all scenes; `alike`: every candidate is the human."""
    config = TrainConfig(sampler=SMALL, **changes)
    count = len(SCENES)
    given = host_batch(demonstrations(), np.ones(count), np.arange(count))
    whole = making.candidates_of

    def copies(key, shown, config):
        made, human = whole(key, shown, config), making.human_of(shown, config.sampler)
        same = lambda x, y: jnp.broadcast_to(y, x.shape)  # noqa: E731
        return made.replace(trajectory=jax.tree.map(same, made.trajectory, human))

    with pytest.MonkeyPatch.context() as patch:
        if alike:
            patch.setattr(making, "candidates_of", copies)
        make = jax.jit(lambda key, rows: featurise(key, rows, config,
                                                   feature_map("paper21")))  # fmt: skip
        return make(jax.random.key(0), given)


@functools.cache
def batches():
    """Features of all scenes as they are, with equal and with infeasible candidates."""
    plain = featurised(loss="listwise")
    none = plain.replace(feasible=jnp.zeros_like(plain.feasible))
    return {
        "as they are": plain,
        "identical candidates": featurised(alike=True, loss="listwise"),
        "all infeasible": none,
    }


take_sums = jax.jit(gradient_sums, static_argnums=(0, 4))


@pytest.mark.parametrize("loss", ["rank", "listwise", "gan"])
def test_slopes_by_parameters_are_finite(loss):
    config = TrainConfig(sampler=SMALL, loss=loss)
    state = init_state(config, normaliser())
    for name, made in batches().items():
        grads, sums = take_sums(
            state.apply_fn, state.params, normaliser(), made, config
        )
        assert finite((grads, sums)), name
        most = max(np.abs(x).max() for x in jax.tree.leaves(grads))
        assert (float(sums.terms) == 0.0) == (name == "all infeasible")
        if name == "all infeasible":
            assert most == 0.0
        if name == "identical candidates" and loss == "rank":
            # nobody wins a comparison with itself, and there is no slope
            assert float(sums.wins) == pytest.approx(0.5 * float(sums.pairs), rel=1e-2)
            assert most < 1e-2


# -------------------------------------------------------- the operator's oracle


@given(
    seed=st.integers(0, 10_000),
    num=st.integers(3, NUM_TIMES),
    mode=st.sampled_from(["speed", "path_speed"]),
)
def test_kinematics_equal_float64(seed, num, mode):
    made = random_scene(seed).replace(time_valid=jnp.arange(NUM_TIMES) < num)
    s, l = random_positions(seed, made)
    found = KINEMATICS[mode](made, s, l)
    wanted = motion(made, np.asarray(s, np.float64), np.asarray(l, np.float64), mode)
    tolerance = {"s": 1e-3, "v": 2e-3, "a": 1e-2, "j": 5e-2, "l": 1e-3, "dl": 1e-3}
    for name, expected in wanted.items():
        got = np.asarray(getattr(found, name), np.float64)[:num]
        atol = tolerance.get(name, 2e-3)
        np.testing.assert_allclose(got, expected[:num], atol=atol, err_msg=name)


def driven(mode):
    """The operator of a sampler's mode, on stations and offsets of any scene."""
    like = jax.tree.map(jnp.asarray, demonstration(0))

    def run(made, s, l):
        human = like.human.replace(s=s, l=l)
        shown = like.replace(scene=made, human=human)
        return making.human_of(shown, SamplerConfig(mode=mode))

    return jax.jit(run)


KINEMATICS = {mode: driven(mode) for mode in ("speed", "path_speed")}


ZERO = jnp.zeros(())


@pytest.mark.parametrize(("s", "l"), [(np.nan, 0.0), (0.0, np.nan)])
def test_the_distance_to_bodies_from_nowhere_is_no_number(s, l):
    """A comparison with NaN is false; it must not pass for free road."""
    made = random_scene(3)
    everyone = jax.tree.map(lambda x: x[0], slots(made.ego, made.obstacles))
    assert np.isnan(relate(everyone, jnp.float32(s), jnp.float32(l), ZERO, ZERO).body)
    assert np.isfinite(relate(everyone, ZERO, ZERO, ZERO, ZERO).body)


@pytest.mark.parametrize(
    ("leaf", "which"), [("s_lower", 0), ("l_upper", 1), ("speed", 2)]
)
def test_a_number_that_a_car_lacks_is_not_forgotten(leaf, which):
    """The others do not hide it, whether it is nearer than they are or not."""
    made = scene(boxes=[{"s": 30.0, "speed": 5.0}, {"s": 20.0}, {"s": 40.0}])
    odd = getattr(made.obstacles, leaf).at[which].set(jnp.nan)
    everyone = slots(made.ego, made.obstacles.replace(**{leaf: odd}))
    at_start = jax.tree.map(lambda x: x[0], everyone)
    assert np.isnan(relate(at_start, ZERO, ZERO, ZERO, ZERO).body)
