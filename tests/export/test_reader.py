"""The reader: stands alone, refuses every damaged file with one line, scores."""

import ast
import hashlib
import subprocess
import sys
from pathlib import Path
from typing import cast

import msgpack
import msgpack.fallback
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rcirl_jax.errors import InputError
from rcirl_jax.export import (
    WeightsError,
    decode_weights,
    load_weights,
    pack,
    reader,
    save,
)
from tests.helpers.weights_files import (
    ACTIVATIONS,
    example_samples,
    example_weights,
    loop_gain,
    packed,
)

VALID = packed()
ANCHORED = packed(anchored=True)
CASES = max(300, settings().max_examples)  # the nightly profile asks for more
ALLOWED = {"numpy", "msgpack"}


def dump(value) -> bytes:
    return cast("bytes", msgpack.packb(value))


def array(*shape, fill=1.0):
    data = np.full(shape, fill, "<f4").tobytes()
    return {"shape": list(shape), "dtype": "<f4", "data": data}


def falling(*shape):
    """An array n, n - 1, ..., 1."""
    size = int(np.prod(shape))
    return {**array(*shape), "data": np.arange(size, 0, -1, "<f4").tobytes()}


def sealed(body, /, **outer):
    """A file with this body and the right hash."""
    body = body if isinstance(body, bytes) else dump(body)
    digest = hashlib.sha256(body).hexdigest()
    head = {"magic": "RCIRLW", "schema_version": 1, "body": body, "sha256": digest}
    return dump({**head, **outer})


def body_of(data=VALID):
    return msgpack.unpackb(msgpack.unpackb(data)["body"])


def tampered(path, value, data=VALID):
    """The valid file with one field of its body replaced, and hashed again."""
    body = body_of(data)
    *way, last = path
    place = body
    for step in way:
        place = place[step]
    place[last] = value
    return sealed(body, schema_version=msgpack.unpackb(data)["schema_version"])


def refusal(data):
    with pytest.raises(WeightsError) as caught:
        decode_weights(data, "w.msgpack")
    message = str(caught.value)
    assert message.startswith("w.msgpack: ")
    assert message.isprintable()
    assert len(message) < 400
    return message.removeprefix("w.msgpack: ")


# ------------------------------------------------------------------ stands alone

SCRIPT = """
import importlib.util, sys

class Block:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {"jax", "jaxlib", "flax", "rcirl_jax", "scipy"}:
            raise ImportError("blocked: " + name)

sys.meta_path.insert(0, Block())
spec = importlib.util.spec_from_file_location("planner_reader", sys.argv[1])
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
reward = module.load_weights(sys.argv[2])
import numpy as np
size = (2, len(reward.times), len(reward.names))
print(*(f"{value:.9g}" for value in reward.value(np.full(size, 0.25))))
try:
    module.load_weights(sys.argv[2] + ".missing")
except module.WeightsError as error:
    print(error)
"""


def test_runs_alone_as_a_copied_file(tmp_path):
    copy = tmp_path / "copied.py"
    copy.write_bytes(Path(reader.__file__).read_bytes())
    weights = example_weights()
    path = tmp_path / "weights.msgpack"
    reward = save(path, weights, *example_samples(weights))
    done = subprocess.run(
        [sys.executable, "-I", "-W", "error", "-c", SCRIPT, str(copy), str(path)],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
    )
    values, missing = done.stdout.splitlines()
    expected = reward.value(np.full((2, 4, 3), 0.25))
    np.testing.assert_allclose(
        [float(text) for text in values.split()], expected, rtol=1e-6, atol=1e-6
    )
    assert missing == f"{path}.missing: path: no such file: expected a file"


def test_imports_are_numpy_msgpack_and_the_standard_library():
    tree = ast.parse(Path(reader.__file__).read_text(encoding="utf-8"))
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0
            names.add(str(node.module).partition(".")[0])
    assert names - set(sys.stdlib_module_names) == ALLOWED


# ------------------------------------------------------------------------ scores


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_value_is_the_sum_over_valid_times(activation):
    weights = example_weights(activation=activation)
    features, valid, values = example_samples(weights, count=6, seed=4)
    reward = decode_weights(packed(activation=activation))
    np.testing.assert_allclose(
        reward.value(features, valid), values, rtol=1e-5, atol=1e-5
    )
    alone = [reward.value(features, valid & (np.arange(4) == t)) for t in range(4)]
    np.testing.assert_allclose(np.sum(alone, axis=0), values, rtol=1e-5, atol=1e-5)


