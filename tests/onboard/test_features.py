"""F for other people's planners, numpy and C++, against F in JAX."""

import itertools

import numpy as np
import pytest

from rcirl_jax.data.formats import read_recordings
from rcirl_jax.data.scenes.collect import Collector, stack_scenes
from rcirl_jax.data.scenes.config import CollectConfig
from tests.helpers import drawn_scenes
from tests.helpers.own_planner import (
    TOLERANCE,
    as_numbers,
    drawn_reward,
    error,
    every_column,
    in_valid_times,
    jax_answers,
    numpy_answers,
    plain_cases,
)
from tests.onboard.programs import built, run

BATCH = 250  # scenes of a call
SITES = {  # below the recorded data
    "us101": ("commonroad", "ngsim_us101_commonroad/xml"),
    "urban": ("commonroad", "ngsim_urban_commonroad/xml"),
    "i80": ("ngsim", "ngsim_i80_native"),
}


@pytest.fixture(scope="module")
def reader():
    return built("reader") / "reader"


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """All columns, and a reward that reads them."""
    columns = every_column()
    path = tmp_path_factory.mktemp("weights") / "weights.msgpack"
    return columns, drawn_reward(path, columns)


def cpp_answers(reader, reward, folder, cases):
    """Features [K, T, F] and values [K] of each case (scene, s, l)."""
    file = folder / "cases"
    np.concatenate([as_numbers(*case) for case in cases]).tofile(file)
    rest = np.frombuffer(run(reader, "features", reward.file, file), np.float32)
    for _, s, _ in cases:
        shape = (*s.shape, len(reward.names))
        size = int(np.prod(shape))
        yield rest[:size].reshape(shape), rest[size : size + len(s)]
        rest = rest[size + len(s) :]
    assert rest.size == 0


def assert_equal(reader, given, folder, scenes, s, l):
    """Both implementations equal JAX on scenes [n] and candidates [n, K, T]."""
    columns, reward = given
    expected, values = jax_answers(columns, reward, scenes, s, l)
    expected = in_valid_times(scenes, expected)
    cases = plain_cases(scenes, s, l)
    for found in (
        [numpy_answers(reward, *case) for case in cases],
        list(cpp_answers(reader, reward, folder, cases)),
    ):
        features = in_valid_times(scenes, np.stack([x for x, _ in found]))
        worst = {
            name: error(features[..., f], expected[..., f])
            for f, name in enumerate(columns.names)
        }
        assert all(x <= TOLERANCE for x in worst.values()), worst
        assert error(np.stack([v for _, v in found]), values) <= TOLERANCE


SEEDS = range(10_000 // BATCH)
QUICK = 8  # of the seeds


@pytest.mark.parametrize(
    "seed",
    [*SEEDS[:QUICK], *(pytest.param(i, marks=pytest.mark.slow) for i in SEEDS[QUICK:])],
)
def test_ten_thousand_random_scenes_equal_jax(reader, given, tmp_path, seed):
    rng = np.random.default_rng(seed)
    scenes = drawn_scenes.scenes(rng, BATCH)
    s, l = drawn_scenes.candidates(rng, scenes, 2)
    assert_equal(reader, given, tmp_path, scenes, s, None if seed % 2 else l)


def recorded(form, path, count):
    """First scenes of a site as imported, with the drivers' way and three others."""
    config = CollectConfig()
    parts = read_recordings(form, path)
    rows = itertools.chain.from_iterable(Collector(x, config).scenes() for x in parts)
    found = list(itertools.islice(rows, count))
    scenes = stack_scenes(found)
    drawn = drawn_scenes.candidates(np.random.default_rng(0), scenes, 3)
    human = (np.array([row[f"human.{x}"] for row in found], np.float32) for x in "sl")
    ways = zip(human, drawn, strict=True)
    return scenes, *(np.concatenate([one[:, None], more], 1) for one, more in ways)


@pytest.mark.dataset
@pytest.mark.parametrize("site", SITES)
def test_recorded_scenes_equal_jax(reader, given, data_dir, tmp_path, site):
    form, folder = SITES[site]
    if not (data_dir / folder).is_dir():
        pytest.skip(f"{folder} not found")
    scenes, s, l = recorded(form, data_dir / folder, BATCH)
    assert_equal(reader, given, tmp_path, scenes, s, l)
    assert_equal(reader, given, tmp_path, scenes, s, None)
