"""Own candidates: what is made of them; bad ones are one line."""

from pathlib import Path

import jax
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.export.loading import open_reward, own_sampler_of
from rcirl_jax.planner.rank import ONLINE
from rcirl_jax.sampling import SamplerConfig, num_candidates, sample
from rcirl_jax.sampling.own_sampler import check_own_sampler
from rcirl_jax.sampling.sampler import FAMILIES
from rcirl_jax.simulation.rollout import first_scenes
from rcirl_jax.simulation.suite import build, suite_refs
from tests.helpers.scenes import sampled
from tests.helpers.weights_files import random_weights

FILE = Path(__file__).parent / "samplers" / "samplers.py"


def of(name, base=ONLINE):
    return SamplerConfig(own=f"{FILE}:{name}").on_own(base)


@pytest.fixture(scope="module")
def scenes():
    return first_scenes(build(suite_refs("smoke"), 1.0))


@pytest.fixture(scope="module")
def scene(scenes):
    return jax.tree.map(lambda x: x[0], scenes)


def checked(config, scenes):
    keys = jax.random.split(jax.random.key(0), scenes.ego.v.size)
    made = jax.jit(jax.vmap(lambda *x: sample(*x, config)))(keys, scenes)
    check_own_sampler(config.own, config.mode == "speed", scenes, keys, made)


def test_what_the_filter_needs_is_added_and_derivatives_are_ours(scene):
    config = of("steady")
    made = sampled(jax.random.key(0), scene, config)
    names = [FAMILIES[i] for i in np.asarray(made.family)]
    assert names == ["constant_speed", *["given"] * 9, *["emergency"] * 3]
    assert num_candidates(config) == 13
    np.testing.assert_allclose(made.trajectory.v[0], scene.ego.v, rtol=1e-4)
    gentle = 1 + 5  # constant acceleration 0.1875 m/s^2
    np.testing.assert_allclose(made.trajectory.a[gentle, 2:-2], 0.1875, atol=2e-3)
    on_path = np.asarray(made.trajectory.l)
    both = sampled(
        jax.random.key(0), scene, of("aside", SamplerConfig(mode="path_speed"))
    )
    np.testing.assert_allclose(
        both.trajectory.l[1:10, -1], scene.ego.l + 0.8, rtol=1e-4
    )
    assert np.ptp(on_path[:, 0]) < 1e-6


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("numpy_one", r"numpy_one: TracerArrayConversionError: .*, in JAX alone"),
        ("short", r"short: \(9, 17\): expected s, l \[K, 18\] m of \(scene, key\), K"),
        ("not_finite", r"scene 0, candidate 2, time 5: nan: expected a finite s"),
        ("alike", r"scenes all candidates end within 0.5 m: expected different ones"),
        ("always_fast", r"of 23 scenes no candidate keeps the vehicle's limits"),
        ("aside", r"expected the given path's l: only speed along it is planned"),
    ],
)
def test_bad_ones_are_one_line(name, message, scenes):
    with pytest.raises(InputError, match=message) as caught:
        checked(of(name), scenes)
    assert "\n" not in str(caught.value)


def test_a_weights_file_finds_its_own_candidates_or_says_that_they_changed(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(FILE.read_text())
    config = SamplerConfig(own=f"{file}:steady")
    named = {"place": config.own, "sha256": config.own_sha256}
    reward = open_reward(str(random_weights(tmp_path / "w.msgpack", 2)))
    reward.provenance["own_sampler"] = named
    assert own_sampler_of([reward], ONLINE) == config.on_own(ONLINE)
    file.write_text(FILE.read_text() + "\n")
    with pytest.raises(
        InputError, match=r"it is no longer the one that the reward was"
    ):
        own_sampler_of([reward], ONLINE)