def test_leading_axes_and_the_shared_mask():
    weights = example_weights()
    reward = decode_weights(VALID)
    features, valid, _ = example_samples(weights, count=6)
    one_by_one = [reward.value(item) for item in features]
    assert all(item.shape == () for item in one_by_one)
    folded = reward.value(features.reshape(2, 3, 4, 3))
    np.testing.assert_allclose(folded.ravel(), one_by_one, rtol=1e-5, atol=1e-6)
    shared = reward.value(features, valid[0])
    each = reward.value(features, np.broadcast_to(valid[0], (6, 4)))
    np.testing.assert_array_equal(shared, each)
    as_numbers = reward.value(features, valid[0].astype(np.float32))
    np.testing.assert_array_equal(as_numbers, shared)
    assert reward.value(features[:0]).shape == (0,)
    all_valid = reward.value(features, np.ones(4, bool))
    np.testing.assert_array_equal(all_valid, reward.value(features))


def test_padding_may_be_nan_but_a_valid_time_may_not():
    reward = decode_weights(VALID)
    features, _, _ = example_samples(example_weights(), count=3)
    valid = np.array([True, True, False, True])
    expected = reward.value(features, valid)
    features[:, 2] = np.nan
    np.testing.assert_array_equal(reward.value(features, valid), expected)
    with pytest.raises(WeightsError, match=r"weights: value\[0\]: not finite"):
        reward.value(features)
    features[:2, 2] = 0.0
    with pytest.raises(WeightsError, match=r"value\[2\]: not finite: expected finite"):
        reward.value(features)


def test_infinite_features_are_clipped():
    reward = decode_weights(VALID)
    top = np.broadcast_to(reward.upper, (4, 3))
    np.testing.assert_array_equal(
        reward.value(np.full((4, 3), np.inf)), reward.value(top)
    )


@pytest.mark.parametrize(
    ("features", "time_valid", "message"),
    [
        (np.zeros((4, 2)), None, r"features: float64 \(4, 2\): expected numbers of"),
        (np.zeros(3), None, r"shape \[\.\.\., 4, 3\]"),
        (np.zeros((4, 3), complex), None, "features: complex128"),
        ([["a"] * 3] * 4, None, "features: <U1"),
        ([[1.0], [1.0, 2.0]], None, "features: setting an array element"),
        (np.zeros((4, 3)), np.ones(5), r"time_valid: .* expected 0 and 1"),
        (np.zeros((4, 3)), np.full(4, 0.5), "time_valid: float64 of other values"),
        (np.zeros((4, 3)), np.array(["a"] * 4), "time_valid: <U1 of other values"),
        (np.zeros((4, 3)), np.ones((2, 4)), "time_valid"),
    ],
)
def test_wrong_arguments_are_one_line(features, time_valid, message):
    with pytest.raises(WeightsError, match=message):
        decode_weights(VALID).value(features, time_valid)


def test_the_total_is_the_incumbents_value_and_the_gained_one():
    weights = example_weights(anchored=True)
    features, valid, values = example_samples(weights, count=6, seed=4)
    reward = decode_weights(ANCHORED)
    gains = reward.gain(features)
    assert gains.dtype == np.float32
    expected = [loop_gain(weights.anchor, one[0]) for one in features]
    np.testing.assert_allclose(gains, expected, rtol=1e-6)
    assert np.ptp(gains) > 0.1
    own = np.linspace(-3.0, 50.0, 6)
    total = reward.total(features, own, valid)
    assert total.dtype == np.float32
    np.testing.assert_allclose(total, own + np.multiply(expected, values), atol=2e-5)
    folded = reward.total(features.reshape(2, 3, 4, 3), own.reshape(2, 3))
    np.testing.assert_array_equal(folded.ravel(), reward.total(features, own))
    np.testing.assert_array_equal(reward.value(features, valid[0]).shape, (6,))
    plain = decode_weights(packed(seen=True))
    np.testing.assert_array_equal(reward.value(features), plain.value(features))
    assert reward.total(features[0], np.ones(())).shape == ()


