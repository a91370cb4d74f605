"""Suites and rankings in other processes: the same numbers as in this one."""

import functools

import jax
import numpy as np
import pytest

from rcirl_jax.evaluation.closed_loop import SuiteConfig, drive_here, run_suite
from rcirl_jax.evaluation.score import score_scenes
from rcirl_jax.executor import Here, Processes
from rcirl_jax.export.loading import open_reward
from rcirl_jax.export.spread import SuiteJob, drive_piece, spread
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.simulation.suite import suite_refs
from tests.train.test_step import rows
from tests.weights_files import random_weights


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    return random_weights(tmp_path_factory.mktemp("weights") / "w.msgpack")


def job_of(weights):
    return SuiteJob(
        weights=(str(weights),),
        baselines=("IDM", "hand-set"),
        refs=suite_refs("cut_in,lead_brakes", 2),
        duration_s=2.0,
    )


def leaves(made):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(made)]


@pytest.mark.slow
@pytest.mark.multiprocess
def test_a_suite_does_not_depend_on_where_it_is_driven(weights):
    job, config = job_of(weights), SuiteConfig(chunk=1)
    here = run_suite(job.rows(), job.cases(), config, drive_here)
    there = run_suite(job.rows(), job.cases(), config, spread(Processes(2), job))
    assert here.facts["result_sha256"] == there.facts["result_sha256"]


def test_a_piece_is_its_part_of_the_whole(weights):
    job, config = job_of(weights), SuiteConfig(chunk=30)
    name = job.rows()[0].name
    (whole,) = drive_piece((name, 0, 4), job, config)
    (part,) = drive_piece((name, 1, 3), job, config)
    for a, b in zip(leaves(part), leaves(whole), strict=True):
        np.testing.assert_array_equal(a, b[1:3])


@pytest.mark.multiprocess
def test_a_ranking_does_not_depend_on_where_it_is_scored(weights):
    reward = open_reward(str(weights))
    score = functools.partial(
        score_scenes,
        rows(),
        np.arange(16),
        preset="paper21",
        sampler=SamplerConfig(),
        horizon_s=5.0,
        scorers={"learned": reward.value},
    )
    here, there = score(executor=Here()), score(executor=Processes(2))
    for a, b in zip(leaves(vars(here)), leaves(vars(there)), strict=True):
        np.testing.assert_array_equal(a, b)
