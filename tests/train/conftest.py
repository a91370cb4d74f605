"""Data that several trainings are disturbed on, and the run that nothing disturbs."""

import pytest

from rcirl_jax.data.formats import read_recordings
from rcirl_jax.data.importing import ImportConfig, import_logs
from rcirl_jax.data.store.dataset import open_dataset
from tests.helpers.stored import rows_of, stored
from tests.train.worker import trained

ROADS = """
source = "test"
licence = "none"
rate_hz = 10.0
[[recordings]]
road = "arterial_signals"
count = 2
duration_s = 25.0
density_veh_per_km = 18.0
seed = 3
"""


@pytest.fixture(scope="session")
def simulated(tmp_path_factory):
    """Imported simulated drives, half of them held out."""
    folder = tmp_path_factory.mktemp("loop")
    (folder / "roads.toml").write_text(ROADS)
    recordings = read_recordings("synthetic", folder / "roads.toml")
    config = ImportConfig(format="synthetic", test_fraction=0.5)
    import_logs(recordings, folder / "dataset", config)
    return open_dataset(folder / "dataset")


@pytest.fixture(scope="session")
def four_shards(tmp_path_factory):
    """28 demonstrations, of which 21 are trained on: batches of 8, the last of 5."""
    folder = tmp_path_factory.mktemp("shards") / "d"
    stored(folder, [rows_of(range(7 * i, 7 * i + 7)) for i in range(4)])
    return folder


@pytest.fixture(scope="session")
def undisturbed(four_shards, tmp_path_factory):
    """What a training on them by one process and one device comes to."""
    folder = tmp_path_factory.mktemp("whole")
    return trained(open_dataset(four_shards), folder, checkpoint_every=1)
