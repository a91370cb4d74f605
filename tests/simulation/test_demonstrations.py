"""Datasets driven from the catalogue."""

import numpy as np

from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.simulation.demonstrations import DriveConfig, drive_catalogue
from rcirl_jax.simulation.rows import mobil_row
from rcirl_jax.simulation.suite import CaseRef
from rcirl_jax.units import TIMES_S


def test_every_scene_has_its_future_with_offsets_from_the_lane_it_begins_in(tmp_path):
    """2 drives of 44 s, a scene every 3 s from 3 s on, 8 s of future."""
    refs = [CaseRef(family="cut_out", index=i, seed=7) for i in range(2)]
    row, config = mobil_row(), DriveConfig(duration_s=44.0, stride_s=3.0)
    drive_catalogue(refs, tmp_path, config, expert=(row.policy, row.params))
    dataset = open_dataset(str(tmp_path))
    assert dataset.count == 2 * len(np.arange(3.0, 36.0 + 1e-9, 3.0))
    rows = dataset.load(None)
    s, l = np.asarray(rows.human.s), np.asarray(rows.human.l)
    assert s.shape[1] == TIMES_S.size
    np.testing.assert_allclose(s[:, 0], 0.0, atol=1e-3)
    assert (np.diff(s, axis=1) >= -1e-4).all()
    # the driver changes lanes: wherever a scene begins, it is within its lane
    np.testing.assert_allclose(l[:, 0], rows.scene.ego.l, atol=1e-3)
    assert np.abs(l[:, 0]).max() < 2.0
    changes = np.abs(l[:, -1]) > 3.0
    assert 0 < changes.sum() < len(changes)
    np.testing.assert_array_equal(rows.scene.path.l, 0.0)
