"""Suites and rankings in other processes: the same numbers as in this one."""

import jax
import numpy as np
import pytest

from rcirl_jax.evaluation.closed_loop.suite import SuiteConfig, run_suite
from rcirl_jax.evaluation.ranking.score import RankingSetup, score_scenes
from rcirl_jax.export.closed_loop import SuiteJob, drive_by, drive_piece
from rcirl_jax.export.loading import open_reward
from rcirl_jax.runtime.executors import Processes, Serial
from rcirl_jax.simulation.suite import suite_refs
from tests.helpers.weights_files import random_weights
from tests.train.test_step import rows


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


def driven(weights, executor):
    """What identifies the result of a small suite."""
    job, config = job_of(weights), SuiteConfig(chunk=1)
    made = run_suite(job.rows(), job.cases(), config, drive_by(executor, job))
    return made.facts["result_sha256"]


def scored(weights, executor):
    """All arrays of a ranking of 16 scenes."""
    learned = {"learned": open_reward(str(weights)).value}
    given = rows(), np.arange(16), RankingSetup(), learned
    made = score_scenes(*given, executor=executor)
    return leaves([vars(made.outcomes), made.values, made.human_values])


def test_a_piece_is_its_part_of_the_whole(weights):
    job, config = job_of(weights), SuiteConfig(chunk=30)
    name = job.rows()[0].name
    (whole,) = drive_piece((name, 0, 4), job, config)
    (part,) = drive_piece((name, 1, 3), job, config)
    for a, b in zip(leaves(part), leaves(whole), strict=True):
        np.testing.assert_array_equal(a, b[1:3])


@pytest.mark.slow
@pytest.mark.multiprocess
def test_suites_and_rankings_do_not_depend_on_processes(weights):
    """As simulate and gate drive them, and evaluate ranks."""
    there, here = Processes(2), Serial()
    assert driven(weights, there) == driven(weights, here)
    for a, b in zip(scored(weights, there), scored(weights, here), strict=True):
        np.testing.assert_array_equal(a, b)
