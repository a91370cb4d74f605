"""Datasets driven from the catalogue, alone and with a learner at the wheel."""

import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.simulation.demonstrations import DriveConfig, drive_catalogue
from rcirl_jax.simulation.suite import CaseRef
from rcirl_jax.units import TIMES_S
from tests.simulation.drives import constant

REFS = [CaseRef(family="free_cruise", index=i, seed=7) for i in range(2)]
CONFIG = DriveConfig(duration_s=44.0, stride_s=3.0, turns_s=(8.0, 14.0))


def scenes(folder, **learner):
    drive_catalogue(REFS, folder, CONFIG, **learner)
    return open_dataset(str(folder))


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    return scenes(tmp_path_factory.mktemp("drive") / "alone")


def test_every_scene_has_its_future(alone):
    rows = alone.load(None)
    s = np.asarray(rows.human.s)
    assert s.shape[1] == TIMES_S.size
    np.testing.assert_allclose(s[:, 0], 0.0, atol=1e-3)
    assert (np.diff(s, axis=1) >= -1e-4).all()
    # 2 drives of 44 s, a scene every 3 s from 3 s on, 8 s of future
    assert alone.count == 2 * len(np.arange(3.0, 36.0 + 1e-9, 3.0))


def test_only_the_drivers_turns_are_kept(tmp_path):
    """A learner that brakes hard leaves no braking in what is kept."""
    takeovers = scenes(tmp_path / "takeovers", learner=(constant, jnp.float32(-3.0)))
    rows = takeovers.load(None)
    # turns of the driver begin at 8 s and 30 s: scenes 0, 3 and 6 s into them
    assert takeovers.count == 2 * 2 * 3
    first = np.asarray(rows.scene.ego.v).reshape(2, 6)[:, [0, 3]]
    assert first.min() < 1.0  # it stands where the learner left it
    way = np.asarray(rows.human.s)[:, -1]
    assert (way > 5.0).all()  # and the driver drives off
