"""Other forms of a weights file score as it does."""

import dataclasses
import json

import jax
import numpy as np
import onnx
import pytest
import yaml
from onnx.reference import ReferenceEvaluator

from rcirl_jax.export import save
from rcirl_jax.export.forms import exported, reward_yaml, write_onnx, write_stablehlo
from rcirl_jax.export.loading import open_reward
from rcirl_jax.export.reader import load_weights
from tests.helpers.commands import succeeded
from tests.helpers.weights_files import example_weights, loop_value, random_weights

F, T = 5, 7


def reward(folder, hidden=(15,), activation="tanh", scene_gating=False, kernels=None):
    """A verified file of random weights, without an output bias."""
    made = example_weights(0, F, T, hidden, activation, scene_gating)
    biases = (*made.biases[:-1], np.zeros(1, np.float32))
    made = dataclasses.replace(made, biases=biases)
    if kernels is not None:
        zeros = tuple(np.zeros(kernel.shape[1], np.float32) for kernel in kernels)
        made = dataclasses.replace(made, kernels=kernels, biases=zeros)
    x = np.random.default_rng(0).normal(size=(3, T, F)).astype(np.float32)
    valid = np.ones((3, T), bool)
    values = [loop_value(made, *one) for one in zip(x, valid, strict=True)]
    save(folder / "w.msgpack", made, x, valid, np.array(values))
    return load_weights(folder / "w.msgpack")


def inputs():
    rng = np.random.default_rng(1)
    x = (3.0 * rng.normal(size=(200, T, F))).astype(np.float32)
    valid = rng.uniform(size=T) < 0.7
    valid[0] = True
    x[:, ~valid] = np.nan  # harmless there
    return x, valid


SHAPES = [
    ((), "tanh", False),
    ((15,), "tanh", False),
    ((6, 4), "relu", False),
    ((6,), "leaky_relu", False),
    ((15,), "tanh", True),
]


@pytest.mark.parametrize(("hidden", "activation", "scene_gating"), SHAPES)
def test_onnx_and_jax_export_score_as_the_file(
    tmp_path, hidden, activation, scene_gating
):
    made, (x, valid) = reward(tmp_path, hidden, activation, scene_gating), inputs()
    want = made.value(x, np.broadcast_to(valid, x.shape[:2]))
    write_onnx(tmp_path / "w.onnx", made)
    model = onnx.load(tmp_path / "w.onnx")
    (found,) = ReferenceEvaluator(model).run(None, {"features": x, "valid": valid})
    np.testing.assert_allclose(found, want, rtol=1e-5, atol=1e-5)
    facts = {prop.key: prop.value for prop in model.metadata_props}
    assert facts["weights_sha256"] == made.sha256
    write_stablehlo(tmp_path / "w.jax", exported(made), "jax")
    again = jax.export.deserialize(bytearray((tmp_path / "w.jax").read_bytes()))
    for count in (1, 200):  # any number of candidates
        found = again.call(x[:count], valid)
        np.testing.assert_allclose(found, want[:count], rtol=1e-5, atol=1e-5)
    write_stablehlo(tmp_path / "w.stablehlo", exported(made), "stablehlo")
    assert (tmp_path / "w.stablehlo").read_bytes()[:4] == b"ML\xefR"  # MLIR bytecode


def value_of(document, x, valid):
    """The cost that the YAML describes, by hand."""
    total = np.zeros(len(x))
    for i, facts in enumerate(document["features"].values()):
        f = np.clip(x[..., i], facts["lower"], facts["upper"]) - facts["usual"]
        part = facts["above"] * np.maximum(f, 0) + facts["below"] * np.maximum(-f, 0)
        total += np.sum(
            np.where(valid, part * np.array(document["gamma"]), 0.0), axis=1
        )
    return total


@pytest.mark.parametrize("nonnegative", [False, True])
def test_yaml_of_a_linear_reward_is_its_cost(tmp_path, nonnegative):
    made = reward(tmp_path, ())
    if nonnegative:
        weights = -np.random.default_rng(3).uniform(0.1, 1.0, size=(2 * F, 1))
        both = np.concatenate([np.eye(F), -np.eye(F)], axis=1)
        kernels = (both.astype(np.float32), weights.astype(np.float32))
        made = reward(tmp_path, (2 * F,), "relu", kernels=kernels)
    document = yaml.safe_load(reward_yaml(made))
    x, valid = inputs()
    want = -made.value(x, np.broadcast_to(valid, x.shape[:2]))
    np.testing.assert_allclose(value_of(document, x, valid), want, rtol=1e-4, atol=1e-4)
    assert ("frenetix" in document) == nonnegative


def test_frenetix_terms_match_at_one_spread(tmp_path):
    """Features a (spread 2, 0.3 either side) and v (0.4 above, 0.2 below)."""
    made = reward(tmp_path)
    made = dataclasses.replace(
        made,
        names=("acceleration", "velocity"),
        units=("m/s^2", "m/s"),
        lower=np.full(2, -9.0),
        upper=np.full(2, 9.0),
        location=np.zeros(2),
        scale=np.array([2.0, 1.0]),
        times=np.array([0.0, 0.5, 1.0]),
        gamma=np.ones(3),
        activation="relu",
        kernels=(
            np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]]),
            -np.array([[0.6], [0.6], [0.4], [0.2]]),
        ),
        biases=(np.zeros(4), np.zeros(1)),
    )
    terms = yaml.safe_load(reward_yaml(made))["frenetix"]["cost_weights"]
    assert len(terms) == 13
    # a departure of 2 m/s^2 costs 0.6 a time, 1.2 a second: w 2^2 = 1.2
    assert terms.pop("acceleration") == pytest.approx(0.3)
    assert terms.pop("velocity_offset") == pytest.approx(0.3 * 2.0)
    assert not any(terms.values())


@pytest.mark.multiprocess
def test_the_command(tmp_path):
    file = random_weights(tmp_path / "w.msgpack")

    names = ("onnx", "stablehlo", "jax_export")
    forms = [f"--{name}={tmp_path}/{name}" for name in names]
    succeeded("rcirl_jax", "export", f"--weights={file}", *forms)
    assert all((tmp_path / name).stat().st_size > 1000 for name in names)
    weights = open_reward(str(file))
    for name in names:
        beside = json.loads((tmp_path / f"{name}.json").read_text())
        assert (beside["form"], beside["weights_sha256"]) == (name, weights.sha256)
        assert beside["features"] == list(weights.names)
        assert beside["made_by"]["flags"]["weights"] == str(file)
        assert len(beside["made_by"]["code_sha256"]) == 64
