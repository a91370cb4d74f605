"""Every reader by its name, with its share of the inputs."""

import dataclasses
import hashlib
import json
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reliability.fuzz import pieces
from benchmarks.reliability.fuzz.forms import resealed, toml_text
from benchmarks.reliability.fuzz.logs import LOGS
from benchmarks.reliability.fuzz.targets import Bytes, OneFile, Reader, Target
from rcirl_jax.data.importers.synthetic import reader as synthetic
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.data.store.files import FACTS, MANIFEST, MARK, Files
from rcirl_jax.data.store.manifest import parse_manifest, shard_entry
from rcirl_jax.data.store.shards import describe, shard_info
from rcirl_jax.evaluation.closed_loop.files import (
    COLUMNS,
    SuiteRuns,
    read_runs,
    write_runs,
)
from rcirl_jax.evaluation.closed_loop.likeness import read_arrays, write_arrays
from rcirl_jax.evaluation.gate.types import Likeness
from rcirl_jax.export.from_run import last_metrics, read_config
from rcirl_jax.export.loading import check_provenance
from rcirl_jax.export.reader import decode_weights
from rcirl_jax.export.sweep.folder import SWEEP
from rcirl_jax.export.sweep.result import read_sweep
from rcirl_jax.features import mapping
from rcirl_jax.runtime.atomic_files import write_json
from rcirl_jax.runtime.pipeline import Stages
from rcirl_jax.runtime.specs import load_toml, spec_root
from rcirl_jax.simulation.catalogue import families
from rcirl_jax.simulation.catalogue.build import build_case
from rcirl_jax.simulation.metrics import CaseMetrics
from rcirl_jax.train import checkpoint
from rcirl_jax.train.metrics import pairs_won
from rcirl_jax.train.running import check_run, describe_run
from rcirl_jax.train.state import TrainConfig
from tests.data.store import test_dataset as test_store
from tests.helpers.stored import sweep_result
from tests.helpers.weights_files import packed

ROWS = 2  # of a dataset
CASES = 2  # of a suite


def weights(folder: Path) -> Target:
    """Weights files of all four versions."""
    both = {"by_context": True, "seen": True}
    kinds = ({}, {"by_context": True}, both, {"by_context": True, "anchored": True})
    seeds = [packed(hidden=(2,), features=2, times=2, **kind) for kind in kinds]
    name = "weights.msgpack"

    def read(data: bytes) -> None:
        check_provenance(decode_weights(data, name).provenance, name)

    return Bytes(read, [("weights", seed) for seed in seeds], [name])


def _dataset(folder: Path) -> Path:
    place = folder / "dataset"
    test_store.write(place, (ROWS,))
    return place


def sealed(folder: Path) -> Target:
    """manifest.json and shard.json of a dataset, each with its own digest."""
    place = _dataset(folder)
    files = Files(place)
    mark = place / "shards" / "00000" / MARK

    def read() -> None:
        parse_manifest((place / MANIFEST).read_bytes(), files)
        shard_entry(shard_info(files, 0))

    return Target(read, [place / MANIFEST, mark])


def dataset(folder: Path) -> Target:
    """A dataset with all checksums made right, and rows read from it.

    Files after the manifest and shard.json are the chunks and the metadata of a few
    arrays. The manifest names the digest of shard.json, and that those of the arrays.
    """
    place = _dataset(folder)
    shard = place / "shards" / "00000"
    arrays = [shard / name for name in ("human.s", "group", "scene.tags")]
    files = [place / MANIFEST, shard / MARK]
    files += sorted(
        file for array in arrays for file in array.rglob("*") if file.is_file()
    )

    def read() -> None:
        found = open_dataset(place)
        for split in (None, *found.manifest.splits):
            found.indices(split)
        for name in ("human.s", "scene.tags"):
            found.column(name)

    return Target(read, files, after=lambda index: _chain(place, shard, files, index))


