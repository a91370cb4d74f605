"""Datasets driven from the catalogue."""

import numpy as np
import pytest

from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.simulation.demonstrations import DriveConfig, drive_catalogue
from rcirl_jax.simulation.rows import mobil_row
from rcirl_jax.simulation.suite import CaseRef
from rcirl_jax.units import TIMES_S

REFS = [CaseRef(family="free_cruise", index=i, seed=7) for i in range(2)]
CONFIG = DriveConfig(duration_s=44.0, stride_s=3.0)


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drive") / "alone"
    drive_catalogue(REFS, folder, CONFIG)
    return open_dataset(str(folder))


def test_every_scene_has_its_future(alone):
    rows = alone.load(None)
    s = np.asarray(rows.human.s)
    assert s.shape[1] == TIMES_S.size
    np.testing.assert_allclose(s[:, 0], 0.0, atol=1e-3)
    assert (np.diff(s, axis=1) >= -1e-4).all()
    # 2 drives of 44 s, a scene every 3 s from 3 s on, 8 s of future
    assert alone.count == 2 * len(np.arange(3.0, 36.0 + 1e-9, 3.0))


def test_offsets_of_a_driver_that_changes_lanes_are_from_its_lane(tmp_path):
    """Wherever a scene begins, the human is at its ego's offset, within its lane."""
    refs = [CaseRef(family="cut_out", index=i, seed=7) for i in range(2)]
    row = mobil_row()
    drive_catalogue(refs, tmp_path, CONFIG, expert=(row.policy, row.params))
    rows = open_dataset(str(tmp_path)).load(None)
    l = np.asarray(rows.human.l)
    np.testing.assert_allclose(l[:, 0], rows.scene.ego.l, atol=1e-3)
    assert np.abs(l[:, 0]).max() < 2.0
    changes = np.abs(l[:, -1]) > 3.0
    assert 0 < changes.sum() < len(changes)
    np.testing.assert_array_equal(rows.scene.path.l, 0.0)
