"""The reader: stands alone, refuses every damaged file with one line, scores."""

import ast
import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rcirl_jax.export import (
    WeightsError,
    decode_weights,
    guard,
    load_weights,
    reader,
)
from tests.export.wrong import (
    FIELDS,
    FILES,
    GATED,
    VALID,
    WITH_PRIOR,
    body_of,
    flipped,
    tampered,
)
from tests.helpers.weights_files import (
    example_samples,
    example_weights,
    packed,
)

CASES = max(300, settings().max_examples)  # the nightly profile asks for more
ALLOWED = {"numpy", "msgpack"}


def refusal(data):
    with pytest.raises(WeightsError) as caught:
        decode_weights(data, "w.msgpack")
    message = str(caught.value)
    assert message.startswith("w.msgpack: ")
    assert message.isprintable()
    assert len(message) < 400
    return message.removeprefix("w.msgpack: ")


@pytest.mark.parametrize("module", [reader, guard])
def test_imports_are_numpy_msgpack_and_the_standard_library(module):
    tree, names = ast.parse(Path(module.__file__).read_text(encoding="utf-8")), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0
            names.add(str(node.module).partition(".")[0])
    assert names - set(sys.stdlib_module_names) <= ALLOWED


# ------------------------------------------------------------------------ scores


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
    top = np.broadcast_to(reward.upper, (4, 3))  # infinite features are clipped
    found = reward.value(np.full((4, 3), np.inf))
    np.testing.assert_array_equal(found, reward.value(top))


@pytest.mark.parametrize(
    ("features", "time_valid", "message"),
    [
        (np.zeros((4, 2)), None, r"features: float64 \(4, 2\): expected numbers of"),
        (np.zeros((4, 3)), np.ones(5), r"time_valid: .* expected 0 and 1"),
        (np.zeros((4, 3)), np.full(4, 0.5), "time_valid: float64 of other values"),
    ],
)
def test_wrong_arguments_are_one_line(features, time_valid, message):
    with pytest.raises(WeightsError, match=message):
        decode_weights(VALID).value(features, time_valid)


def test_the_total_is_the_incumbents_value_and_the_gained_one():
    weights = example_weights(with_prior=True)
    features, valid, values = example_samples(weights, count=6, seed=4)
    reward = decode_weights(WITH_PRIOR)
    own = np.linspace(-3.0, 50.0, 6)
    total = reward.total(features, own, valid)
    assert total.dtype == np.float32
    np.testing.assert_allclose(total, own + 1.5 * values, atol=2e-5)
    folded = reward.total(features.reshape(2, 3, 4, 3), own.reshape(2, 3))
    np.testing.assert_array_equal(folded.ravel(), reward.total(features, own))
    np.testing.assert_array_equal(reward.value(features, valid[0]).shape, (6,))
    plain = decode_weights(packed())
    np.testing.assert_array_equal(reward.value(features), plain.value(features))
    assert reward.total(features[0], np.ones(())).shape == ()


def test_v_counts_only_where_it_knows_the_scene():
    """Feature 1 never varied in training: there it has no effect, and it tells."""
    weights = example_weights(with_prior=True)
    features, valid, _ = example_samples(weights, count=8, seed=4)
    empty = [x.copy() for x in (weights.lower, weights.upper)]
    for end in empty:
        end[1] = weights.location[1]
    lower, upper = empty
    reward = dataclasses.replace(weights, lower=lower, upper=upper)
    shares = np.array([0.0, -0.99, 1.01, -1.01, 1e9, 0.5, np.inf, 1.01], np.float32)
    features[:, 0, 1] = weights.location[1] + shares * weights.scale[1]
    valid[:, 0] = True
    valid[7] = [False, True, True, True]  # what is not valid may be anything
    knows = np.array([1, 1, 0, 0, 0, 1, 0, 1])
    own = np.linspace(-3.0, 50.0, 8)
    values = reward.value(features, valid)
    assert np.all(values != 0.0)
    found = reward.total(features, own, valid)
    np.testing.assert_allclose(found, own + 1.5 * knows * values, rtol=1e-6)
    knows[7] = 0
    values, found = reward.value(features), reward.total(features, own)
    np.testing.assert_allclose(found, own + 1.5 * knows * values, rtol=1e-6)


