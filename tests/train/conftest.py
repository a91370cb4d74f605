"""Data that several trainings are disturbed on."""

import pytest

from tests.helpers.stored import rows_of, stored


@pytest.fixture(scope="session")
def four_shards(tmp_path_factory):
    """28 demonstrations, of which 21 are trained on: batches of 8, the last of 5."""
    folder = tmp_path_factory.mktemp("shards") / "d"
    stored(folder, [rows_of(range(7 * i, 7 * i + 7)) for i in range(4)])
    return folder
