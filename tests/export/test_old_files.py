"""Files that earlier versions wrote are read as they were, later ones refused.

The golden files were written, and their values computed, by the first commits that
knew their version (1: 81c261a, 2: 41456a9), of version 3 by
471ea86, of version 4 by 2603640. They are
never made anew: a reader that fails here would strand the weights that planners have.
"""

import hashlib
import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from rcirl_jax.export import load_weights, to_json
from rcirl_jax.runtime.specs import spec_root

GOLDEN = Path(__file__).parent / "golden"
SHA256 = {  # of the whole files
    1: "5d14c2f70868cdbbef17d7d620b4ac9dc2a74f1305c4eec793739495a84dc6b4",
    2: "f6e1824cbac37db0ac021427f6efa4cb4becb8c07936224bc9cfb8e323635161",
    3: "62818194b3d35babea2ec11c2f39f9e95885af1d22df35f88824370f85efcf20",
    4: "6c3c9c92128f77613d429e06c7b88d3c4d0af974da3cd39b4f315ae6991e4642",
}


def golden(version):
    """A file of this version, inputs, masks and the values they had then."""
    told = json.loads((GOLDEN / f"weights_{version}.json").read_text())
    arrays = [np.array(told[name]) for name in ("features", "time_valid", "value")]
    return GOLDEN / f"weights_{version}.msgpack", *arrays


@pytest.mark.parametrize("version", SHA256)
def test_an_old_file_scores_as_it_did(version):
    path, features, valid, expected = golden(version)
    assert hashlib.sha256(path.read_bytes()).hexdigest() == SHA256[version]
    reward = load_weights(path)
    assert (reward.context is None) == (version == 1)
    assert (reward.seen is None) == (version < 3)
    assert (reward.prior_cost is None) == (version < 4)
    assert reward.names == ("feature0", "feature1", "feature2", "feature3")
    assert reward.provenance["git_commit"] == "2fe49aa"
    found = reward.value(features, valid)
    assert np.ptp(expected) > 1.0
    assert np.all(np.abs(found - expected) <= 1e-6 * np.maximum(1.0, np.abs(expected)))


def test_an_old_anchored_file_adds_what_it_did():
    path, features, valid, _ = golden(4)
    told = json.loads(path.with_suffix(".json").read_text())
    reward = load_weights(path)
    close = {"rtol": 1e-6, "atol": 1e-6}
    np.testing.assert_allclose(reward.gain(features), told["gain"], **close)
    own = np.array(told["incumbent"])
    np.testing.assert_allclose(
        reward.total(features, own, valid), told["total"], **close
    )


@pytest.mark.parametrize("version", SHA256)
def test_the_schema_still_describes_an_old_file(version):
    data = golden(version)[0].read_bytes()
    schema = json.loads((spec_root() / "reward_weights.schema.json").read_text())
    jsonschema.validate(to_json(data), schema)