@pytest.mark.parametrize(
    ("own", "message"),
    [
        (np.zeros(2), r"incumbent: .*: expected numbers of shape \(3,\)"),
        (np.array([0.0, np.nan, 0.0]), r"total\[1\]: not finite: expected fin"),
        (np.array(3.5e38), r"total\[0\]: not finite"),
    ],
)
def test_what_has_no_total_is_one_line(own, message):
    features, valid, _ = example_samples(example_weights(with_prior=True), count=3)
    with pytest.raises(WeightsError, match=message):
        decode_weights(WITH_PRIOR).total(features, own, valid)


@pytest.mark.parametrize(
    ("names", "units", "message"),
    [
        ("021", "m 1 1", r"features\[1\]: \('feature2', 'm/s²'\): e"),
        ("012", "ft 1 1", r"features\[0\]: .*'ft'.*\('feature0', 'm'\)"),
        ("01", "m 1", r"features\[2\]: none: expected \('feature2"),
    ],
)
def test_check_features_names_the_first_mismatch(names, units, message):
    reward = decode_weights(VALID)
    reward.check_features(reward.names, reward.units)
    made = [f"feature{number}" for number in names]
    with pytest.raises(WeightsError, match=message):
        reward.check_features(made, units.replace("1", "m/s²").split())


# ----------------------------------------------------------------------- refuses


@pytest.mark.parametrize(("path", "value", "message"), FIELDS)
def test_a_wrong_field_is_named(path, value, message):
    assert message in refusal(tampered(path, value))


@pytest.mark.parametrize(("data", "message"), FILES)
def test_a_wrong_file_is_refused(data, message):
    assert message in refusal(data)


def test_samples_are_met_to_one_part_in_a_hundred_thousand():
    path = ["samples", "value", "data"]
    told = np.frombuffer(body_of(VALID)["samples"]["value"]["data"], "<f4").astype(
        float
    )
    for shift, refused in ((3e-6, False), (3e-5, True)):
        moved = told + shift * np.maximum(1.0, np.abs(told))
        changed = tampered(path, moved.astype("<f4").tobytes())
        if refused:
            assert "samples[0]: scored" in refusal(changed)
        else:
            decode_weights(changed)


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
@given(
    data=st.binary(max_size=200),
    bits=st.sets(st.integers(0, 8 * len(VALID) - 1), min_size=1, max_size=8),
    length=st.integers(0, len(VALID) - 1),
)
def test_random_flipped_and_cut_bytes_are_refused(data, bits, length):
    for damaged in (data, VALID[:60] + data, flipped(VALID, bits), VALID[:length]):
        refusal(damaged)


def only_weights_errors(data):
    try:
        reward = decode_weights(data)
        # Harmless for the samples, such as another name: it scores, or says why not.
        zeros = np.zeros((len(reward.times), len(reward.names)))
        value = reward.value(zeros)
        if reward.prior_cost is not None:
            value = reward.total(zeros, value)
    except WeightsError:
        return
    assert np.isfinite(value)


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


PLACES = [(VALID, way) for way in places(body_of())]
PLACES += [
    (WITH_PRIOR, ("prior_cost", *way))
    for way in places(body_of(WITH_PRIOR)["prior_cost"])
]


@settings(max_examples=2 * CASES)
@given(st.sampled_from(PLACES), OBJECTS)
def test_any_object_in_any_place_is_refused_or_works(place, value):
    data, path = place
    only_weights_errors(tampered(path, value, data))


def test_scene_gating_needs_the_first_time():
    features, valid, _ = example_samples(example_weights(scene_gating=True))
    valid[1, 0] = False
    with pytest.raises(WeightsError, match=r"time_valid: 0 at the first time: exp"):
        decode_weights(GATED).value(features, valid)
