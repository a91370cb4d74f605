"""A NaN anywhere is one line that names the scene or the case."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.data import importing
from rcirl_jax.data.importing import RecordingScenes
from rcirl_jax.data.store.writer import DatasetWriter
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.suite import SuiteConfig, run_suite
from rcirl_jax.evaluation.ranking.evaluate import RankingSetup, evaluate_ranking
from rcirl_jax.evaluation.ranking.learners import learner_configs, train_learners
from rcirl_jax.export.sweep import train_group
from rcirl_jax.planner.rank import RankConfig, best_plan
from rcirl_jax.sampling import sample
from rcirl_jax.simulation.rollout import SAMPLER_STREAM
from rcirl_jax.simulation.rows import Row
from rcirl_jax.simulation.suite import catalogue_set, suite_refs
from rcirl_jax.train import featurise
from rcirl_jax.train.loop import train
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.units import HORIZON_S
from tests.helpers.stored import rows_of
from tests.helpers.stored import stored as written
from tests.train.test_step import SMALL
from tests.train.test_sweep import config_of

COUNT = 16  # scenes, one vehicle each; every fourth from the second is a test scene
CONFIG = TrainConfig(batch_size=4, epochs=1, sampler=SMALL, positive="nearest")
SETUP = RankingSetup(sampler=SMALL)
TRAINED, HELD_OUT = 6, 9


def rows():
    made = rows_of(range(COUNT))
    return made.replace(future_s=np.full(COUNT, HORIZON_S, np.float32))


def stored(folder, row=None, value=np.nan):
    """A dataset of which one row, if any, holds a limit that is no number."""
    made = rows()
    if row is not None:
        limit = made.scene.path.speed_limit.copy()
        limit[row, 40] = value
        path = made.scene.path.replace(speed_limit=limit)
        made = made.replace(scene=made.scene.replace(path=path))
    return written(folder, [made])


def line(row):
    return rf"scene {row} \(recording 0, vehicle {row}, frame {row}\): "


def test_a_stored_nan_is_named_by_what_is_made_of_it(tmp_path):
    """Import refuses such a scene; one that got past it is found in its features."""
    data = stored(tmp_path / "d", TRAINED)
    sweep = config_of(tmp_path / "d", base=dataclasses.replace(CONFIG, seed=3))
    learners = learner_configs(["hinge"], CONFIG)
    held = stored(tmp_path / "held", HELD_OUT)
    for work, place in (
        (lambda: train(data, tmp_path / "run", CONFIG), f"train: {line(TRAINED)}"),
        (lambda: train_learners(data, learners, [0]), f"train: {line(TRAINED)}"),
        (lambda: next(train_group(sweep.grid[:1], sweep)), f"train: {line(TRAINED)}"),
        (lambda: evaluate_ranking(held, {}, SETUP), f"rank: {line(HELD_OUT)}"),
    ):
        with pytest.raises(InputError, match=rf"^{place}.*feature .*speed_limit"):
            work()
    assert not (tmp_path / "run" / "run.json").exists()


def test_the_guard_looks_up_a_scene_that_no_check_saw(tmp_path, monkeypatch):
    """The normaliser is fitted on some training scenes only."""
    monkeypatch.setattr(featurise, "NORMALISER_SCENES", 8)
    data = stored(tmp_path / "d")
    index = data.indices("train")
    drawn = np.random.default_rng([CONFIG.seed, featurise.NORMALISER_STREAM])
    unseen = index[drawn.permutation(index.size)[8:]]
    bad = stored(tmp_path / "bad", int(unseen[0]))
    expected = (
        rf"^train: step \d+: {line(unseen[0])}feature .*speed_limit.*: not finite "
        r"\(as is the stored scene\.path\.speed_limit\): expected finite numbers; "
        "the state before is kept$"
    )
    with pytest.raises(InputError, match=expected):
        train(bad, tmp_path / "run", dataclasses.replace(CONFIG, epochs=3))


def test_a_value_that_is_no_number_is_named_by_its_scene(tmp_path):
    data = stored(tmp_path / "d")

    def scorer(x, valid):
        values = np.zeros(x.shape[:-2])
        values[(x.shape[0] - 1, *[0] * (x.ndim - 3))] = np.nan
        return values

    with pytest.raises(InputError, match=r"^rank: scene \d+ \(.*\): value of net#0: "):
        evaluate_ranking(data, {"net": [scorer]}, SETUP)


def test_an_import_refuses_a_scene_that_is_not_finite(tmp_path):
    made, v = rows(), rows().scene.ego.v.copy()
    v[5] = np.nan
    made = made.replace(scene=made.scene.replace(ego=made.scene.ego.replace(v=v)))
    work = importing._Import(
        DatasetWriter(tmp_path / "d"), importing.ImportConfig(format="synthetic")
    )
    found = RecordingScenes(
        name="log", source="", licence="", rate_hz=10.0, sha256="", scenes=made,
        vehicles=["v"] * COUNT, groups=["g"] * COUNT, first_seen=[0.0] * COUNT,
    )  # fmt: skip
    with pytest.raises(InputError, match=r"^log: scene 5 \(.*\): scene\.ego\.v: not"):
        work.add(found)


def one_unknown(params, scene, key, before):
    """A policy of which one candidate's score is no number where the key is marked."""
    unknown, marked = params
    candidates = sample(key, scene, RankConfig().sampler)
    here = jnp.all(jax.random.key_data(key) == marked)
    way = candidates.trajectory.s[:, -1]
    scores = jnp.where(here & (jnp.arange(way.size) == 3), unknown, way)
    return best_plan(scene, candidates, scores, RankConfig())


def test_a_score_that_is_no_number_is_named_by_row_and_case():
    """The filter would take the other candidates, and nobody would know."""
    cases = catalogue_set(suite_refs("smoke")[:3], 5.0)
    key = jax.random.key(int(cases.build(1, 2).seed[0]))
    marked = jax.random.fold_in(jax.random.fold_in(key, SAMPLER_STREAM), 0)
    params = jnp.float32(np.nan), jax.random.key_data(marked)
    row = Row(name="learned", policy=one_unknown, params=params)
    with pytest.raises(InputError) as caught:
        run_suite([row], cases, SuiteConfig())
    assert str(caught.value).startswith(f"simulate: learned: case {cases.ids[1]}: ")
    assert str(caught.value).endswith(": nan: expected a number")