def test_a_gain_needs_the_features_that_matter_to_it():
    reward = decode_weights(ANCHORED)
    features, valid, _ = example_samples(example_weights(anchored=True), count=3)
    expected = reward.gain(features)
    features[:, 0, 0] = np.nan  # its row of the kernel is 0
    features[:, 1:] = np.nan
    np.testing.assert_array_equal(reward.gain(features), expected)
    features[1, 0, 2] = np.inf  # clipped
    assert reward.gain(features)[1] != expected[1]
    features[1, 0, 2] = np.nan
    with pytest.raises(
        WeightsError, match=r"weights: gain\[1\]: not finite: expected f"
    ):
        reward.gain(features)
    with pytest.raises(WeightsError, match=r"features: float32 \(3, 3, 3\): expected"):
        reward.gain(features[:, 1:])
    with pytest.raises(WeightsError, match="anchor: missing: expected an anchored"):
        decode_weights(VALID).gain(features)
    clean, valid, _ = example_samples(example_weights(anchored=True), count=3)
    for own, mask, message in (
        (
            np.zeros(()),
            np.arange(4) > 0,
            "time_valid: 0 at the first time: expected 1: gains",
        ),
        (np.zeros(2), valid, r"incumbent: .*: expected numbers of shape \(3,\)"),
        (np.array(["a"] * 3), valid, "incumbent: <U1: expected numbers"),
        (
            np.array([0.0, np.nan, 0.0]),
            valid,
            r"total\[1\]: not finite: expected finite values",
        ),
        (np.array(3.5e38), valid, r"total\[0\]: not finite"),
    ):
        with pytest.raises(WeightsError, match=message):
            reward.total(clean, own, mask)
    clean[2, 0, 1] = np.nan
    with pytest.raises(WeightsError, match=r"gain\[2\]: not finite"):
        reward.total(clean, np.zeros(3))


def test_check_features_names_the_first_mismatch():
    reward = decode_weights(VALID)
    names, units = list(reward.names), list(reward.units)
    reward.check_features(names, units)
    swapped = [names[0], names[2], names[1]]
    with pytest.raises(WeightsError, match=r"features\[1\]: \('feature2', 'm/s²'\): e"):
        reward.check_features(swapped, units)
    with pytest.raises(
        WeightsError, match=r"features\[0\]: .*'ft'.*\('feature0', 'm'\)"
    ):
        reward.check_features(names, ["ft", *units[1:]])
    with pytest.raises(
        WeightsError, match=r"features\[2\]: none: expected \('feature2"
    ):
        reward.check_features(names[:2], units[:2])
    with pytest.raises(
        WeightsError, match=r"features\[3\]: \('x', 'm'\): expected none"
    ):
        reward.check_features([*names, "x"], [*units, "m"])
    with pytest.raises(WeightsError, match=r"features\[2\]: \('feature2', None\)"):
        reward.check_features(names, units[:2])


