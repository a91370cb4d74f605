"""The C++ reader: scores as Python and JAX do, refuses what the Python reader refuses.

Built with the sanitizers, so a read past the end of any file here is a failure; an
allocation over 256 MB too. Needs cmake, a C++17 compiler and msgpack-c's C headers.
"""

import os
import shutil
import struct

import msgpack
import numpy as np
import pytest

from rcirl_jax.export import Guard, WeightsError, decode_weights, load_weights, save
from tests.export import test_weights, wrong
from tests.export.test_reader import refusal
from tests.helpers.weights_files import (
    example_samples,
    example_weights,
    packed,
    trained_network,
)
from tests.onboard.programs import ONBOARD, built, configured, run

VALID = packed(features=2, times=3, hidden=(4,))
GATED = packed(features=2, times=3, hidden=(4,), scene_gating=True)
WITH_PRIOR = packed(
    features=2, times=3, hidden=(4,), scene_gating=True, with_prior=True
)


@pytest.fixture(scope="module")
def programs():
    return built("reader", "choose")


def verdicts(programs, files, folder):
    """The C++ reader's line for each file: "ok" or its refusal."""
    batch = folder / "batch"
    batch.write_bytes(b"".join(struct.pack("<Q", len(data)) + data for data in files))
    options = {**os.environ, "ASAN_OPTIONS": "max_allocation_size_mb=256"}
    lines = run(programs / "reader", "check", batch, env=options).decode().splitlines()
    assert len(lines) == len(files)
    return lines


def is_valid(data):
    try:
        decode_weights(data)
    except WeightsError:
        return False
    return True


def scores(programs, kind, path, *arrays):
    """What the C++ reader makes of arrays, float32."""
    files = []
    for number, array in enumerate(arrays):
        files.append(path.with_name(str(number)))
        as_bytes = np.uint8 if array.dtype == bool else np.float32
        array.astype(as_bytes).tofile(files[-1])
    return np.frombuffer(run(programs / "reader", kind, path, *files), np.float32)


def assert_close(found, expected):
    assert np.all(np.abs(found - expected) <= 1e-5 * np.maximum(1.0, np.abs(expected)))


@pytest.mark.parametrize(
    ("hidden", "activation", "scene_gating"),
    [
        ((), "identity", False),
        ((15,), "leaky_relu", False),
        ((64,), "relu", True),
        ((32, 16), "tanh", True),
    ],
)
def test_ten_thousand_scores_equal_python_and_jax(
    programs, tmp_path, hidden, activation, scene_gating
):
    path = tmp_path / "weights.msgpack"
    made = trained_network(hidden, activation, scene_gating, 10_000)
    weights, features, valid, jax_values = made
    reward = save(path, weights, features[:16], valid[:16], jax_values[:16])
    found = scores(programs, "score", path, features)
    assert np.ptp(found) > 0.1
    assert_close(found, reward.value(features))
    found = scores(programs, "score", path, features, valid)
    assert_close(found, reward.value(features, valid))
    assert_close(found, jax_values)


def test_ten_thousand_totals_equal_python(programs, tmp_path):
    path, rng = tmp_path / "weights.msgpack", np.random.default_rng(6)
    weights = example_weights(features=21, times=4, hidden=(15,), with_prior=True)
    for end in (weights.lower, weights.upper):
        end[[5, 7]] = weights.location[[5, 7]]  # never varied in training
    reward = save(path, weights, *example_samples(weights))
    features = rng.normal(scale=2.0, size=(10_000, 4, 21)).astype(np.float32)
    features[:9999].reshape(-1, 3, 4, 21)[:, 1, 0] = features[:9999:3, 0]  # alike
    features[::50, 0, 3] = rng.choice([-np.inf, np.inf, 3e38], 200)  # clipped
    valid = np.arange(4) < rng.integers(0, 5, (10_000, 1))
    own = rng.normal(scale=5.0, size=10_000).astype(np.float32)
    for mask in ((), (valid,)):
        found = scores(programs, "total", path, features, own, *mask)
        assert np.ptp(found) > 1.0
        assert 1000 < np.sum(found != own) < 9000  # V is silent in the others
        assert_close(found, reward.total(features, own, *mask))


def test_a_file_that_planners_have_scores_as_it_did(programs, tmp_path):
    kept, features, valid, value, own, total = test_weights.golden()
    path = shutil.copy(kept, tmp_path / "weights.msgpack")
    assert_close(scores(programs, "score", path, features, valid == 1), value)
    assert_close(scores(programs, "total", path, features, own, valid == 1), total)


