"""The dataset on disk: shards of zarr3 arrays, each commit marked by a file.

    DATASET/manifest.json                  the dataset is complete; written last
    DATASET/shards/00000/shard.json        the shard is complete; written last
    DATASET/shards/00000/scene.ego.v/...   one zarr3 array [n, ...] per leaf

DATASET is a folder or any tensorstore URL (`gs://`, `s3://`, `memory://`).
Arrays: codec `sharding_indexed` around zstd and crc32c (zarr v3 specification),
so one file per leaf and shard, of which single blocks of rows can be read. Digests
are those of `files.py`.
"""

import abc
import functools
import hashlib
import importlib
import json
import os
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, TypedDict, TypeVar

import jax
import msgspec
import numpy as np
import tensorstore as ts

from rcirl_jax.data.store.files import (
    FACTS,
    MANIFEST,
    MARK,
    PLANS,
    SHARDS,
    FileEntry,
    Files,
    context,
    describe,
    unseal,
)
from rcirl_jax.data.store.rows import leaf_specs, row_spec
from rcirl_jax.errors import InputError, as_input_error, counted, extra_module
from rcirl_jax.runtime.atomic_files import parse_json, plain
from rcirl_jax.runtime.checked import checked
from rcirl_jax.types import Demonstration
from rcirl_jax.units import NUM_TIMES, TIMES_S

BLOCK_ROWS = 256  # rows of a separately compressed block: ~2.5 MB of scenes, unpacked
MAX_ROWS = 2**31  # rows of a dataset
OPEN_SHARDS = 256  # shards whose arrays are kept open, 60 kB each
EQUAL, SCENES = "equal", "scenes"  # shares of joined datasets
Rows = Annotated[int, msgspec.Meta(ge=0, le=MAX_ROWS)]

_Body = TypeVar("_Body")