# ----------------------------------------------------------------------- refuses


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (["preset"], 5, "preset: 5: expected a text"),
        (["preset"], "x" * 65, "preset: xxx"),
        (["features"], {}, "features: dict of 0: expected a list of 1 to 64"),
        (["features"], [1], "features[0]: 1: expected a map"),
        (["features"], [{}] * 65, "features: list of 65"),
        (["features", 1, "name"], "feature0", "features[1].name: feature0: expected a"),
        (["features", 1, "unit"], "", "features[1].unit: : expected a text"),
        (["features", 1, "none_value"], True, "none_value: True: expected a finite"),
        (["features", 1, "none_value"], float("inf"), "none_value: inf"),
        (["features", 1, "extra"], 1, "features[1].extra: unknown: expected the keys"),
        (["normaliser", "scale"], array(3, fill=0.0), "normaliser.scale[0]: 0"),
        (["normaliser", "scale"], array(3, fill=-1.0), "normaliser.scale[0]: -1"),
        (["normaliser", "scale"], array(3, fill=np.nan), "normaliser.scale[0]: nan"),
        (["normaliser", "upper"], array(3, fill=-99.0), "normaliser.lower[0]"),
        (["normaliser", "location"], array(2), "location.shape: [2]: expected [3]"),
        (["times"], array(4), "times[0]: 1: expected 0 s first"),
        (["times"], array(4, fill=0.0), "times[0]: 0: expected increasing"),
        (["times"], array(257), "times.shape: [257]: expected"),
        (["times"], array(0), "times.shape: [0]: expected"),
        (["times"], [0.0, 1.0], "times: list of 2: expected a map"),
        (["gamma"], array(3), "gamma.shape: [3]: expected [4]"),
        (["gamma"], array(4, 1), "gamma.shape: list of 2: expected [4]"),
        (["gamma", "shape"], "four", "gamma.shape: four: expected [4]"),
        (["gamma", "shape"], [4.0], "gamma.shape: [4.0]: expected [4]"),
        (["gamma", "shape"], [2**63], "gamma.shape: [9223372036854775808]"),
        (["gamma", "dtype"], "<f8", "gamma.dtype: <f8: expected <f4"),
        (["gamma", "dtype"], ">f4", "gamma.dtype: >f4: expected <f4"),
        (["gamma", "dtype"], "O", "gamma.dtype: O: expected <f4"),
        (["gamma", "data"], b"\0" * 15, "gamma.data: bytes of 15: expected 16 bytes"),
        (["gamma", "data"], "x" * 16, "gamma.data: xxxxxxxxxxxxxxxx: expected 16"),
        (["gamma"], array(4, fill=np.inf), "gamma[0]: inf: expected finite numbers"),
        (["layers"], [], "layers: list of 0: expected a list of 1 to 16"),
        (["layers"], [{}] * 17, "layers: list of 17"),
        (["layers", 0, "kernel"], array(2, 5), "kernel.shape: [2, 5]: expected [3, "),
        (["layers", 1, "kernel"], array(4, 1), "layers[1].kernel.shape: [4, 1]: expe"),
        (["layers", 1], {"kernel": array(5, 2), "bias": array(2)}, "expected 1 output"),
        (["layers", 0, "kernel"], array(3, 4097), "kernel.shape: [3, 4097]: expected"),
        (["layers", 0, "bias"], array(4), "layers[0].bias.shape: [4]: expected [5]"),
        (["layers", 0, "bias"], None, "layers[0].bias: None: expected a map"),
        (["activation"], "gelu", "activation: gelu: expected one of tanh, relu"),
        (["activation"], ["tanh"], "activation: list of 1"),
        (["leaky_slope"], float("nan"), "leaky_slope: nan: expected a finite number"),
        (["loss"], {"name": "rank"}, "loss.leaky_rate: missing"),
        (["loss", "leaky_rate"], "a", "loss.leaky_rate: a: expected a finite number"),
        (["provenance"], [], "provenance: list of 0: expected a map"),
        (["provenance", "x"], b"1", "provenance: bytes of 1: expected texts, finite"),
        (["provenance", "x"], float("inf"), "provenance: inf"),
        (["provenance", "x"], [[[[[[[[]]]]]]]], "provenance: list of 0: expected"),
        (["provenance", "x"], [0] * 4097, "exceeds max_array_len"),
        (["provenance", "x"], [[0] * 4000] * 17, "too many entries: expected at most"),
        (["provenance", "x"], "x" * 70_000, "exceeds max_str_len"),
        (["provenance", "x"], msgpack.ExtType(5, b"a"), "exceeds max_ext_len"),
        (["provenance", "x"], msgpack.Timestamp(1), "exceeds max_ext_len"),
        (["provenance", b"x"], 1, "a key used twice or not a text"),
        (["samples"], {}, "samples.features: missing"),
        (["samples", "value"], array(4, fill=99.0), "samples[0]: scored"),
        (["samples", "value"], array(257), "samples.value.shape: [257]"),
        (["samples", "valid"], array(4, 4, fill=0.5), "samples.valid[0, 0]: 0.5"),
        (["samples", "features"], array(4, 4, 2), "features.shape: [4, 4, 2]: expe"),
        (["extra"], 1, "body.extra: unknown: expected the keys preset"),
    ],
)
def test_a_wrong_field_is_named(path, value, message):
    assert message in refusal(tampered(path, value))


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ([], None, "anchor: None: expected a map"),
        ([], {}, "anchor.incumbent: missing: expected the keys incumbent, low, high"),
        (["extra"], 1, "anchor.extra: unknown: expected the keys incumbent, low, high"),
        (["incumbent"], 5, "anchor.incumbent: 5: expected a text"),
        (["incumbent"], "", "anchor.incumbent: : expected a text of 1 to 64"),
        (["incumbent"], "x" * 65, "anchor.incumbent: xxx"),
        (["low"], -0.5, "anchor.low: -0.5: expected at least 0"),
        (["low"], True, "anchor.low: True: expected a finite number"),
        (["low"], 2, "anchor.high: 1.5: expected at least low, 2"),
        (["low"], 0.2, "anchor.gain[0]: "),
        (["high"], float("inf"), "anchor.high: inf: expected a finite number"),
        (["high"], float("nan"), "anchor.high: nan: expected a finite number"),
        (["high"], 1e300, "anchor.gain[0]: "),
        (["high"], None, "anchor.high: None: expected a finite number"),
        (["location"], array(2), "anchor.location.shape: [2]: expected [3]"),
        (["location"], array(3, fill=np.inf), "anchor.location[0]: inf: expected fin"),
        (["location", "data"], b"\0" * 11, "anchor.location.data: bytes of 11"),
        (["scale"], array(3, fill=0.0), "anchor.scale[0]: 0: expected over 0"),
        (["scale"], array(3, fill=-1.0), "anchor.scale[0]: -1: expected over 0"),
        (["scale"], array(3, 1), "anchor.scale.shape: list of 2: expected [3]"),
        (["kernel"], array(4, 3), "anchor.kernel.shape: [4, 3]: expected [3, "),
        (["kernel"], array(3, 0), "anchor.kernel.shape: [3, 0]: expected [3, "),
        (["kernel"], array(3, 4097), "anchor.kernel.shape: [3, 4097]: expected [3, "),
        (["kernel"], array(3, 4), "anchor.gain[0]: "),
        (["kernel"], array(3, 5), "anchor.bias.shape: [4]: expected [5]"),
        (["kernel", "dtype"], "<f8", "anchor.kernel.dtype: <f8: expected <f4"),
        (["bias"], array(5), "anchor.bias.shape: [5]: expected [4]"),
        (["bias"], array(4, fill=np.nan), "anchor.bias[0]: nan: expected finite"),
        (["out"], array(1), "anchor.out.shape: [1]: expected [4]"),
        (["out"], array(4, fill=3e38), "anchor.gain["),
        (["offset"], array(2), "anchor.offset.shape: [2]: expected [1]"),
        (["offset"], 0.5, "anchor.offset: 0.5: expected a map"),
        (["gain"], array(3), "anchor.gain.shape: [3]: expected [4]"),
        (["gain"], None, "anchor.gain: None: expected a map"),
        (["gain"], array(4, fill=np.nan), "anchor.gain[0]: nan: expected finite"),
        (["gain"], array(4, fill=9.0), "anchor.gain[0]: 9: expected the gain of the"),
    ],
)
def test_a_wrong_anchor_is_named(path, value, message):
    assert message in refusal(tampered(["anchor", *path], value, ANCHORED))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "size: 0 bytes or more: expected 1 to 67108864 bytes"),
        (VALID[:-1], "file: ValueError Unpack failed: incomplete input: expected one"),
        (VALID + b"\0", "file: ExtraData"),
        (VALID + VALID, "file: ExtraData"),
        (b"not a weights file", "file: ExtraData"),
        (b"\xc1", "file: FormatError"),
        (b"\x91" * 5000, "file: "),
        (b"\xdd\xff\xff\xff\xff", "file: ValueError 4294967295 exceeds max_array_len"),
        (dump([1]), "magic: missing or another: expected 'RCIRLW'"),
        (dump({"a": 1}), "magic: missing or another"),
        (dump({1: 1}), "file: ValueError int is not allowed for map key"),
        (b"\x82\xa1a\x01\xa1a\x02", "file: a key used twice"),
        (sealed(body_of(), magic="RCIRLX"), "magic: missing or another"),
        (
            sealed(body_of(), schema_version=5),
            "schema_version: 5: expected 1, 2, 3 or 4, all this reader supports",
        ),
        (sealed(body_of(), schema_version=3), "body.seen: missing: expected the keys"),
        (sealed({**body_of(), "seen": array(2, 3)}), "body.seen: unknown: expected"),
        (
            sealed({**body_of(), "seen": array(1, 3)}, schema_version=3),
            "seen.shape: [1, 3]: expected [2, 3]",
        ),
        (
            sealed({**body_of(), "seen": falling(2, 3)}, schema_version=3),
            "seen[0, 0]: 6: expected at most the highest",
        ),
        (
            sealed({**body_of(), "seen": array(2, 3)}, schema_version=4),
            "body.anchor: missing: expected the keys",
        ),
        (sealed(body_of(), schema_version=4), "body.seen: missing: expected the keys"),
        (
            sealed({**body_of(), "seen": array(2, 3), "anchor": {}}, schema_version=3),
            "body.anchor: unknown: expected the keys",
        ),
        (
            tampered(["samples", "valid"], array(4, 4, fill=0.0), ANCHORED),
            "samples.valid[0, 0]: 0: expected 1 at the first time",
        ),
        # whatever a later version adds, its number is what is named
        (
            sealed(b"later", schema_version=5, magic="RCIRLW", signature="x"),
            "schema_version: 5: expected 1, 2, 3 or 4, all this reader supports",
        ),
        (
            sealed(body_of(), schema_version=2),
            "body.context: missing: expected the keys",
        ),
        (
            sealed({**body_of(), "context": array(2, 2)}),
            "body.context: unknown: expected the keys",
        ),
        (
            sealed({**body_of(), "context": array(1, 2)}, schema_version=2),
            "context.shape: [1, 2]: expected",
        ),
        (sealed(body_of(), schema_version=True), "schema_version: True: expected 1, 2"),
        (sealed(body_of(), extra=1), "file.extra: unknown"),
        (sealed(body_of(), sha256="0" * 64), "sha256: "),
        (sealed(body_of(), sha256=5), "expected 5; the file is damaged"),
        (sealed(body_of(), body="text"), "sha256: no bytes"),
        (sealed(body_of(), body="text", sha256="no bytes"), "sha256: no bytes"),
        (sealed(b""), "body: ValueError"),
        (sealed(dump(body_of()) + b"\0"), "body: ExtraData"),
        (sealed([1]), "body: list of 1: expected a map"),
    ],
)
def test_a_wrong_file_is_refused(data, message):
    assert message in refusal(data)


