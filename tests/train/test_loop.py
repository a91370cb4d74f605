"""A whole run on a small dataset: resume, export, rank, command lines."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.evaluate import (
    RankingSetup,
    evaluate_ranking,
    oracle_floor,
)
from rcirl_jax.evaluation.ranking.learners import FrozenSets, train_learner
from rcirl_jax.export.forms import exported_run
from rcirl_jax.export.from_run import export_run, read_config, verification_samples
from rcirl_jax.export.loading import load_runs
from rcirl_jax.features import feature_map
from rcirl_jax.reward import (
    RewardConfig,
    RewardModel,
    fit_normaliser,
    seen_range,
    value,
)
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.train import featurise
from rcirl_jax.train.featurise import normaliser_rows
from rcirl_jax.train.loop import check_run, step_of, train
from rcirl_jax.train.state import TrainConfig
from tests.helpers.stored import assert_same_bits

SMALL = SamplerConfig(num_random=4, cruise_times=(4.0,), edge_times=(4.0,))
CONFIG = TrainConfig(batch_size=8, epochs=3, sampler=SMALL)


@pytest.fixture(scope="module")
def dataset(simulated):
    return simulated


@pytest.fixture(scope="module")
def run(dataset, tmp_path_factory):
    workdir = tmp_path_factory.mktemp("run")
    result = train(dataset, workdir, CONFIG, provenance={"git_commit": "abc"})
    return workdir, result


def test_resume_is_bitwise(dataset, run, tmp_path):
    """One epoch, a new process' worth of objects, then the other two."""
    workdir = tmp_path / "resumed"
    one = TrainConfig(batch_size=8, epochs=1, sampler=SMALL)
    train(dataset, workdir, one)
    step_of.cache_clear()
    resumed = train(dataset, workdir, CONFIG)
    assert_same_bits(resumed.state, run[1].state)
    lines = (workdir / "metrics.jsonl").read_text().splitlines()
    steps = [json.loads(line)["step"] for line in lines]
    assert steps == list(range(1, len(steps) + 1))


def test_another_seed_compiles_no_step(dataset, tmp_path):
    step_of.cache_clear()
    seeds = [dataclasses.replace(CONFIG, epochs=1, seed=seed) for seed in (0, 1)]
    done = [train(dataset, tmp_path / str(x.seed), x) for x in seeds]
    assert step_of(CONFIG.for_step, "jit").step._cache_size() == 1
    assert step_of.cache_info().misses == 1
    slower = dataclasses.replace(CONFIG, learning_rate=1e-4)
    assert step_of(slower.for_step, "jit").step._cache_size() == 0
    weights = [jax.tree.leaves(x.state.params) for x in done]
    assert any((a != b).any() for a, b in zip(*weights, strict=True))


def test_other_settings_may_not_resume(dataset, run):
    with pytest.raises(InputError, match=r"leaky_rate: 0\.05: expected 0\.1"):
        train(dataset, run[0], dataclasses.replace(CONFIG, leaky_rate=0.1))

    other = dataclasses.replace(CONFIG, reward=RewardConfig(module="a.b:C"))
    with pytest.raises(InputError, match=r"reward: .*to resume"):
        check_run(run[0], other, dataset)


def test_run_writes_what_it_should(run):
    workdir, result = run
    assert list((workdir / "tensorboard").iterdir())
    assert result.epochs[-1]["epoch"] == 3
    assert result.queries > 0
    assert read_config(workdir)[0] == CONFIG
    (told,) = result.warnings  # of a run of a few steps
    assert read_config(workdir)[1]["warnings"] == [told]


def test_export_and_rank(dataset, run, tmp_path):
    reward = export_run(run[0], dataset, tmp_path / "weights.msgpack")
    config = json.loads(json.dumps(dataclasses.asdict(CONFIG)))
    assert reward.provenance["config"] == config
    assert reward.provenance["dataset_sha256"] == dataset.hash
    assert reward.provenance["steps"] == int(run[1].state.step)
    seen = seen_range(normaliser_rows(dataset, CONFIG), feature_map(CONFIG.features))
    np.testing.assert_array_equal(reward.training_range, seen)  # what the guard knows
    learned, setup = load_runs([reward.file])
    setup = dataclasses.replace(setup, sampler=SMALL)
    report = evaluate_ranking(dataset, learned, setup)
    baselines = ("constant speed", "IDM", "hand-set", "hand-set DP")
    assert set(report.rows) == {"RC-IRL 21-15-1", "random", *baselines, "oracle"}
    floor = report.rows["oracle"]["top1_fde"].value
    assert all(row["top1_fde"].value >= floor - 1e-6 for row in report.rows.values())
    # its scale is fitted as everybody's: random values must come to no preference
    each = report.counts["feasible"] / report.counts["scenes"]
    assert report.rows["random"]["nll"].value == pytest.approx(np.log(each), abs=0.1)


