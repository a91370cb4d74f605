import gc
import hashlib
import json
import os
import shutil
import sys
import tarfile
import tracemalloc
from pathlib import Path

import jax
import numpy as np
import pytest
import tensorstore as ts
from hypothesis import given
from hypothesis import strategies as st

from rcirl_jax.data.store import files, manifest
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.data.store.rows import leaf_specs, row_spec
from rcirl_jax.data.store.writer import DatasetWriter
from rcirl_jax.errors import InputError
from tests.helpers import scenes

GOLDEN = Path(__file__).parent / "golden"
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


def test_facts_stand_beside_the_manifest(copy):
    dataset = open_dataset(copy)
    assert dataset.facts() == {}
    dataset.write_facts({"made_by": {"git_commit": "abc"}, "share": np.float32(0.5)})
    again = open_dataset(copy)
    assert again.facts() == {"made_by": {"git_commit": "abc"}, "share": 0.5}
    assert again.hash == dataset.hash
    again.verify()
    half = '{"made_by": "\\ud800"}'
    bad = (("[" * 10**5, "JSON"), (half, "JSON"), ("[1]", "an object"))
    for text, word in bad:
        (copy / files.FACTS).write_text(text)
        with pytest.raises(InputError, match=rf"made_by\.json: .*expected {word}"):
            again.facts()


def test_round_trip_is_bit_identical(made):
    dataset = open_dataset(made)
    assert dataset.count == sum(SIZES)
    assert_same(dataset.load(None), joined())


def test_real_scenes_fit_the_row_layout(tmp_path):
    rows = jax.tree.map(lambda *x: np.stack(x), *map(scenes.demonstration, range(3)))
    writer = DatasetWriter(tmp_path)
    writer.write_shard(0, rows, [])
    writer.finish(finish_fields())
    assert_same(open_dataset(tmp_path).load(None), rows)


@given(
    asked=st.lists(st.integers(0, sum(SIZES) - 1), max_size=60), verify=st.booleans()
)
def test_read_gives_rows_in_the_order_asked(made, asked, verify):
    rows = np.array(asked, np.int64)
    found = open_dataset(made, verify=verify).read(rows)
    assert_same(found, jax.tree.map(lambda leaf: leaf[rows], joined()))


@pytest.mark.parametrize("rows", [[-1], [sum(SIZES)], [[0]]])
def test_read_refuses_rows_that_do_not_exist(made, rows):
    with pytest.raises(IndexError, match="expected a list of numbers below"):
        open_dataset(made, verify=False).read(np.array(rows))


def test_splits_follow_the_groups(made):
    dataset = open_dataset(made)
    whole = joined()
    for split, wanted in (("train", [0, 2, 3]), ("test", [1])):
        expected = [i for i, group in enumerate(whole.group) if group in wanted]
        assert dataset.indices(split).tolist() == expected
        assert_same(
            dataset.load(split),
            jax.tree.map(lambda leaf, at=expected: leaf[at], whole),
        )
    assert dataset.indices(None).tolist() == list(range(sum(SIZES)))
    with pytest.raises(InputError, match="splits: val: expected test, train"):
        dataset.indices("val")


def test_manifest_says_what_the_dataset_is(made):
    raw = json.loads((made / "manifest.json").read_text())
    stated = raw.pop("hash")
    plain = json.dumps(raw, sort_keys=True, separators=(",", ":")).encode()
    manifest = open_dataset(made).manifest
    assert manifest.hash == stated == hashlib.sha256(plain).hexdigest()
    assert manifest.count == sum(SIZES)
    assert [shard["count"] for shard in manifest.shards] == list(SIZES)
    assert manifest.arrays["scene.obstacles.valid"] == {
        "shape": [16, 18],
        "dtype": "bool",
    }
    given = finish_fields()
    assert manifest.import_flags == given.pop("import")
    assert {name: getattr(manifest, name) for name in given} == given
    for number in range(len(SIZES)):
        folder = made / f"shards/{number:05d}"
        mark = json.loads((folder / "shard.json").read_text())
        assert mark["lineage"] == lineage(number)
        assert mark["sha256"] == manifest.shards[number]["sha256"]
        made_of = {f"recording {number}": "0" * 64}
        assert manifest.shards[number]["recordings"] == made_of
        files = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
        assert files == {*mark["files"], "shard.json"}
        for name, stated in mark["files"].items():
            data = (folder / name).read_bytes()
            assert stated["sha256"] == hashlib.sha256(data).hexdigest()