def test_a_verified_file_must_score_to_one_part_in_a_hundred_thousand():
    weights = example_weights()
    value = example_samples(weights)[2]
    for shift, refused in ((3e-6, False), (3e-5, True)):
        moved = value + shift * np.maximum(1.0, np.abs(value))
        data = tampered(["samples", "value", "data"], moved.astype("<f4").tobytes())
        if refused:
            assert "samples[0]: scored" in refusal(data)
        else:
            decode_weights(data)


def test_a_gain_must_be_met_to_one_part_in_a_hundred_thousand():
    box = body_of(ANCHORED)["anchor"]["gain"]
    gains = np.frombuffer(box["data"], "<f4").astype(float)
    for shift, refused in ((3e-6, False), (3e-5, True)):
        moved = gains + shift * np.maximum(1.0, gains)
        path = ["anchor", "gain", "data"]
        data = tampered(path, moved.astype("<f4").tobytes(), ANCHORED)
        if refused:
            assert "anchor.gain[0]: " in refusal(data)
        else:
            decode_weights(data)


def test_a_weight_changed_and_hashed_again_is_caught_by_the_samples():
    kernel = body_of()["layers"][1]["kernel"]["data"]
    moved = np.frombuffer(kernel, "<f4") * np.float32(1.001)
    data = tampered(["layers", 1, "kernel", "data"], moved.tobytes())
    assert refusal(data).startswith("samples[")


