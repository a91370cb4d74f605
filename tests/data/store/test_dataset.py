import contextlib
import hashlib
import json
import shutil

import jax
import numpy as np
import pytest
import tensorstore as ts
from hypothesis import given
from hypothesis import strategies as st

from rcirl_jax.data.store import files
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.data.store.rows import row_spec
from rcirl_jax.data.store.writer import DatasetWriter
from tests.helpers.logs import refused

SIZES = (300, 40, 7)  # rows per shard: more than one block, less than one block
NUM_GROUPS = 4
SPECIAL = np.array([np.nan, -np.nan, np.inf, -np.inf, -0.0, 1e-42, 3.4e38], np.float32)


def make_rows(count, seed=0):
    """Random bits in every leaf; vehicle v belongs to group v mod NUM_GROUPS."""
    rng = np.random.default_rng([seed, count])

    def leaf(spec):
        shape = (count, *spec.shape)
        if spec.dtype == np.float32:
            values = rng.normal(size=shape).astype(np.float32)
            odd = rng.random(shape) < 0.05
            return np.where(odd, rng.choice(SPECIAL, shape), values)
        return rng.integers(0, 2, shape).astype(spec.dtype)

    vehicle = rng.integers(0, 40, count).astype(np.int32)
    return jax.tree.map(leaf, row_spec()).replace(
        vehicle=vehicle, group=(vehicle % NUM_GROUPS).astype(np.int32)
    )


def finish_fields(**changes):
    return {
        "rate_hz": [10.0],
        "sources": [{"source": "made up", "licence": "CC0"}],
        "recordings": ["first", "second"],
        "groups": [f"g{i}" for i in range(NUM_GROUPS)],
        "vehicles": [f"v{i}" for i in range(40)],
        "splits": {"train": ["g0", "g2", "g3"], "test": ["g1"]},
        "quality": {"scenes": 1, "tags": {"stopping": 2, "cruising": 1}},
        "import": {"format": "made"},
        **changes,
    }


def lineage(index):
    return [{"name": f"recording {index}", "sha256": "0" * 64}]


def write(url, sizes=SIZES, start=0, writer=None):
    writer = writer or DatasetWriter(url)
    for index in range(start, len(sizes)):
        writer.write_shard(index, make_rows(sizes[index], index), lineage(index))
    return writer.finish(finish_fields())