def made_by(folder: Path) -> Target:
    """What made a dataset, as it is read from beside the manifest."""
    made = open_dataset(_dataset(folder))
    made.write_facts({"git_commit": "2fe49aa", "flags": ["--stride=1"], "cores": 2})
    return Target(made.facts, [folder / "dataset" / FACTS])


def _chain(place: Path, shard: Path, files: list[Path], index: int) -> None:
    """Digests above a file that was changed."""
    if index == 0:
        return
    try:
        mark = json.loads((shard / MARK).read_text())
        if index > 1:
            key = files[index].relative_to(shard).as_posix()
            mark["files"][key] = describe(files[index].read_bytes())
            mark.pop("sha256")
            (shard / MARK).write_bytes(resealed(mark, "sha256"))
            mark = json.loads((shard / MARK).read_text())
        head = json.loads((place / MANIFEST).read_text())
        head["shards"][0]["sha256"] = mark["sha256"]
        head.pop("hash")
        (place / MANIFEST).write_bytes(resealed(head, "hash"))
    except (ValueError, LookupError, TypeError, RecursionError):
        return


def _tomls(folder: Path, kind: str, read: Callable[[Path], object]) -> Target:
    """The packaged TOML files of one folder, each read alone."""
    folder.mkdir(parents=True)
    files = []
    for packaged in sorted((spec_root() / kind).glob("*.toml")):
        files.append(folder / packaged.name)
        files[-1].write_text(toml_text(load_toml(packaged)))
    return OneFile(read, files)


def toml(folder: Path) -> Target:
    """Any TOML file, as people write them."""
    folder.mkdir(parents=True)
    file = folder / "csv.toml"
    text = (spec_root() / "sources" / "csv.toml").read_text().splitlines()
    file.write_text("\n".join(line.split(" #")[0] for line in text[3:]))
    return OneFile(load_toml, [file])


def features(folder: Path) -> Target:
    """Presets of features."""
    mapping.spec_root = lambda: folder  # the folder of presets is fixed
    fresh = mapping.feature_map.__wrapped__
    return _tomls(folder / "features", "features", lambda file: fresh(file.stem))


def scenarios(folder: Path) -> Target:
    """Families of scenarios, and the first case that each makes."""

    def read(file: Path) -> None:
        family = families.load_family.__wrapped__(str(file))
        if not family.compound:
            build_case(family, 0)

    return _tomls(folder, "scenarios", read)


def traffic(folder: Path) -> Target:
    """Synthetic traffic: its TOML; nothing is simulated."""
    spec = load_toml(spec_root() / "sources" / "synthetic.toml")
    made = folder / "traffic"
    made.mkdir(parents=True)
    file = made / "synthetic.toml"
    file.write_text(toml_text(spec))
    return OneFile(lambda path: synthetic.recordings(path, spec), [file])


def suite(folder: Path) -> Target:
    """The metrics of a suite."""
    folder.mkdir(parents=True)
    file = folder / "suite.npz"
    names = [field.name for field in dataclasses.fields(CaseMetrics)]
    values: dict[str, Any] = {
        name: np.ones((CASES, *COLUMNS.get(name, ())), np.float32) for name in names
    }
    metrics = CaseMetrics(**values)
    runs = SuiteRuns(
        rows={"ours": metrics},
        ids=("a", "b"),
        groups=("g", "g"),
        preventable=np.ones(CASES, bool),
        trivial=np.zeros(CASES, bool),
        reference="ours",
        way=np.ones(CASES),
    )
    write_runs(file, runs)
    return OneFile(read_runs, [file])


def distances(folder: Path) -> Target:
    """The held-out drives' distances to the human."""
    folder.mkdir(parents=True)
    file = folder / "likeness.npz"
    known = Likeness(distance={"ours": np.ones(CASES)}, clusters=np.arange(CASES))
    write_arrays(file, known)
    return OneFile(read_arrays, [file])