def test_huge_weights_are_refused_without_a_warning():
    data = tampered(["gamma"], array(4, fill=3e38))
    assert refusal(data).startswith("samples[")


def test_places_that_are_no_file(tmp_path):
    for place in (tmp_path, tmp_path / "missing", "", "nul\0byte", 1.5, None):
        with pytest.raises(WeightsError, match="expected a file"):
            load_weights(place)  # pyright: ignore
    odd = tmp_path / "two\nlines\x1b.msgpack"
    odd.write_bytes(b"")
    with pytest.raises(WeightsError, match=r"two lines\?\.msgpack: size: 0 bytes"):
        load_weights(odd)
    oversize = tmp_path / "oversize"
    with oversize.open("wb") as stream:
        stream.truncate(reader.MAX_FILE_BYTES + 1)
    with pytest.raises(WeightsError, match="oversize: size: 67108865 bytes or more"):
        load_weights(str(oversize))


# -------------------------------------------------------------------------- fuzz


@settings(max_examples=CASES)
@given(st.binary(max_size=200))
def test_random_bytes_are_refused(data):
    refusal(data)
    refusal(VALID[:60] + data)


@settings(max_examples=CASES)
@given(st.sets(st.integers(0, 8 * len(VALID) - 1), min_size=1, max_size=8))
def test_flipped_bits_are_refused(bits):
    refusal(flipped(VALID, bits))