def every_byte(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


def joined(sizes=SIZES):
    parts = [make_rows(size, index) for index, size in enumerate(sizes)]
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def assert_same(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert isinstance(a, np.ndarray)
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A finished dataset; tests copy it before they damage it."""
    folder = tmp_path_factory.mktemp("store") / "dataset"
    write(folder)
    return folder


@pytest.fixture
def copy(made, tmp_path):
    return shutil.copytree(made, tmp_path / "copy")


def test_rows_splits_and_manifest_are_those_written(made):
    """To the bit; digests are those of the bytes, and the splits follow the groups."""
    dataset, whole = open_dataset(made), joined()
    assert_same(dataset.load(None), whole)
    for split, wanted in (("train", [0, 2, 3]), ("test", [1])):
        expected = np.flatnonzero(np.isin(whole.group, wanted))
        assert dataset.indices(split).tolist() == expected.tolist()
        part = jax.tree.map(lambda leaf, at=expected: leaf[at], whole)
        assert_same(dataset.load(split), part)
    assert "splits: val: expected test, train" in refused(dataset.indices, "val")
    raw = json.loads((made / "manifest.json").read_text())
    stated = raw.pop("hash")
    plain = json.dumps(raw, sort_keys=True, separators=(",", ":")).encode()
    manifest = dataset.manifest
    assert manifest.hash == stated == hashlib.sha256(plain).hexdigest()
    given = finish_fields()
    assert manifest.import_flags == given.pop("import")
    assert {name: getattr(manifest, name) for name in given} == given
    for number, shard in enumerate(manifest.shards):
        folder = made / f"shards/{number:05d}"
        mark = json.loads((folder / "shard.json").read_text())
        assert (shard["count"], mark["lineage"]) == (SIZES[number], lineage(number))
        assert mark["sha256"] == shard["sha256"]
        for name, stated in mark["files"].items():
            data = (folder / name).read_bytes()
            assert stated["sha256"] == hashlib.sha256(data).hexdigest()


@pytest.mark.parametrize("scheme", ["memory", "file"])
def test_urls(scheme, tmp_path):
    url = f"{scheme}://{tmp_path if scheme == 'file' else '/somewhere/'}/set"
    manifest = write(url, sizes=(5, 3))
    dataset = open_dataset(url)
    assert dataset.hash == manifest.hash
    assert_same(dataset.load(None), joined((5, 3)))
    assert "finished dataset" in refused(DatasetWriter, url)


@given(asked=st.lists(st.integers(0, sum(SIZES) - 1), max_size=60))
def test_read_gives_rows_in_the_order_asked(made, asked):
    rows = np.array(asked, np.int64)
    dataset = open_dataset(made, verify=False)
    assert_same(dataset.read(rows), jax.tree.map(lambda leaf: leaf[rows], joined()))
    for bad in ([-1], [sum(SIZES)], [[0]]):
        with pytest.raises(IndexError, match="expected a list of numbers below"):
            dataset.read(np.array(bad))


def test_no_dataset_and_interrupted_import_are_told_apart(copy, tmp_path):
    (copy / "manifest.json").unlink()
    (tmp_path / "file").write_text("hello")
    for place, words in (
        (copy, "interrupted: run import again to resume"),
        (tmp_path / "nowhere", "manifest.json: missing: no dataset here"),
        (tmp_path / "file", "file/: cannot be read"),
        ("what://ever", "expected a folder"),
    ):
        assert words in refused(open_dataset, place)
    assert not (tmp_path / "nowhere").exists()


class Interrupted(BaseException):
    """Stands for ctrl-C or a kill."""


def interrupt_after(monkeypatch, writes):
    """Let so many files through, then raise; the rest is never written."""
    left = [writes]
    original = files.put

    def put(kv, key, value):
        left[0] -= 1
        if left[0] < 0:
            raise Interrupted
        return original(kv, key, value)

    monkeypatch.setattr(files, "put", put)


# a shard has 2 files per leaf and its mark: cut in the first shard, right before
# and after a mark, in the second and third shard, and right before the manifest
FILES = 2 * len(jax.tree.leaves(row_spec())) + 1


@pytest.mark.parametrize("writes", [1, FILES - 1, FILES, FILES + 9, 3 * FILES])
def test_interrupted_import_resumes_to_the_same_bytes(
    made, tmp_path, monkeypatch, writes
):
    folder = tmp_path / "resumed"
    with monkeypatch.context() as patch:
        interrupt_after(patch, writes)
        with pytest.raises(Interrupted):
            write(folder)
    assert "manifest.json: missing" in refused(open_dataset, folder)
    writer = DatasetWriter(folder)
    whole = writer.committed()
    assert len(whole) == writes // FILES
    assert [info.lineage for info in whole] == [lineage(i) for i in range(len(whole))]
    write(folder, start=len(whole), writer=writer)
    assert every_byte(folder) == every_byte(made)


def test_resuming_stops_at_the_first_damaged_shard(made, copy):
    (copy / "manifest.json").unlink()
    victim = copy / "shards/00001/group/c/0"
    victim.write_bytes(victim.read_bytes()[:-1])
    (copy / "shards/00002/human.s/c/0/0.__lock").write_bytes(b"left by a kill")
    writer = DatasetWriter(copy)
    assert [info.count for info in writer.committed()] == [SIZES[0]]
    write(copy, start=1, writer=writer)
    assert every_byte(copy) == every_byte(made)


@pytest.mark.parametrize(
    ("writes", "existed"),
    [(1, False), (30, True), (FILES + 1, False), (2 * FILES, True)],
)
def test_abort_leaves_nothing(tmp_path, monkeypatch, existed, writes):
    """Also where it comes in the middle of a shard."""
    folder = tmp_path / "deep" / "dataset"
    if existed:
        folder.mkdir(parents=True)
    interrupt_after(monkeypatch, writes)
    with files.Files(folder).alone():
        writer = DatasetWriter(folder)
        writer.abort()
        with contextlib.suppress(Interrupted):
            writer.write_shard(0, make_rows(5), [])
            writer.write_shard(1, make_rows(5), [])
        assert any(path.is_file() for path in folder.rglob("*"))
        writer.abort()
    left = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*"))
    assert left == (["deep", "deep/dataset"] if existed else [])


def test_overwriting(made, copy):
    assert "or overwrite to replace" in refused(DatasetWriter, copy)
    writer = DatasetWriter(copy, overwrite=True)
    assert writer.committed() == []
    writer.abort()  # bad input before the first shard: the old dataset survives
    assert every_byte(copy) == every_byte(made)
    writer.write_shard(0, make_rows(5), [])
    assert "interrupted" in refused(open_dataset, copy)
    writer.finish(finish_fields())
    assert open_dataset(copy).count == 5
    assert sorted(path.name for path in (copy / "shards").iterdir()) == ["00000"]


@pytest.mark.parametrize(
    ("name", "overwrite"),
    [("thesis.tex", True), ("shards/readme", True), ("a/b/c", False)],
)
def test_folders_with_other_files_are_refused(tmp_path, overwrite, name):
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("precious")
    line = refused(DatasetWriter, tmp_path, overwrite=overwrite)
    assert f"holds {name}, not a dataset" in line
    assert path.read_text() == "precious"


def test_a_full_disk_keeps_the_shards_before(tmp_path, monkeypatch):
    def fail(kv, key, value):
        promise, future = ts.Promise.new()
        promise.set_exception(ValueError("no space left"))
        return future

    writer = DatasetWriter(tmp_path / "d")
    writer.write_shard(0, make_rows(3), [])
    monkeypatch.setattr(files, "put", fail)
    with pytest.raises(OSError, match="cannot be written: no space left"):
        writer.write_shard(1, make_rows(3), [])
    assert len(DatasetWriter(tmp_path / "d").committed()) == 1
    other = DatasetWriter(tmp_path / "e")
    assert "cannot be written" in refused(other.write_shard, 0, make_rows(3), [])


def test_a_vehicle_in_two_splits_is_refused(tmp_path):
    rows = make_rows(6).replace(
        vehicle=np.array([0, 1, 2, 3, 7, 7], np.int32),
        group=np.array([0, 1, 2, 3, 0, 1], np.int32),
    )
    writer = DatasetWriter(tmp_path)
    writer.write_shard(0, rows, [])
    assert "vehicle 7: in test and train" in refused(writer.finish, finish_fields())
    assert "interrupted" in refused(open_dataset, tmp_path)