def test_arrays_are_sharded_zstd_crc32c(made):
    metadata = json.loads((made / "shards/00000/scene.path.l/zarr.json").read_text())
    (codec,) = metadata["codecs"]
    assert codec["name"] == "sharding_indexed"
    names = [inner["name"] for inner in codec["configuration"]["codecs"]]
    assert names == ["bytes", "zstd", "crc32c"]
    assert codec["configuration"]["chunk_shape"][0] < SIZES[0]


def test_same_scenes_give_the_same_bytes(made, tmp_path):
    write(tmp_path / "again")
    assert every_byte(tmp_path / "again") == every_byte(made)


@pytest.mark.parametrize("scheme", ["memory", "file"])
def test_urls(scheme, tmp_path):
    url = f"{scheme}://{tmp_path if scheme == 'file' else '/somewhere/'}/set"
    manifest = write(url, sizes=(5, 3))
    dataset = open_dataset(url)
    assert dataset.hash == manifest.hash
    assert_same(dataset.load(None), joined((5, 3)))
    with pytest.raises(InputError, match="finished dataset"):
        DatasetWriter(url)


# --------------------------------------------------------------------- damage


# the JSON files, and of two leaves metadata and values
SOME_FILES = (
    "manifest.json",
    "shards/00001/shard.json",
    "shards/00001/human.s/zarr.json",
    "shards/00001/human.s/c/0/0",
    "shards/00002/scene.tags/c/0/0",
)


@pytest.mark.parametrize("name", SOME_FILES)
def test_a_flipped_bit_is_named(copy, name):
    good = (copy / name).read_bytes()
    rng = np.random.default_rng(0)
    for at in [0, len(good) - 1, *rng.integers(0, len(good), 8).tolist()]:
        bad = bytearray(good)
        bad[at] ^= 1 << int(rng.integers(8))
        (copy / name).write_bytes(bad)
        with pytest.raises(InputError, match=name.replace("/", ".")) as caught:
            open_dataset(copy)
        assert "\n" not in str(caught.value)
        if name in SOME_FILES[2:]:
            assert f"shard {name[len('shards/0000')]}: " in str(caught.value)
            assert hashlib.sha256(good).hexdigest() in str(caught.value)
            assert hashlib.sha256(bad).hexdigest() in str(caught.value)


def test_every_single_file_is_covered(copy):
    for path in sorted(copy.rglob("*")):
        if not path.is_file():
            continue
        good = path.read_bytes()
        path.write_bytes(good[:-2] + bytes([good[-2] ^ 1]) + good[-1:])
        with pytest.raises(InputError, match=str(path.relative_to(copy))):
            open_dataset(copy)
        path.write_bytes(good)
    open_dataset(copy)


@pytest.mark.parametrize("name", SOME_FILES)
@pytest.mark.parametrize("length", [0, 10, -1])
def test_truncated_files_are_named(copy, name, length):
    good = (copy / name).read_bytes()
    # the last byte of the JSON files is a line end, which says nothing
    cut = good.rstrip()[:length]
    (copy / name).write_bytes(cut)
    with pytest.raises(InputError, match=name):
        open_dataset(copy)


@pytest.mark.parametrize("name", SOME_FILES[1:])
def test_missing_files_are_named(copy, name):
    (copy / name).unlink()
    with pytest.raises(InputError, match=f"{name}: shard [12]: .*missing"):
        open_dataset(copy)


def test_missing_shard_is_named(copy):
    shutil.rmtree(copy / "shards" / "00001")
    with pytest.raises(InputError, match=r"shards/00001/shard.json: shard 1: missing"):
        open_dataset(copy)


def test_exchanged_shards_are_named(copy):
    shutil.rmtree(copy / "shards/00001")
    shutil.copytree(copy / "shards/00002", copy / "shards/00001")
    with pytest.raises(InputError, match=r"shards/00001/shard.json: shard 1: sha256"):
        open_dataset(copy)


def test_crc32c_lets_no_wrong_row_through(copy):
    victim = copy / "shards/00001/human.s/c/0/0"
    good = victim.read_bytes()
    rng = np.random.default_rng(0)
    for at in rng.integers(0, len(good), 40).tolist():
        bad = bytearray(good)
        bad[at] ^= 1 << int(rng.integers(8))
        victim.write_bytes(bad)
        with pytest.raises(InputError, match=r"shards/00001/human\.s: cannot be read"):
            open_dataset(copy, verify=False).read(np.arange(SIZES[0], sum(SIZES)))


