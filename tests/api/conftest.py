"""A folder as the examples find it: traffic.toml, data, weights.msgpack."""

import pytest

from rcirl_jax.data.importing import ImportConfig, import_logs
from rcirl_jax.data.inputs import input_files
from rcirl_jax.data.scenes.config import CollectConfig
from tests.helpers.weights_files import random_weights

TRAFFIC = """
[[recordings]]
road = "highway_straight"
count = 2
duration_s = 20.0
density_veh_per_km = 12.0
seed = 1
"""


@pytest.fixture(scope="session")
def examples(tmp_path_factory):
    """Two recordings of 20 s, the dataset of them, and weights."""
    folder = tmp_path_factory.mktemp("examples")
    (folder / "traffic.toml").write_text(TRAFFIC)
    collect = CollectConfig(stride_s=2.0)
    config = ImportConfig(format="synthetic", collect=collect)
    parts = input_files("synthetic", folder / "traffic.toml")
    import_logs(parts, folder / "data", config)
    random_weights(folder / "weights.msgpack")
    return folder