@pytest.mark.parametrize("data", [VALID, GATED, WITH_PRIOR])
def test_a_thousand_plans_get_the_guard_of_python(programs, tmp_path, data):
    """Four candidates, some beyond, at an open side, or not finite."""
    path, rng = tmp_path / "weights.msgpack", np.random.default_rng(4)
    path.write_bytes(data)
    reward = load_weights(path)
    guard = Guard(reward)
    low, high = np.clip(guard.low, -6.0, None), np.clip(guard.high, None, 6.0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    wide = rng.uniform(0.2, 3.0, (1000, 1, 1, 2))
    features = middle + half * wide * rng.uniform(-1.0, 1.0, (1000, 4, 3, 2))
    features[::9] = np.where(rng.random((112, 4, 3, 2)) < 0.5, low, high)  # the ends
    features[3::50, :, :, 1] = 1e9
    features[::50, 1, 2, 0] = np.nan
    features[7::50, 2, 1, 1] = np.inf
    features[8::50, 3, 0, 0] = -np.inf
    features = features.astype(np.float32)
    valid = rng.random((1000, 4, 3)) < 0.7
    features.tofile(tmp_path / "features")
    valid.astype(np.uint8).tofile(tmp_path / "valid")
    command = (programs / "reader", "guard", path, tmp_path / "features")
    for mask in ((), (tmp_path / "valid",)):
        lines = run(*command, *mask).decode().splitlines()
        found = [line.split() for line in lines]
        expected = [
            guard.check(one, each if mask else None)
            for one, each in zip(features, valid, strict=True)
        ]
        fine = [verdict.in_distribution for verdict in expected]
        assert 100 < sum(fine) < 900
        for row, verdict in zip(found, expected, strict=True):
            assert bool(int(row[0])) == verdict.in_distribution
            assert reward.names[int(row[1])] == verdict.feature
            assert float(row[2]) == verdict.share


def changed(rng, body):
    """A body with one to three bytes flipped, set, left out or put in."""
    body = bytearray(body)
    for _ in range(rng.integers(1, 4)):
        at, byte = int(rng.integers(0, len(body))), int(rng.integers(0, 256))
        match rng.integers(0, 4):
            case 0:
                body[at] ^= 1 << byte % 8
            case 1:
                body[at] = byte
            case 2:
                del body[at]
            case _:
                body.insert(at, byte)
    return bytes(body)


def test_damaged_files_get_the_verdict_of_the_python_reader(programs, tmp_path):
    """Cut, flipped, of random bytes; bodies that were changed and hashed again."""
    rng = np.random.default_rng(1)
    files = [VALID, GATED, WITH_PRIOR]
    files += [VALID[:length] for length in range(0, len(VALID), 3)]
    for _ in range(2000):
        bits = rng.integers(0, 8 * len(GATED), rng.integers(1, 9))
        files.append(wrong.flipped(GATED, set(bits.tolist())))
    files += [rng.bytes(int(size)) for size in rng.integers(1, 200, 500)]
    files.append(VALID.replace(b"sha256\xd9\x40", b"sha256\xd9\x40" + b"0" * 64)[:-64])
    for data in (VALID, GATED, WITH_PRIOR):
        body = msgpack.unpackb(data)["body"]
        files += [wrong.sealed(changed(rng, body)) for _ in range(1300)]
    expected = [is_valid(data) for data in files]
    assert sum(expected[:-3900]) == 3
    assert 100 < sum(expected[-3900:]) < 2900
    lines = verdicts(programs, files, tmp_path)
    assert [line == "ok" for line in lines] == expected
    for line in lines:
        assert line == "ok" or (line.startswith("w: ") and ": expected " in line)
        assert line.isprintable()


def test_wrong_fields_are_named_as_by_the_python_reader(programs, tmp_path):
    files = [wrong.tampered(path, value) for path, value, _ in wrong.FIELDS]
    files += [data for data, _ in wrong.FILES]
    lines = verdicts(programs, files, tmp_path)
    assert f"w: {wrong.LATER}" in lines
    for data, line in zip(files, lines, strict=True):
        field = refusal(data).split(": ")[0]
        # The Python reader counts times that do not increase from the second one.
        place = "times[1]" if "increasing" in line else field
        assert line.startswith(f"w: {place}: ")


def test_huge_lengths_and_deep_nesting_cost_nothing(programs, tmp_path):
    """A length allocated before its bytes have come would end the reader."""
    bombs = [
        tag + size
        for tag in (b"\xdd", b"\xdf", b"\xdb", b"\xc6", b"\xc9")
        for size in (b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\x10\0\0\0")
    ]
    bombs += [bomb * 1000 for bomb in (b"\x91", b"\xdd\0\0\0\2", b"\x81\xa1a")]
    bombs += [b"\x91" * 10**6, b"\xdc\x0f\xff" * 10**5, b"\xdc\x10\0" + b"\x90" * 4096]
    bombs += [b"\xdc\x10\0" + (b"\xdc\x10\0" + b"\0" * 4096) * 4096]
    size = {"shape": [4096, 4096], "dtype": "<f4", "data": b""}
    bombs += [wrong.sealed(bomb) for bomb in bombs]
    bombs.append(wrong.tampered(["layers", 0, "kernel"], size))
    for line in verdicts(programs, bombs, tmp_path):
        assert line.startswith("w: ")
        assert len(line) < 400


@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["g++", "clang++"])
def test_own_tests_pass_and_an_installed_copy_is_found(compiler, tmp_path):
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} not found")
    prefix = tmp_path / "installed"
    flags = (f"-DCMAKE_CXX_COMPILER={compiler}", f"-DCMAKE_INSTALL_PREFIX={prefix}")
    folder = configured(tmp_path / "build", *flags)
    run("cmake", "--build", folder, "--parallel", 2)
    run("ctest", "--output-on-failure", cwd=folder)
    run("cmake", "--install", folder)
    planner = tmp_path / "planner"
    planner.mkdir()
    shutil.copy(ONBOARD / "example/choose.cpp", planner)
    (planner / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.16)\nproject(planner CXX)\n"
        "find_package(rcirl 0.1 REQUIRED)\nadd_executable(planner choose.cpp)\n"
        "target_link_libraries(planner PRIVATE rcirl::rcirl)\n"
    )
    run("cmake", "-S", planner, "-B", planner / "build", *flags)
    run("cmake", "--build", planner / "build")
    assert (planner / "build/planner").is_file()