def test_unverified_damage_is_found_when_read(copy):
    victim = copy / "shards/00001/human.s/c/0/0"
    data = bytearray(victim.read_bytes())
    data[20] ^= 1
    victim.write_bytes(data)
    dataset = open_dataset(copy, verify=False)
    dataset.read(np.arange(SIZES[0]))
    with pytest.raises(InputError, match=r"shards/00001/human.s: cannot be read"):
        dataset.read(np.array([SIZES[0]]))
    shutil.rmtree(copy / "shards/00002")
    with pytest.raises(InputError, match=r"shards/00002/scene.ego.s: cannot be read"):
        dataset.read(np.array([dataset.count - 1]))


def test_an_array_of_another_shape_is_named(copy):
    folder = copy / "shards/00001"
    shutil.rmtree(folder / "human.s")
    shutil.copytree(folder / "decisions", folder / "human.s")
    with pytest.raises(InputError, match=r"human.s: shard 1: int32 .*expected float32"):
        open_dataset(copy, verify=False).load(None)


@pytest.mark.parametrize("rows", [(40_000_000, 256), (40_000_000, 40_000_000)])
def test_an_array_in_other_chunks_is_named(copy, rows):
    """The blocks of a store are unpacked whole: a huge one would fill the memory."""
    path = copy / "shards/00001/human.s/zarr.json"
    meta = json.loads(path.read_text())
    chunk, block = ([count, *meta["shape"][1:]] for count in rows)
    chunk[0] -= chunk[0] % block[0]
    meta["chunk_grid"]["configuration"]["chunk_shape"] = chunk
    meta["codecs"][0]["configuration"]["chunk_shape"] = block
    path.write_text(json.dumps(meta))
    with pytest.raises(InputError, match=r"human.s: shard 1: chunks .*expected \(\(40"):
        open_dataset(copy, verify=False).indices("train")


def reseal(folder, change):
    """Change the manifest and give it the hash that belongs to it."""
    path = folder / "manifest.json"
    payload = json.loads(path.read_text())
    del payload["hash"]
    change(payload)
    path.write_bytes(manifest.seal(payload, "hash"))


def test_a_shard_without_rows_is_one_line(copy):
    for path in (copy / "shards/00001").glob("*/zarr.json"):
        meta = json.loads(path.read_text())
        meta["shape"][0] = 0
        path.write_text(json.dumps(meta))
    reseal(copy, lambda m: m["shards"][1].update(count=0))
    reseal(copy, lambda m: m.update(count=sum(SIZES) - SIZES[1]))
    dataset = open_dataset(copy, verify=False)
    with pytest.raises(InputError, match=r"shard 1: chunks .*expected"):
        dataset._arrays(1)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m.update(schema_version=1), "schema_version: 1: expected 2"),
        (lambda m: m.pop("schema_version"), "schema_version: None: expected 2"),
        (lambda m: m.pop("quality"), "quality: missing: expected"),
        (lambda m: m["arrays"].pop("human.s"), "arrays: human.s: None: expected"),
        (
            lambda m: m["arrays"]["human.s"].update(dtype="float64"),
            "arrays: human.s: .*float64.*expected .*float32",
        ),
        (lambda m: m["time_grid_s"].pop(), "time_grid_s"),
        (lambda m: m["shards"][1].update(count=41), "shard 1: float32 .*expected"),
    ],
)
def test_manifests_of_other_layouts_are_refused(copy, change, words):
    reseal(copy, change)
    with pytest.raises(InputError, match=words):
        open_dataset(copy)


@pytest.mark.parametrize("text", ["", "[]", "null", "{", '{"schema_version": NaN}'])
def test_manifests_that_are_none(copy, text):
    (copy / "manifest.json").write_text(text)
    with pytest.raises(InputError, match=r"manifest.json: "):
        open_dataset(copy)