def test_a_run_of_another_module_is_exported_as_stablehlo(dataset, tmp_path):
    other = RewardConfig(module="tests.reward.others:Residual")
    config = dataclasses.replace(CONFIG, epochs=1, reward=other)
    state = train(dataset, tmp_path, config).state
    with pytest.raises(InputError, match=r"module: .*rcirl export --stablehlo"):
        export_run(tmp_path, dataset, tmp_path / "weights.msgpack")
    with pytest.raises(InputError, match=r"expected none: weights\.msgpack"):
        train_learner(FrozenSets(dataset).of(config), config, [0])
    x, valid = map(jnp.asarray, verification_samples(dataset, config))
    found = exported_run(tmp_path).call(x, valid[0])
    every = jnp.broadcast_to(valid[:1], valid.shape)
    want = value(RewardModel(other), state.params, state.normaliser, x, every)
    np.testing.assert_allclose(found, want, rtol=1e-5, atol=1e-5)


def test_exported_values_are_the_trainers(dataset, run, tmp_path):
    """The numpy reader and the JAX network agree on fresh scenes to 1e-5."""
    from rcirl_jax.train.featurise import featurised, host_batch

    reward = export_run(run[0], dataset, tmp_path / "weights.msgpack")
    index = dataset.indices("test")[:8]
    batch = host_batch(dataset.read(index), np.ones(8), index)
    features = jax.jit(featurised, static_argnums=2)
    made = features(jax.random.key(9), batch, CONFIG)
    state = run[1].state
    model, points = RewardModel(CONFIG.reward), (made.points, made.points_valid)
    expected = value(model, state.params, state.normaliser, *points)
    found = reward.value(np.asarray(made.points), np.asarray(made.points_valid))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def test_the_oracle_floor_is_of_scenes_that_cover_the_horizon(dataset):
    """A sample of part of them is as likely to hold late rows as early ones."""
    setup = RankingSetup(sampler=SMALL, horizon_s=5.0)
    future = dataset.read(dataset.indices(None)).future_s
    covering = int(np.sum(future >= 5.0 - 1e-3))
    assert oracle_floor(dataset, setup, 10_000)["scenes"] == covering
    floor = oracle_floor(dataset, setup, 7)
    assert floor["scenes"] == 7
    assert 0.0 <= floor["best_fde_median_m"] <= floor["best_fde_mean_m"] + 5.0
    long = dataclasses.replace(setup, horizon_s=8.5)
    with pytest.raises(InputError, match=r"horizon_s: 8\.5: no scene is recorded"):
        oracle_floor(dataset, long, 64)
    with pytest.raises(InputError, match="nowhere"):
        evaluate_ranking(dataset, {}, dataclasses.replace(setup, split="nowhere"))


def test_a_run_of_a_later_version_is_refused(dataset, run, tmp_path):
    """A setting that this version does not know may have changed the result."""
    body = json.loads((run[0] / "run.json").read_text())
    body["config"]["momentum"] = 0.9
    (tmp_path / "run.json").write_text(json.dumps(body))
    with pytest.raises(InputError, match=r"run\.json: momentum: unknown: expected a r"):
        train(dataset, tmp_path, CONFIG)
    with pytest.raises(InputError, match=r"run\.json: .*momentum.*: expected a run of"):
        export_run(tmp_path, dataset, tmp_path / "weights.msgpack")
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]
    body["config"] = dataclasses.asdict(CONFIG) | {"reward": {"hidden": 15}}
    (tmp_path / "run.json").write_text(json.dumps(body))
    with pytest.raises(InputError, match=r"run\.json: reward\.hidden: 15: expected a"):
        read_config(tmp_path)


def test_every_scene_counts_once_for_the_normaliser(dataset, monkeypatch):
    """Whatever the batch, and where the last call is not full."""
    features = feature_map(CONFIG.features)
    whole = fit_normaliser(normaliser_rows(dataset, CONFIG), features)
    other = dataclasses.replace(CONFIG, batch_size=3)
    monkeypatch.setattr(featurise, "CHUNK", dataset.indices("train").size - 1)
    again = fit_normaliser(normaliser_rows(dataset, other), features)
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