class ShardInfo(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A committed shard, as its shard.json says."""

    schema_version: int
    index: Rows
    count: Rows
    lineage: list[dict]  # recordings in it, as the import described them
    files: dict[str, FileEntry]  # by key below the shard
    sha256: str  # over the fields above


class ShardEntry(TypedDict):
    """A shard in the manifest: its digest, and what it was made of.

    "recordings" maps their names to the sha256 of what was cut into scenes and of how
    (`importing.RecordingScenes.sha256`); null where nothing was recorded, as of planned
    drives.
    """

    count: Rows
    sha256: str
    recordings: dict[str, str | None]


class Manifest(
    msgspec.Struct,
    frozen=True,
    kw_only=True,
    forbid_unknown_fields=True,
    rename={"import_flags": "import"},
):
    """The content of manifest.json; "import" is called `import_flags` here."""

    schema_version: int
    count: Rows  # of all shards
    arrays: dict[str, Any]  # leaf -> {"shape", "dtype"} of one row
    time_grid_s: list[float]  # s, `TIMES_S`
    rate_hz: list[float]  # Hz, sampling rates of the recordings
    sources: list[dict]  # {"source", "licence"} of the data
    recordings: list[str]  # names by number, as are the next two
    groups: list[str]
    vehicles: list[str]
    splits: dict[str, list[str]]  # group names per split
    shards: list[ShardEntry]  # by number
    quality: dict  # data-quality report
    import_flags: dict
    hash: str  # sha256 over the canonical manifest without this field


def array_table() -> dict[str, dict]:
    """Returns shape and dtype of every array, as the manifest states them."""
    return {
        name: {"shape": list(leaf.shape), "dtype": np.dtype(leaf.dtype).name}
        for name, leaf in leaf_specs().items()
    }


def parse_manifest(raw: bytes, files: Files) -> Manifest:
    """Returns the manifest from its bytes.

    Raises:
      InputError: something does not fit; names the field.
    """
    name = files.path(MANIFEST)
    manifest = checked(unseal(raw, "hash", name), Manifest, name)
    ours, total = array_table(), sum(shard["count"] for shard in manifest.shards)
    for leaf in sorted(ours.keys() | manifest.arrays.keys()):
        found, expected = manifest.arrays.get(leaf), ours.get(leaf)
        if found != expected:
            raise InputError(f"{name}: arrays: {leaf}: {found}: expected {expected}")
    members = sorted(group for names in manifest.splits.values() for group in names)
    for field, is_good, expected in (
        ("time_grid_s", manifest.time_grid_s == TIMES_S.tolist(),
         f"{NUM_TIMES} times from 0 to {TIMES_S[-1]} s"),
        ("splits", members == sorted(manifest.groups), "every group exactly once"),
        ("count", manifest.count == total, f"{total}, the sum of its shards"),
    ):  # fmt: skip
        if not is_good:
            raise InputError(
                f"{name}: {field}: {getattr(manifest, field)}: expected {expected}"
            )
    return manifest


def shard_key(index: int) -> str:
    """Returns the prefix of all keys of a shard."""
    return f"{SHARDS}{index:05d}/"


def layout(shape: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Returns the shapes of an array's blocks of rows, and of the chunk they fill."""
    rows = min(max(shape[0], 1), BLOCK_ROWS)
    return (rows, *shape[1:]), (-(-shape[0] // rows) * rows, *shape[1:])


def shard_info(files: Files, index: int, sha256: str | None = None) -> ShardInfo:
    """Reads shard.json, whose sha256 the manifest may state.

    Raises:
      InputError: it is not there, or not as written.
    """
    key = shard_key(index) + MARK
    name, raw = files.path(key), files.read_json(key)
    if raw is None:
        raise InputError(f"{name}: shard {index}: missing: expected sha256 {sha256}")
    info = checked(unseal(raw, "sha256", name), ShardInfo, name)
    if sha256 is not None and info.sha256 != sha256:
        raise InputError(
            f"{name}: shard {index}: sha256 {info.sha256}: expected {sha256}"
        )
    # every array has two files, one large enough to say where its blocks are: of rows
    # without a file zarr makes zeros, so a few bytes cannot claim many rows
    index_bytes = 16 * -(-info.count // BLOCK_ROWS) + 4  # two offsets a block, crc32c
    least = {}
    for leaf, spec in leaf_specs().items():
        least[f"{leaf}/zarr.json"] = 1
        least["/".join([leaf, "c", *"0" * (1 + len(spec.shape))])] = index_bytes
    for file in sorted(least.keys() ^ info.files.keys()):
        raise InputError(f"{name}: files: {file!a}: expected two of every array")
    for file, size in least.items():
        if info.files[file]["bytes"] < size:
            raise InputError(
                f"{name}: files: {file}: {info.files[file]['bytes']} bytes: expected "
                f"{size} at least for {info.count} rows"
            )
    return info


def verify_shard(files: Files, index: int, sha256: str | None = None) -> ShardInfo:
    """Reads all of a shard against its checksums.

    Raises:
      InputError: names the shard and the file at fault.
    """
    info = shard_info(files, index, sha256)
    stated = {shard_key(index) + file: found for file, found in info.files.items()}
    values = files.read({file: found["bytes"] for file, found in stated.items()})
    for file, value in values.items():
        expected = stated[file]
        found = {"bytes": 0, "sha256": "missing"} if value is None else describe(value)
        if found != expected:
            raise InputError(
                f"{files.path(file)}: shard {index}: {found['bytes']} bytes, sha256 "
                f"{found['sha256']}: expected {expected['bytes']} bytes, sha256 "
                f"{expected['sha256']}; import the logs again"
            )
    return info


class Demonstrations(abc.ABC):
    """Rows by number, in splits: a dataset, several joined, or one split anew."""

    @property
    @abc.abstractmethod
    def hash(self) -> str:
        """Identity of the whole contents."""

    @abc.abstractmethod
    def indices(self, split: str | None) -> np.ndarray:
        """Returns row numbers [m] int64 of a split (None: of all), ascending."""

    @abc.abstractmethod
    def blocks(self, indices: np.ndarray) -> np.ndarray:
        """Returns the number [m] of the block, unpacked together, of each row."""

    @abc.abstractmethod
    def read(self, indices: np.ndarray) -> Demonstration:
        """Reads rows by number, numpy leaves [m, ...], in the order asked for."""

    def load(self, split: str | None) -> Demonstration:
        """Reads all rows of a split (None: of all splits) into memory."""
        return self.read(self.indices(split))

    def weights(self, indices: np.ndarray) -> np.ndarray:
        """Returns the weight [m] float32 of each scene in a training loss."""
        return np.ones(np.size(indices), np.float32)


class Dataset(Demonstrations):
    """A finished dataset, opened with `open_dataset`; rows are numbered 0 .. n-1.

    `dataset[row]` is one scene and what the human did in it; loops run over all rows.
    Of several at once `read` gives stacked arrays.

        >>> dataset = rcirl_jax.open_dataset("data")
        >>> held_out = dataset.indices("test")
        >>> one = dataset[held_out[0]]
        >>> one.human.v.shape, one.human.v.dtype
        ((18,), dtype('float32'))
    """

    def __init__(self, files: Files, manifest: Manifest) -> None:
        self.manifest = manifest
        self._files = files
        counts = [shard["count"] for shard in manifest.shards]
        self._starts = np.cumsum([0, *counts])
        self._open: dict[int, dict[str, ts.TensorStore]] = {}

    def __repr__(self) -> str:
        """Returns the folder, and how many scenes of how many recordings it has."""
        scenes = counted(self.count, "scene")
        recordings = counted(len(self.manifest.recordings), "recording")
        return f"Dataset({self._files.name}: {scenes} of {recordings})"

    def __getitem__(self, row: int) -> Demonstration:
        """Returns one row; numpy leaves without the row's axis."""
        return jax.tree.map(lambda leaf: leaf[0], self.read(np.array([row])))

    @property
    def hash(self) -> str:
        """Identity of the whole contents: the manifest's hash."""
        return self.manifest.hash

    @property
    def count(self) -> int:
        """Number of rows."""
        return self.manifest.count

    def write_facts(self, body: Mapping[str, object]) -> None:
        """Writes beside the manifest what made the dataset: commit, versions, flags.

        Raises:
          OSError: the place cannot be written.
        """
        text = json.dumps(plain(body), indent=2, allow_nan=False) + "\n"
        self._files.write_many({FACTS: text.encode()})

    def facts(self) -> dict[str, Any]:
        """Returns what `write_facts` wrote, or nothing; InputError: no JSON object."""
        return self._body(FACTS, dict[str, Any], b"{}")

    def write_plans(self, plans: Sequence[Mapping[str, object]]) -> None:
        """Writes the plans of sites (`data.plans.plan_of`) beside the manifest.

        Raises:
          OSError: the place cannot be written.
        """
        text = json.dumps(plain(plans), allow_nan=False) + "\n"
        self._files.write_many({PLANS: text.encode()})

    def plans(self) -> list[dict[str, Any]]:
        """Returns what `write_plans` wrote, or nothing; InputError: no such list."""
        return self._body(PLANS, list[dict[str, Any]], b"[]")

    def _body(self, key: str, kind: type[_Body], nothing: bytes) -> _Body:
        """Reads a file beside the manifest as a type, `nothing` where there is none."""
        raw, name = self._files.read_json(key), self._files.path(key)
        with as_input_error(name, "JSON"):
            return checked(parse_json(raw or nothing), kind, name)

    def plot(self, site: int = 0) -> str:
        """Draws the plan of a site: lanes, and where and how fast people drove.

        Args:
          site: number of the recording, of the first few that have plans.

        Returns:
          The text of an SVG, which a notebook shows.

        Raises:
          InputError: there is no such plan, or no matplotlib.

        Examples:
            >>> rcirl_jax.open_dataset("data").plot()[:4]
            '<svg'
        """
        plans = self.plans()
        if not 0 <= site < len(plans):
            raise InputError(
                f"site: {site}: expected a number below {len(plans)}, of the plans in "
                f"{self._files.name}"
            )
        extra_module("matplotlib", "report")
        drawing = importlib.import_module("rcirl_jax.data.drawing")
        return drawing.site_svg(plans[site])

    def _arrays(self, shard: int) -> dict[str, ts.TensorStore]:
        """Returns the shard's arrays, opened once, of the shapes promised."""
        if shard in self._open:
            return self._open[shard]
        key, count = shard_key(shard), self.manifest.shards[shard]["count"]
        futures = {
            name: ts.open(
                {"driver": "zarr3"},
                kvstore=self._files.kv / f"{key}{name}/",
                open=True,
                context=context(),
            )
            for name in leaf_specs()
        }
        arrays = {}
        for name, leaf in leaf_specs().items():
            array = arrays[name] = self._files.wait(futures[name], key + name)
            where = f"{self._files.path(key + name)}: shard {shard}"
            kind, shape = array.dtype.numpy_dtype, array.shape
            grid, expected = array.chunk_layout, (count, *leaf.shape)
            if (kind, shape) != (leaf.dtype, expected):
                raise InputError(
                    f"{where}: {kind} {shape}: expected {leaf.dtype} {expected}"
                )
            chunks = (grid.read_chunk.shape, grid.write_chunk.shape)
            if chunks != layout(shape):  # a huge block would fill the memory
                raise InputError(f"{where}: chunks {chunks}: expected {layout(shape)}")
        if len(self._open) >= OPEN_SHARDS:
            self._open.pop(next(iter(self._open)))
        self._open[shard] = arrays
        return arrays

    def verify(self) -> None:
        """Checks every byte; InputError names the shard and the file at fault."""
        for number, shard in enumerate(self.manifest.shards):
            verify_shard(self._files, number, shard["sha256"])
            self._arrays(number)

    def split_groups(self) -> dict[str, list[int]]:
        """Returns the numbers of each split's groups."""
        number = {name: i for i, name in enumerate(self.manifest.groups)}
        splits = self.manifest.splits.items()
        return {split: [number[name] for name in names] for split, names in splits}

    def indices(self, split: str | None) -> np.ndarray:
        """Returns row numbers [m] int64 of a split (None: of all), ascending."""
        rows = np.arange(self.count)
        if split is None:
            return rows
        if split not in self.manifest.splits:
            known = ", ".join(self.manifest.splits)
            raise InputError(
                f"{self._files.path(MANIFEST)}: splits: {split}: expected {known}"
            )
        return rows[np.isin(self._groups, self.split_groups()[split])]

    @functools.cached_property
    def _groups(self) -> np.ndarray:
        return self.column("group")

    def blocks(self, indices: np.ndarray) -> np.ndarray:
        """Returns the number [m] of the block, unpacked together, of each row."""
        shard = np.searchsorted(self._starts, indices, side="right") - 1
        counts = -(-np.diff(self._starts) // BLOCK_ROWS)
        before = np.cumsum([0, *counts])[shard]
        return before + (indices - self._starts[shard]) // BLOCK_ROWS

    def read(self, indices: np.ndarray) -> Demonstration:
        """Reads rows by number, numpy leaves [m, ...], in the order asked for."""
        leaves = self.columns(tuple(leaf_specs()), indices)
        return jax.tree.unflatten(jax.tree.structure(row_spec()), leaves.values())

    def column(self, name: str) -> np.ndarray:
        """Reads one leaf of all rows, e.g. "scene.tags", numpy [n, ...]."""
        return self.columns((name,), np.arange(self.count))[name]

    def columns(
        self, names: Sequence[str], indices: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Reads some leaves of some rows, by name."""
        rows = np.asarray(indices, np.int64)
        if rows.ndim != 1 or np.any((rows < 0) | (rows >= self.count)):
            raise IndexError(f"rows: expected a list of numbers below {self.count}")
        spec = {name: leaf_specs()[name] for name in names}
        out = {k: np.empty((rows.size, *v.shape), v.dtype) for k, v in spec.items()}
        owner = np.searchsorted(self._starts, rows, side="right") - 1
        for shard in np.unique(owner).tolist():
            places, arrays = np.flatnonzero(owner == shard), self._arrays(shard)
            local = rows[places] - self._starts[shard]
            reads = {name: arrays[name][local].read() for name in names}
            for name, future in reads.items():
                key = f"{shard_key(shard)}{name}"
                out[name][places] = self._files.wait(future, key)
        return out


def open_dataset(url: str | os.PathLike[str], verify: bool = True) -> Dataset:
    """Opens a finished dataset.

    Args:
      url: dataset folder or tensorstore URL.
      verify: read every byte against its checksum first. Without it damage is
        found by crc32c when the damaged rows are read.

    Raises:
      InputError: no dataset, an interrupted import, another schema version, or
        damage; names the file.

    Examples:
        >>> dataset = rcirl_jax.open_dataset("data")
        >>> train, test = dataset.indices("train"), dataset.indices("test")
        >>> dataset.count == len(train) + len(test)
        True
    """
    files = Files(url)
    raw = files.read_json(MANIFEST)
    if raw is None:
        shards = any(key.startswith(SHARDS) for key in files.list_keys())
        reason = (
            "the import was interrupted: run import again to resume"
            if shards
            else "no dataset here: expected a folder made by `rcirl import`"
        )
        raise InputError(f"{files.path(MANIFEST)}: missing: {reason}")
    dataset = Dataset(files, parse_manifest(raw, files))
    if verify:
        dataset.verify()
    return dataset


class JoinedDatasets(Demonstrations):
    """Datasets one after the other; row numbers run on.

    Vehicle, recording and group numbers keep their meaning inside each part
    only, which is enough here: splits are those of the parts.
    """

    def __init__(
        self, parts: Sequence[Dataset], shares: Sequence[float] | None = None
    ) -> None:
        """Joins; with `shares` a source counts so much, whatever its number of scenes.

        A training scene of source i then weighs

            w_i = (N / n_i) share_i / sum of shares

        with n_i training scenes of N, so that weights have the mean 1.

        Args:
          parts: the sources.
          shares: > 0, one per source, as of `shares_of`; None: every scene weighs 1.
        """
        self.parts = tuple(parts)
        self._starts = np.cumsum([0, *(part.count for part in parts)])
        self.shares = None if shares is None else tuple(float(x) for x in shares)
        self._weights = np.ones(len(parts), np.float32)
        if shares is not None:
            given = np.asarray(shares, np.float64)
            sizes = np.array([part.indices("train").size for part in parts], float)
            each = sizes.sum() / np.maximum(sizes, 1.0) * given / given.sum()
            self._weights = each.astype(np.float32)

    @property
    def hash(self) -> str:
        """sha256 of the parts' hashes in order, and of their shares."""
        text = "\n".join(part.hash for part in self.parts)
        if self.shares is not None:
            text += f"\n{self.shares}"
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def count(self) -> int:
        """Number of rows."""
        return int(self._starts[-1])

    def _owners(self, indices: np.ndarray) -> np.ndarray:
        rows = np.asarray(indices, np.int64)
        return np.searchsorted(self._starts, rows, side="right") - 1

    def weights(self, indices: np.ndarray) -> np.ndarray:
        """Returns the weight [m] float32 of each scene in a training loss."""
        return self._weights[self._owners(indices)]

    def indices(self, split: str | None) -> np.ndarray:
        """Returns row numbers [m] int64 of a split (None: of all), ascending."""
        pairs = zip(self.parts, self._starts[:-1], strict=True)
        return np.concatenate([part.indices(split) + start for part, start in pairs])

    def blocks(self, indices: np.ndarray) -> np.ndarray:
        """Returns the number [m] of the block, unpacked together, of each row."""
        numbers, first = np.empty(indices.size, np.int64), 0
        owner = self._owners(indices)
        for number, part in enumerate(self.parts):
            at = owner == number
            numbers[at] = first + part.blocks(indices[at] - self._starts[number])
            first += int(part.blocks(np.array([part.count - 1]))[0]) + 1
        return numbers

    def read(self, indices: np.ndarray) -> Demonstration:
        """Reads rows by number, numpy leaves [m, ...], in the order asked for."""
        owner = self._owners(indices)
        found, places = [], []
        for number in np.unique(owner).tolist():
            at = np.flatnonzero(owner == number)
            rows = np.asarray(indices)[at] - self._starts[number]
            found.append(self.parts[number].read(rows))
            places.append(at)
        back = np.argsort(np.concatenate(places))
        return jax.tree.map(lambda *leaves: np.concatenate(leaves)[back], *found)


def shares_of(text: str, count: int) -> tuple[float, ...] | None:
    """Returns shares of `count` sources from "equal", "scenes", or one number each.

    Raises:
      InputError: none of these.
    """
    if text == SCENES or count == 1:
        return None
    if text == EQUAL:
        return (1.0,) * count
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(0.0 < x < np.inf for x in numbers):
        raise InputError(
            f"data_weights: {text}: expected {EQUAL}, {SCENES} or {count} numbers "
            "> 0 with commas, one per source"
        )
    return numbers


def open_datasets(
    urls: Sequence[str], verify: bool = True, weights: str = EQUAL
) -> Dataset | JoinedDatasets:
    """Opens one dataset as it is, or several joined.

    Args:
      urls: dataset folders or tensorstore URLs.
      weights: of `shares_of`.
      verify: read every byte against its checksum first.

    Raises:
      InputError: none named, one named twice, or one that does not open.
    """
    if not urls or len(set(urls)) != len(urls):
        raise InputError(f"data: {list(urls)}: expected distinct datasets")
    parts = [open_dataset(url, verify) for url in urls]
    shares = shares_of(weights, len(parts))
    return parts[0] if len(parts) == 1 else JoinedDatasets(parts, shares)