def test_every_single_bit_outside_the_body_is_guarded():
    body = msgpack.unpackb(VALID)["body"]
    start = VALID.index(body)
    places = [*range(start), *range(start + len(body), len(VALID))]
    for bit in (8 * place + offset for place in places for offset in range(8)):
        refusal(flipped(VALID, {bit}))


@settings(max_examples=CASES)
@given(st.integers(0, len(VALID) - 1))
def test_a_cut_file_is_refused(length):
    refusal(VALID[:length])


def only_weights_errors(data):
    try:
        reward = decode_weights(data)
        # Harmless for the samples, such as another name: it scores, or says why not.
        zeros = np.zeros((len(reward.times), len(reward.names)))
        value = reward.value(zeros)
        if reward.anchor is not None:
            value = reward.total(zeros, value)
    except WeightsError:
        return
    assert np.isfinite(value)


@settings(max_examples=CASES)
@given(st.data())
def test_a_body_changed_and_hashed_again_is_refused_or_works(data):
    body = msgpack.unpackb(VALID)["body"]
    bits = data.draw(st.sets(st.integers(0, 8 * len(body) - 1), min_size=1, max_size=4))
    only_weights_errors(sealed(flipped(body, bits)))


LEAVES = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats()
OBJECTS = st.recursive(
    LEAVES | st.text(max_size=5) | st.binary(max_size=20),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(["shape", "dtype", "data", "name", "kernel", "x"]), inner
        )
    ),
    max_leaves=8,
)


def places(value, way=()):
    """Every path into the body."""
    items = enumerate(value) if isinstance(value, list) else value.items()
    for key, item in items:
        yield (*way, key)
        if isinstance(item, dict | list):
            yield from places(item, (*way, key))


@settings(max_examples=CASES)
@given(st.sampled_from(list(places(body_of()))), OBJECTS)
def test_any_object_in_any_place_is_refused_or_works(path, value):
    only_weights_errors(tampered(path, value))


@settings(max_examples=CASES)
@given(st.sampled_from(list(places(body_of(ANCHORED)["anchor"]))), OBJECTS)
def test_any_object_in_any_place_of_an_anchor_is_refused_or_works(path, value):
    only_weights_errors(tampered(["anchor", *path], value, ANCHORED))


def test_the_pure_python_msgpack_refuses_the_same(monkeypatch):
    """msgpack without its C extension (MSGPACK_PUREPYTHON) raises other types."""
    monkeypatch.setattr(msgpack, "unpackb", msgpack.fallback.unpackb)
    decode_weights(VALID)
    rng = np.random.default_rng(0)
    for _ in range(150):
        refusal(rng.bytes(int(rng.integers(1, 80))))
        refusal(VALID[: rng.integers(0, len(VALID))])
        refusal(flipped(VALID, set(rng.integers(0, 8 * len(VALID), 3).tolist())))
    for data in (b"\x91" * 5000, b"\xc1", VALID + b"\0", b"\xd5\x05\0\0"):
        refusal(data)


def flipped(data, bits):
    changed = bytearray(data)
    for bit in bits:
        changed[bit // 8] ^= 1 << (bit % 8)
    return bytes(changed)


def test_a_conditioned_reward_needs_the_first_time():
    weights = example_weights(by_context=True)
    features, valid, values = example_samples(weights)
    reward = decode_weights(pack(weights, features, valid, values))
    late = np.array(valid)
    late[1, 0] = False
    with pytest.raises(WeightsError, match=r"time_valid: 0 at the first time: exp"):
        reward.value(features, late)
    with pytest.raises(InputError, match=r"samples\.valid\[1, 0\]: 0: expected 1 at"):
        pack(weights, features, late, values)
