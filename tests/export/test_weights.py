"""The written file: same input same bytes, atomic, exact, described by its schema."""

import base64
import dataclasses
import hashlib
import json
import math
from pathlib import Path

import jsonschema
import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rcirl_jax.errors import InputError
from rcirl_jax.export import (
    decode_weights,
    load_weights,
    pack,
    reader,
    save,
    to_json,
)
from rcirl_jax.export.weights import save_with_dial
from rcirl_jax.runtime.specs import spec_root
from tests.export.wrong import body_of
from tests.helpers.weights_files import (
    ACTIVATIONS,
    example_samples,
    example_weights,
    packed,
    provenance,
    trained_network,
)


@settings(max_examples=40)
@given(
    seed=st.integers(0, 10**6),
    features=st.integers(1, 6),
    times=st.integers(1, 5),
    hidden=st.lists(st.integers(1, 5), max_size=3),
    activation=st.sampled_from(ACTIVATIONS),
    gated=st.booleans(),
)
def test_file_scores_as_the_float64_loops(
    seed, features, times, hidden, activation, gated
):
    weights = example_weights(seed, features, times, tuple(hidden), activation, gated)
    own = example_samples(weights, seed=seed)
    reward = decode_weights(pack(weights, *own))
    other, valid, values = example_samples(weights, count=6, seed=seed + 1)
    found = reward.value(other, valid)
    assert found.dtype == np.float32
    assert np.all(np.abs(found - values) <= 1e-5 * np.maximum(1.0, np.abs(values)))


@pytest.mark.parametrize(
    ("activation", "hidden", "scene_gating"),
    [("tanh", (15,), False), ("tanh", (16, 8), True), ("leaky_relu", (15,), True),
     ("relu", (16, 8), False), ("identity", (), False)],
)  # fmt: skip
def test_thousand_inputs_equal_the_trained_network(activation, hidden, scene_gating):
    """The file carries the EFFECTIVE weights: the trainer pins raw ones itself."""
    made = trained_network(hidden, activation, scene_gating, 1000)
    weights, features, valid, expected = made
    data = pack(weights, features[:16], valid[:16], expected[:16])
    found = decode_weights(data).value(features, valid)
    assert np.ptp(expected) > 0.1
    assert np.all(np.abs(found - expected) <= 1e-5 * np.maximum(1.0, np.abs(expected)))


def assert_back(found, made, names):
    for name in names:
        given, back = getattr(made, name), getattr(found, name)
        if isinstance(back, np.ndarray):
            given, back = [given], [back]
        for one, other in zip(given, back, strict=True):
            np.testing.assert_array_equal(one, other)
            assert not other.flags.writeable


def test_everything_comes_back_as_it_was_given():
    weights = example_weights(hidden=(4, 2), activation="leaky_relu", with_prior=True)
    reward = decode_weights(pack(weights, *example_samples(weights)))
    numbers = ("lower", "upper", "location", "scale", "times", "gamma")
    np.testing.assert_array_equal(
        reward.training_range, np.float32(weights.training_range)
    )
    assert_back(reward, weights, (*numbers, "kernels", "biases"))
    for name in ("names", "units", "none_values"):
        assert getattr(reward, name) == getattr(weights, name)
    assert (reward.activation, reward.leaky_slope) == ("leaky_relu", 0.01)
    assert (reward.preset, reward.loss) == ("test", weights.loss)
    assert reward.provenance == provenance()
    assert type(reward.provenance["metrics"]["steps"]) is int
    assert reward.prior_cost == weights.prior_cost
    assert decode_weights(packed()).prior_cost is None


def test_same_input_same_bytes_whatever_the_order_of_keys(tmp_path):
    weights = example_weights()
    samples = example_samples(weights)
    turned = {key: provenance()[key] for key in reversed(provenance())}
    turned["flags"] = dict(reversed(list(turned["flags"].items())))
    other = dataclasses.replace(
        weights,
        provenance=turned,
        loss={"leaky_rate": 0.05, "name": "rank"},
        kernels=tuple(map(np.asfortranarray, weights.kernels)),  # in memory
        gamma=np.float64(weights.gamma),
    )
    first, second = tmp_path / "a.msgpack", tmp_path / "b.msgpack"
    reward = save(first, weights, *samples)
    save(second, other, *samples)
    assert first.read_bytes() == second.read_bytes() == pack(weights, *samples)
    assert reward.sha256 == load_weights(second).sha256
    assert packed(seed=9) != first.read_bytes()


def test_layout_is_the_documented_one():
    data = packed()
    # 14 fixed bytes, so that `file` and a hex dump tell the format.
    assert data[:15] == b"\x84\xa5magic\xa6RCIRLW\xae"
    outer = msgpack.unpackb(data)
    assert tuple(outer) == ("magic", "schema_version", "body", "sha256")
    assert (outer["magic"], outer["schema_version"]) == ("RCIRLW", 1)
    assert outer["sha256"] == hashlib.sha256(outer["body"]).hexdigest()
    body = msgpack.unpackb(outer["body"])
    assert tuple(body) == tuple(reader.BODY)
    assert body["scene_gating"] is body["prior_cost"] is None
    full = body_of(packed(with_prior=True, scene_gating=True))
    assert full["scene_gating"]["shape"] == [3, 3]
    assert tuple(full["prior_cost"]) == tuple(reader.BODY["prior_cost"][0])


