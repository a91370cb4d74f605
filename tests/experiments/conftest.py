"""What the commands are run on: logs/, the dataset of them in data/, w.msgpack."""

import pytest

from rcirl_jax.data.importing import import_logs
from tests.data.small_logs import CONFIG, write_logs
from tests.helpers.weights_files import random_weights


@pytest.fixture(scope="session")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("experiments")
    import_logs(write_logs(folder / "logs", 3), folder / "data", CONFIG)
    random_weights(folder / "w.msgpack")
    return folder
