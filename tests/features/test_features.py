"""Conformance of F: every feature of every preset."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rcirl_jax.features import feature_map
from rcirl_jax.features.columns import COLUMNS
from rcirl_jax.runtime.specs import spec_root
from rcirl_jax.sampling import (
    SamplerConfig,
    sample,
    trajectory_from_positions,
    trajectory_on_path,
)
from rcirl_jax.types import Kind
from rcirl_jax.units import TIMES_S
from tests.features.oracle import point
from tests.helpers.scenes import random_positions, random_scene, scene, unfused

PRESETS = sorted(path.stem for path in (spec_root() / "features").glob("*.toml"))
UNIT = re.compile(r"1|(1|m|s|rad)(/(m|s))?(\^\d)?")
# what a trajectory is without anybody else
OWN_MOTION = (
    *("l", "dl", "ddl", "curvature", "station", "time", "velocity", "speed_limit"),
    *("acceleration", "jerk", "lateral_acceleration"),
)
JITTED = {preset: jax.jit(feature_map(preset)) for preset in PRESETS}
FROM_POSITIONS = jax.jit(trajectory_from_positions)


def drive(seed):
    made = random_scene(seed)
    return made, FROM_POSITIONS(made, *random_positions(seed, made))


@pytest.mark.parametrize("preset", PRESETS)
def test_declared(preset):
    features = feature_map(preset)
    assert features.num_features == int(re.search(r"\d+$", preset)[0])
    for spec in features.specs:
        assert UNIT.fullmatch(spec.unit)
        assert spec.meaning
        assert spec.lower <= spec.none <= spec.upper


def test_every_column_is_used_by_a_preset():
    used = {name for preset in PRESETS for name in feature_map(preset).names}
    assert used == set(COLUMNS)


@pytest.mark.parametrize("preset", PRESETS)
@given(seed=st.integers(0, 10_000))
def test_equals_the_oracle(preset, seed):
    features = feature_map(preset)
    made, trajectory = jax.tree.map(np.asarray, drive(seed))
    found = np.asarray(JITTED[preset](made, trajectory))
    assert np.isfinite(found).all()
    for i in range(TIMES_S.size):
        expected = point(made, trajectory, i)
        for column, name in enumerate(features.names):
            assert found[i, column] == pytest.approx(
                expected[name], rel=2e-4, abs=2e-3
            ), (name, i)


@pytest.mark.parametrize("preset", PRESETS)
def test_none_values_without_obstacles(preset):
    features = feature_map(preset)
    empty = scene()
    s = empty.ego.v * jnp.asarray(TIMES_S)
    straight = FROM_POSITIONS(empty, s, jnp.zeros_like(s))
    found = np.asarray(JITTED[preset](empty, straight))
    for column, spec in enumerate(features.specs):
        if spec.name not in OWN_MOTION:
            assert (found[:, column] == spec.none).all(), spec.name


@pytest.mark.parametrize(
    "mode", ["speed", pytest.param("path_speed", marks=pytest.mark.slow)]
)
def test_human_equal_to_a_candidate_has_the_same_bits(mode):
    """The human enters as positions, like a candidate, and nothing differs."""
    maps, config = [feature_map(preset) for preset in PRESETS], SamplerConfig(mode=mode)
    made = random_scene(3)
    candidates = unfused(functools.partial(sample, config=config))(
        jax.random.key(0), made
    )
    of_all = unfused(lambda *given: [m.of_candidates(*given) for m in maps])
    all_features = of_all(made, candidates)

    def of_human(made, s, l):
        if mode == "speed":
            human = trajectory_on_path(made, s)
        else:
            human = trajectory_from_positions(made, s, l)
        return [features(made, human) for features in maps]

    picks = jnp.arange(0, candidates.family.size, 7)
    human = unfused(jax.vmap(of_human, (None, 0, 0)))(
        made, candidates.trajectory.s[picks], candidates.trajectory.l[picks]
    )
    for preset, found, wanted in zip(PRESETS, all_features, human, strict=True):
        np.testing.assert_array_equal(found[picks], wanted, preset)


def test_classes_by_hand():
    """Ego at s = 0, 4.9 m long, standing; one obstacle of each class."""
    features = feature_map("paper21")
    still = jnp.zeros(TIMES_S.size)

    def at(name, **box):
        made = scene(v=0.0, boxes=[box])
        found = JITTED["paper21"](made, FROM_POSITIONS(made, still, still))
        return float(found[0, features.names.index(name)])

    assert at("follow_distance", s=20.0, length=4.0) == pytest.approx(15.55)
    assert at("overtake_distance", s=-20.0, length=4.0) == pytest.approx(15.55)
    assert at("nudge_lateral", s=0.0, l=3.0, width=2.0) == pytest.approx(1.0)
    assert at("collision_distance", s=4.0, length=4.0) == pytest.approx(-0.45)
    assert at("collision_distance", s=20.0, l=9.0) > 10.0
    line = {"length": 0.0, "width": 40.0}
    assert at("stop_distance", s=12.45, kind=Kind.STOP, **line) == pytest.approx(10.0)
    virtual = at("virtual_distance", s=12.45, kind=Kind.VIRTUAL, **line)
    assert virtual == pytest.approx(10.0)