def test_schema_describes_the_body_and_refuses_others():
    path = spec_root() / "reward_weights.schema.json"
    schema = json.loads(path.read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    kinds = ({"hidden": (4, 2)}, {"scene_gating": True, "with_prior": True})
    plain, full = (to_json(packed(**kind)) for kind in kinds)
    for made in (plain, full, to_json(GOLDEN.read_bytes())):
        validator.validate(made)
        json.dumps(made, allow_nan=False)
    gamma = np.frombuffer(base64.b64decode(plain["gamma"]["data"]), "<f4")
    np.testing.assert_array_equal(gamma, example_weights(hidden=(4, 2)).gamma)
    found = schema["properties"]
    prior = found["prior_cost"]["anyOf"][1]
    for described, keys in (
        (schema, tuple(reader.BODY)),
        (found["samples"], reader.BODY["samples"]),
        (prior, reader.BODY["prior_cost"][0]),
    ):
        assert (
            tuple(described["required"])
            == tuple(described["properties"])
            == tuple(keys)
        )
    assert found["activation"]["enum"] == sorted(ACTIVATIONS)
    wrong = [{**plain, "extra": 1}, {**full, "scene_gating": full["gamma"]}]
    wrong.append({**plain, "gamma": {**plain["gamma"], "dtype": "<f8"}})
    for key in reader.BODY:
        wrong += [{k: v for k, v in full.items() if k != key}, {**full, key: True}]
    assert not any(map(validator.is_valid, wrong))


# -------------------------------------------------------------- a file that is kept

GOLDEN = Path(__file__).parent / "golden" / "weights.msgpack"


def golden():
    """The file, inputs, masks, and what it scored and added when it was written."""
    told = json.loads(GOLDEN.with_suffix(".json").read_text())
    names = ("features", "time_valid", "value", "incumbent", "total")
    return GOLDEN, *(np.array(told[name]) for name in names)


def test_a_file_that_planners_have_scores_as_it_did():
    """Never made anew: a reader that fails here would strand the weights in use."""
    path, features, valid, value, own, total = golden()
    assert hashlib.sha256(path.read_bytes()).hexdigest() == (
        "90b0830b2708e64472938804e3ca1becf9824c4350e59118130291cb9783459f"
    )
    reward = load_weights(path)
    assert reward.names == ("feature0", "feature1", "feature2", "feature3")
    assert reward.scene_gating is not None
    close = {"rtol": 1e-6, "atol": 1e-6}
    assert np.ptp(value) > 1.0
    np.testing.assert_allclose(reward.value(features, valid), value, **close)
    np.testing.assert_allclose(reward.total(features, own, valid), total, **close)


def prior(gain):
    return {"prior_cost": reader.PriorCost(incumbent="hand-set", gain=gain)}


ENDLESS: dict = {}
ENDLESS["self"] = ENDLESS


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        # what the reader says of the file that would be written
        ({"scale": np.array([1.0, 0.0, 1.0])}, "normaliser.scale[1]: 0: expected over"),
        (prior(math.inf), "prior_cost.gain: inf: expected a finite number"),
        # what never becomes a file
        ({"preset": object()}, "can not serialize"),
        ({"gamma": "many"}, "gamma: could not convert string to float"),
        ({"biases": ()}, "biases: 0 biases: expected one for each kernel"),
        ({"provenance": {}}, "provenance.dataset_sha256: missing: expected a value"),
        *(
            ({"provenance": {**provenance(), **entry}}, message)
            for entry, message in (
                ({"metrics": {"fde": math.nan}}, "provenance: nan: expected texts"),
                ({"flags": {1: 2}}, "int is not allowed for map key"),
                ({"flags": ENDLESS}, "maximum recursion depth exceeded"),
            )
        ),
    ],
)
def test_what_a_reader_would_refuse_is_never_written(changes, message, tmp_path):
    weights = example_weights()
    samples = example_samples(weights)
    path = tmp_path / "weights.msgpack"
    with pytest.raises(InputError) as caught:
        save(path, dataclasses.replace(weights, **changes), *samples)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_dial_multiplies_the_gain_and_nothing_else(tmp_path):
    weights = example_weights(with_prior=True)
    samples = example_samples(weights)
    was = save(tmp_path / "was", weights, *samples)
    now = save_with_dial(tmp_path / "was", 2.5, tmp_path / "now")
    assert now.prior_cost.gain == 3.75
    np.testing.assert_array_equal(now.value(samples[0]), was.value(samples[0]))
    assert now.provenance["dial"] == {"of_sha256": was.sha256, "times": 2.5}
    with pytest.raises(InputError, match="dial: 0: expected above 0"):
        save_with_dial(tmp_path / "was", 0.0, tmp_path / "none")
    plain = example_weights()
    save(tmp_path / "plain", plain, *example_samples(plain))
    with pytest.raises(InputError, match="plain: prior_cost: none: expected weights"):
        save_with_dial(tmp_path / "plain", 2.0, tmp_path / "none")
