"""Damaged datasets, and those made to harm: one line that names the file."""

import json
import re
import shutil

import numpy as np
import pytest

from rcirl_jax.data.store import files
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.data.store.files import describe
from tests.data.store.test_dataset import SIZES, write
from tests.helpers.logs import refused


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("store") / "dataset"
    write(folder)
    return folder


@pytest.fixture
def copy(made, tmp_path):
    return shutil.copytree(made, tmp_path / "copy")


@pytest.fixture
def small(tmp_path):
    """A dataset of one shard with two rows."""
    write(tmp_path / "d", (2,))
    return tmp_path / "d"


def flip(place):
    """Change one bit; of a place None: somewhere."""

    def apply(data):
        rng = np.random.default_rng(len(data))
        bad = bytearray(data)
        bad[rng.integers(len(data)) if place is None else place] ^= 1 << rng.integers(8)
        return bytes(bad)

    return apply


DAMAGES = {
    **{"first bit": flip(0), "last bit": flip(-1), "some bit": flip(None)},
    # the last byte of the JSON files is a line end, which says nothing
    **{f"cut at {n}": lambda data, n=n: data.rstrip()[:n] for n in (0, 10, -1)},
    "missing": lambda data: None,
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_files_are_named(copy, damage):
    """Both JSON files, and a share of the others: all damages together every one."""
    every = sorted(path for path in copy.rglob("*") if path.is_file())
    share = every[list(DAMAGES).index(damage) :: len(DAMAGES)]
    for path in {*share, copy / "manifest.json", copy / "shards/00001/shard.json"}:
        name, good = str(path.relative_to(copy)), path.read_bytes()
        bad = DAMAGES[damage](good)
        path.unlink()
        if bad is not None:
            path.write_bytes(bad)
        line = refused(open_dataset, copy)
        assert f"{name}: " in line
        if path.name not in ("manifest.json", "shard.json"):
            assert f"{name}: shard {int(name.split('/')[1])}: " in line
            assert describe(good)["sha256"] in line
            same = bad is not None and len(bad) == len(good)
            assert not same or describe(bad)["sha256"] in line
        path.write_bytes(good)
    open_dataset(copy)


def test_crc32c_lets_no_wrong_row_through(copy):
    """Damage that is not looked for is found when its rows are read."""
    victim = copy / "shards/00001/human.s/c/0/0"
    good = victim.read_bytes()
    rng = np.random.default_rng(0)
    for at in [20, *rng.integers(0, len(good), 40).tolist()]:
        bad = bytearray(good)
        bad[at] ^= 1 << int(rng.integers(8))
        victim.write_bytes(bad)
        dataset = open_dataset(copy, verify=False)
        dataset.read(np.arange(SIZES[0]))
        line = refused(dataset.read, np.arange(SIZES[0], sum(SIZES)))
        assert "shards/00001/human.s: cannot be read" in line
    shutil.rmtree(copy / "shards/00002")
    line = refused(dataset.read, np.array([dataset.count - 1]))
    assert "shards/00002/scene.ego.s: cannot be read" in line


def reseal(folder, change_shard=None, change=None):
    """Change shard.json or manifest.json, and make the digests above it right."""
    mark, top = folder / "shards/00000/shard.json", folder / "manifest.json"
    shard, whole = json.loads(mark.read_text()), json.loads(top.read_text())
    if change_shard:
        shard.pop("sha256")
        change_shard(shard)
        mark.write_bytes(files.seal(shard, "sha256"))
        whole["shards"][0]["sha256"] = json.loads(mark.read_text())["sha256"]
    whole.pop("hash")
    if change:
        change(whole)
    top.write_bytes(files.seal(whole, "hash"))


ROWS = "vehicle/c/0"
X = describe(b"x")


def entry(key, value):
    """A change of `files`: None takes an entry away, a text means another entry."""

    def change(shard):
        found = shard["files"]
        if value is None:
            found.pop(key)
        else:
            found[key] = found[value] if isinstance(value, str) else value

    return change


BAD_SHARDS = [
    (entry("../../../secret", X), r"files: '../../../secret': expected two of every"),
    # zarr reads zeros where nothing is
    (entry(ROWS, None), f"files: '{ROWS}': expected two of every array"),
    (entry(ROWS, X), f"files: {ROWS}: 1 bytes: expected 20 at least for 2 rows"),
    # an array of a billion rows is not made of a small file
    (lambda s: s.update(count=10**9), "bytes: expected 62500004 at least for 10"),
    (lambda s: s.pop("lineage"), "lineage: missing: expected"),
]


@pytest.mark.parametrize(("change", "words"), BAD_SHARDS)
def test_shards_that_are_none(small, change, words):
    (small.parent / "secret").write_text("x")
    reseal(small, change)
    assert re.search(f"shard.json: .*{words}", refused(open_dataset, small))


GROUPS, FLOAT32 = "splits: .*expected every group", ".*float64.*expected .*float32"
BAD_MANIFESTS = [
    (lambda m: m.update(schema_version=1), "schema_version: 1: expected 2"),
    (lambda m: m["arrays"]["human.s"].update(dtype="float64"), FLOAT32),
    (lambda m: m["time_grid_s"].pop(), "time_grid_s"),
    (lambda m: (m["shards"][0].update(count=3), m.update(count=3)), "shard 0: float32"),
    (lambda m: m.update(count=1), "count: 1: expected 2, the sum of its shards"),
    (lambda m: m.update(count=10**15), "count: 10{15}: expected a whole number <="),
    (lambda m: m["splits"].popitem(), GROUPS),
    (lambda m: m["splits"].update(a=["g0"]), GROUPS),
]


@pytest.mark.parametrize(("change", "words"), BAD_MANIFESTS)
def test_manifests_that_are_none(small, change, words):
    reseal(small, change=change)
    assert re.search(words, refused(open_dataset, small))