def checkpoints(folder: Path) -> Target:
    """The digests of a checkpoint's files, and its position; no array is restored."""
    step = folder / "3"
    step.mkdir(parents=True)
    (step / "state").write_bytes(b"numbers")
    found = {"state": hashlib.sha256(b"numbers").hexdigest()}
    noted = step / checkpoint.DIGESTS
    noted.write_text(json.dumps({"files": found, "sha256": checkpoint.digest(found)}))
    position = folder / checkpoint.POSITION  # outside of what has digests
    position.write_text(json.dumps({"epoch": 1, "position": 12, "seed": 0}))

    def read() -> None:
        checkpoint._newest_whole(folder)
        checkpoint.read_position(position)

    return Target(read, [noted, position], (str(folder),))


def runs(folder: Path) -> Target:
    """run.json, as it is resumed and exported from."""
    folder.mkdir(parents=True)
    data: Any = types.SimpleNamespace(hash="d" * 64)
    describe_run(folder, TrainConfig(), data, {"git_commit": "2fe49aa"})

    def read() -> None:
        check_run(folder, TrainConfig(), data)
        read_config(folder)

    return Target(read, [folder / "run.json"])


def stages(folder: Path) -> Target:
    """stages.json: compared with what is there, a stage done, another forgotten."""
    folder.mkdir(parents=True)
    (folder / "weights.msgpack").write_bytes(b"weights")
    (folder / "verdict.json").write_text("{}")
    made = Stages(folder=folder)
    for name, file in (("train", "weights.msgpack"), ("gate", "verdict.json")):
        made.run(name, {"seed": 0}, [folder / file], lambda: None)

    def read() -> None:
        work = lambda: (folder / "weights.msgpack").write_bytes(b"weights")  # noqa: E731
        outputs = [folder / "weights.msgpack"]
        made.run("train", {"seed": 0}, outputs, work, stale=("gate",))

    return Target(read, [folder / "stages.json"])


def metrics(folder: Path) -> Target:
    """metrics.jsonl as a resume, an export and the choice between seeds read it."""
    folder.mkdir(parents=True)
    file = folder / "metrics.jsonl"
    line = {"loss": 0.5, "pair_accuracy": 0.75, "pairs": 64.0, "queries_per_s": None}
    rows = [{"step": step, **line} for step in (1, 2, 3)]
    file.write_text("".join(json.dumps(row) + "\n" for row in rows))

    def read() -> None:
        last_metrics(folder)
        pairs_won(file, 2)

    return Target(read, [file])


def sweeps(folder: Path) -> Target:
    """The result of a sweep; what it resumes from are `stages`."""
    folder.mkdir(parents=True)
    write_json(folder / SWEEP, sweep_result())
    names = (str(folder),)
    return Target(lambda: read_sweep(folder), [folder / SWEEP], names)


READERS: dict[str, Reader] = {
    "weights": Reader(make=weights, share=5, words=("sha256", "<f4", "tanh")),
    "descriptors": Reader(make=pieces.descriptors_target, share=4),
    "geometry": Reader(make=pieces.geometry_target, share=4),
    "tfrecord": Reader(make=pieces.tfrecord_target, share=3),
    "sealed": Reader(make=sealed, words=("schema_version", "shards")),
    "dataset": Reader(make=dataset),
    "made_by": Reader(make=made_by),
    "toml": Reader(make=toml, share=2, words=("[[", "]]", '"""', "1979-05-27")),
    "features": Reader(make=features),
    "scenarios": Reader(make=scenarios),
    "traffic": Reader(make=traffic),
    "suite": Reader(make=suite),
    "distances": Reader(make=distances, share=3),
    "checkpoints": Reader(make=checkpoints, share=2),
    "runs": Reader(make=runs),
    "stages": Reader(make=stages),
    "metrics": Reader(make=metrics),
    "sweeps": Reader(make=sweeps),
    "lanelet2": Reader(make=pieces.lanelet2_target),
    **{name: Reader(make=make) for name, make in LOGS.items()},
}


def shares(names: list[str], inputs: int) -> dict[str, int]:
    """Inputs by reader."""
    total = sum(READERS[name].share for name in names)
    return {name: -(-inputs * READERS[name].share // total) for name in names}