def test_a_dataset_of_an_old_version_says_to_import_again(tmp_path):
    """Written by the first code with datasets, never made anew: without rates."""
    with tarfile.open(GOLDEN / "dataset_1.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    with pytest.raises(InputError) as caught:
        open_dataset(tmp_path)
    words = "schema_version: 1: expected 2; import the logs again with this version"
    assert str(caught.value) == f"{tmp_path}/manifest.json: {words}"


def test_no_dataset_and_interrupted_import_are_told_apart(copy, tmp_path):
    (copy / "manifest.json").unlink()
    with pytest.raises(InputError, match="interrupted: run import again to resume"):
        open_dataset(copy)
    with pytest.raises(InputError, match=r"manifest.json: missing: no dataset here"):
        open_dataset(tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()
    (tmp_path / "file").write_text("hello")
    with pytest.raises(InputError, match="file/: cannot be read"):
        open_dataset(tmp_path / "file")
    with pytest.raises(InputError, match=r"what://ever: .*expected a folder"):
        open_dataset("what://ever")


# --------------------------------------------------------------------- writer


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


@pytest.mark.parametrize(
    "writes",
    [0, 1, FILES - 1, FILES, FILES + 9, 3 * FILES - 1, 3 * FILES],
)
def test_interrupted_import_resumes_to_the_same_bytes(
    made, tmp_path, monkeypatch, writes
):
    folder = tmp_path / "resumed"
    with monkeypatch.context() as patch:
        interrupt_after(patch, writes)
        with pytest.raises(Interrupted):
            write(folder)
    with pytest.raises(InputError, match=r"manifest.json: missing"):
        open_dataset(folder)
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


def test_lineages_of_written_shards_are_not_kept(tmp_path):
    """A long log has one of 94 kB a minute; what is kept is a digest of each name."""
    writer = DatasetWriter(tmp_path)
    writer.write_shard(0, make_rows(1), lineage(0))  # once: caches fill
    tracemalloc.start()
    vehicles = [f"vehicle {i}" for i in range(100_000)]  # 6.5 MB
    writer.write_shard(1, make_rows(1), [{**lineage(1)[0], "vehicles": vehicles}])
    del vehicles
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 1e6
    assert len(writer.committed()[1].lineage[0]["vehicles"]) == 100_000


def test_a_shorter_import_leaves_no_old_shards(made, tmp_path):
    folder = tmp_path / "short"
    shutil.copytree(made, folder)
    (folder / "manifest.json").unlink()
    (folder / "shards/00001/shard.json").unlink()
    writer = DatasetWriter(folder)
    assert len(writer.committed()) == 1
    writer.finish(finish_fields())
    assert sorted(path.name for path in (folder / "shards").iterdir()) == ["00000"]
    assert open_dataset(folder).count == SIZES[0]


@pytest.mark.parametrize("existed", [False, True])
def test_abort_leaves_nothing(tmp_path, existed):
    folder = tmp_path / "deep" / "dataset"
    if existed:
        folder.mkdir(parents=True)
    writer = DatasetWriter(folder)
    writer.abort()
    writer.write_shard(0, make_rows(5), [])
    writer.write_shard(1, make_rows(5), [])
    assert (folder / "shards/00001/shard.json").exists()
    writer.abort()
    left = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*"))
    assert left == (["deep", "deep/dataset"] if existed else [])


@pytest.mark.parametrize("writes", [1, 5, 30, 70])
def test_abort_in_the_middle_of_a_shard(tmp_path, monkeypatch, writes):
    writer = DatasetWriter(tmp_path / "d")
    interrupt_after(monkeypatch, writes)
    with pytest.raises(Interrupted):
        writer.write_shard(0, make_rows(5), [])
    writer.abort()
    assert list(tmp_path.iterdir()) == []


def test_abort_keeps_what_it_resumed_from_and_foreign_files(copy):
    (copy / "manifest.json").unlink()
    shutil.rmtree(copy / "shards/00002")
    (copy / "notes.txt").write_text("mine")
    before = every_byte(copy)
    writer = DatasetWriter(copy)
    writer.write_shard(2, make_rows(5), [])
    writer.abort()
    assert every_byte(copy) == before


def test_abort_after_finish_keeps_the_dataset(tmp_path):
    writer = DatasetWriter(tmp_path)
    write(tmp_path, sizes=(4,), writer=writer)
    writer.abort()
    assert open_dataset(tmp_path).count == 4


def test_overwriting(made, copy):
    with pytest.raises(InputError, match=r"finished dataset: .*--overwrite"):
        DatasetWriter(copy)
    writer = DatasetWriter(copy, overwrite=True)
    assert writer.committed() == []
    writer.abort()  # bad input before the first shard: the old dataset survives
    assert every_byte(copy) == every_byte(made)
    writer = DatasetWriter(copy, overwrite=True)
    writer.write_shard(0, make_rows(5), [])
    with pytest.raises(InputError, match="interrupted"):
        open_dataset(copy)
    writer.finish(finish_fields())
    assert open_dataset(copy).count == 5
    assert sorted(path.name for path in (copy / "shards").iterdir()) == ["00000"]


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", ["thesis.tex", "shards/readme", "a/b/c"])
def test_folders_with_other_files_are_refused(tmp_path, overwrite, name):
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("precious")
    with pytest.raises(InputError, match=f"holds {name}, not a dataset"):
        DatasetWriter(tmp_path, overwrite=overwrite)
    assert path.read_text() == "precious"


@pytest.mark.parametrize("use", [open_dataset, DatasetWriter])
def test_a_name_that_is_no_text_is_one_line(tmp_path, use):
    (tmp_path / os.fsdecode(b"caf\xe9.txt")).touch()
    with pytest.raises(InputError, match=rf"^{tmp_path}: holds b'caf.*expected names"):
        use(tmp_path)


def test_a_file_is_no_place_for_a_dataset(tmp_path):
    (tmp_path / "file").write_text("hello")
    with pytest.raises(InputError, match="file"):
        DatasetWriter(tmp_path / "file")
    with pytest.raises(InputError, match="file"):
        DatasetWriter(tmp_path / "file" / "below").write_shard(0, make_rows(2), [])


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
    with pytest.raises(InputError, match="cannot be written"):
        DatasetWriter(tmp_path / "e").write_shard(0, make_rows(3), [])


def test_a_vehicle_in_two_splits_is_refused(tmp_path):
    rows = make_rows(6).replace(
        vehicle=np.array([0, 1, 2, 3, 7, 7], np.int32),
        group=np.array([0, 1, 2, 3, 0, 1], np.int32),
    )
    writer = DatasetWriter(tmp_path)
    writer.write_shard(0, rows, [])
    with pytest.raises(InputError, match="vehicle 7: in test and train"):
        writer.finish(finish_fields())
    with pytest.raises(InputError, match="interrupted"):
        open_dataset(tmp_path)


def test_wrong_calls(tmp_path):
    rows = make_rows(6)
    writer = DatasetWriter(tmp_path)
    with pytest.raises(ValueError, match="0 shards"):
        writer.finish(finish_fields())
    with pytest.raises(ValueError, match="shard 1: expected 0 next"):
        writer.write_shard(1, rows, [])
    with pytest.raises(ValueError, match="0 rows"):
        writer.write_shard(0, make_rows(0), [])
    with pytest.raises(ValueError, match=r"frame: int64 \(6,\): expected int32"):
        writer.write_shard(0, rows.replace(frame=rows.frame.astype(np.int64)), [])
    with pytest.raises(ValueError, match=r"decisions: int32 \(6, 15\)"):
        writer.write_shard(0, rows.replace(decisions=rows.decisions[:, 1:]), [])
    assert list(tmp_path.iterdir()) == []
    writer.write_shard(0, rows, [])
    for changes, words in (
        ({"extra": 1}, "extra"),
        ({"vehicles": ["v0"]}, r"vehicle: \d+ to \d+: 1 names"),
        ({"splits": {"train": ["g0"], "test": ["g1"]}}, "every group exactly once"),
    ):
        with pytest.raises(ValueError, match=words):
            writer.finish(finish_fields(**changes))


def test_what_cannot_be_deleted_is_one_line(tmp_path, monkeypatch):
    place = files.Files(str(tmp_path / "d"))

    class Stuck:
        def delete_range(self, _):
            raise ValueError("PERMISSION_DENIED: no [source locations='here']")

    monkeypatch.setattr(place, "kv", Stuck())
    with pytest.raises(
        OSError, match=r"d/shards: cannot be deleted: PERMISSION_DENIED: no$"
    ):
        place.remove("shards", "shardt")


def test_opening_again_and_again_keeps_nothing(tmp_path):
    """A training over many shards opens their arrays thousands of times."""
    write(tmp_path / "d")
    open_dataset(tmp_path / "d")
    gc.collect()
    before = sys.getallocatedblocks()
    for _ in range(10):
        open_dataset(tmp_path / "d")
    gc.collect()
    assert (sys.getallocatedblocks() - before) / 10 < len(
        leaf_specs()
    )  # 12 an array before
