"""Every reader by its name, with sound files that it reads."""

import collections
import contextlib
import dataclasses
import hashlib
import itertools
import json
import random
import types
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reliability.fuzz.forms import mutate, resealed
from rcirl_jax.data.formats import read_recordings
from rcirl_jax.data.formats.csv.suggest import suggested
from rcirl_jax.data.formats.recognise import recognised_format
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.data.store.files import MANIFEST, MARK, describe
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.runs import (
    COLUMNS,
    SuiteRuns,
    read_runs,
    write_runs,
)
from rcirl_jax.export.from_run import last_metrics, read_config
from rcirl_jax.export.loading import check_provenance
from rcirl_jax.export.reader import decode_weights
from rcirl_jax.export.sweep import SWEEP, read_sweep
from rcirl_jax.features import mapping
from rcirl_jax.runtime.atomic_files import write_json
from rcirl_jax.runtime.pipeline import Stages
from rcirl_jax.runtime.specs import spec_root
from rcirl_jax.simulation import families
from rcirl_jax.simulation.catalogue import build_case
from rcirl_jax.simulation.metrics import CaseMetrics
from rcirl_jax.train import checkpoint
from rcirl_jax.train.loop import check_run, describe_run
from rcirl_jax.train.metrics import pairs_won
from rcirl_jax.train.state import TrainConfig
from tests.data.formats import fixtures as formats
from tests.data.formats import people, test_csv_meaning, test_csv_ways
from tests.data.store import test_dataset as test_store
from tests.helpers.stored import sweep_result
from tests.helpers.weights_files import packed


@dataclasses.dataclass(frozen=True, kw_only=True)
class Target:
    """A reader and the files it reads, of which one is another at a time."""

    read: Callable[[Path], object]  # given the file that was changed
    files: Sequence[Path]
    # makes the sums of other files fit the one just written
    after: Callable[[Path], None] = lambda file: None

    def changed(self, rng: random.Random) -> Iterator[Path]:
        """Files as they are changed, without end; all others are sound."""
        sound = {file: file.read_bytes() for file in self.files}
        while True:
            file = rng.choice(self.files)
            file.write_bytes(mutate(sound[file], file.name, rng))
            self.after(file)
            try:
                yield file
            finally:
                for name, content in sound.items():
                    name.write_bytes(content)


def log(form: str, write: Callable[[Path], formats.Fixture]) -> Callable:
    """A whole import: the fixture's files, read as by the command."""

    def target(folder: Path) -> Target:
        place, source = folder / "log", folder / "source.toml"
        place.mkdir()
        fixture = write(place)
        source.write_text((spec_root() / "sources" / f"{form}.toml").read_text())

        def read(file: Path) -> None:
            collections.deque(read_recordings(form, fixture.input, source), maxlen=0)

        return Target(read=read, files=[*fixture.files, source])

    return target


WAYS = ("decimal commas", "ISO with a zone", "degrees", "Parquet: as they are", "bz2")


def tables(folder: Path) -> Target:
    """Tables of a user's own, each with its TOML."""
    ways = [test_csv_ways.WAYS[name] for name in WAYS]
    ways += [test_csv_meaning.side_by_side(), test_csv_meaning.a_row_per_vehicle()]
    files = []
    for number, way in enumerate(ways):
        place = folder / str(number)
        place.mkdir()
        files += people.put(place, way, "long_bytes = 1\nmax_bad_rows = 0.2")

    def read(file: Path) -> None:
        log, spec = file.parent / "log.csv", file.parent / "map.toml"
        collections.deque(read_recordings("csv", log, spec), maxlen=0)

    return Target(read=read, files=files)


def suggestions(folder: Path) -> Target:
    """Tables of which nothing is said: the format recognised, the TOML suggested."""
    files = tables(folder).files[::2]

    def read(file: Path) -> None:
        with contextlib.suppress(InputError):
            recognised_format(file)
        suggested(file)

    return Target(read=read, files=files)


def weights(folder: Path) -> Target:
    """Weights files with and without scene gating and a prior cost."""
    kinds = ({}, {"scene_gating": True}, {"scene_gating": True, "with_prior": True})
    files = [folder / f"{number}.msgpack" for number in range(len(kinds))]
    for file, kind in zip(files, kinds, strict=True):
        file.write_bytes(packed(hidden=(2,), features=2, times=2, **kind))

    def read(file: Path) -> None:
        name = str(file)
        check_provenance(decode_weights(file.read_bytes(), name).provenance, name)

    return Target(read=read, files=files)


def dataset(folder: Path) -> Target:
    """A dataset with all checksums made right, and rows read from it.

    The manifest names the digest of shard.json, and that those of the arrays.
    """
    test_store.write(folder, (2,))
    shard = folder / "shards" / "00000"
    arrays = [shard / name for name in ("human.s", "group", "scene.tags")]
    parts = [x for array in arrays for x in sorted(array.rglob("*")) if x.is_file()]

    def read(file: Path) -> None:
        found = open_dataset(folder)
        for split in (None, *found.manifest.splits):
            found.indices(split)
        for name in ("human.s", "scene.tags"):
            found.column(name)

    def seal(file: Path) -> None:
        if file.name == MANIFEST:
            return
        with contextlib.suppress(ValueError, LookupError, TypeError, RecursionError):
            mark = json.loads((shard / MARK).read_text())
            if file.name != MARK:
                key = file.relative_to(shard).as_posix()
                mark["files"][key] = describe(file.read_bytes())
                (shard / MARK).write_bytes(resealed(mark, "sha256"))
                mark = json.loads((shard / MARK).read_text())
            head = json.loads((folder / MANIFEST).read_text())
            head["shards"][0]["sha256"] = mark["sha256"]
            (folder / MANIFEST).write_bytes(resealed(head, "hash"))

    return Target(
        read=read, files=[folder / MANIFEST, shard / MARK, *parts], after=seal
    )


def packaged(kind: str, read: Callable[[Path], object]) -> Callable[[Path], Target]:
    """The packaged TOML files of one folder, each read alone."""

    def target(folder: Path) -> Target:
        files = []
        for file in sorted((spec_root() / kind).glob("*.toml")):
            files.append(folder / kind / file.name)
            files[-1].parent.mkdir(exist_ok=True)
            files[-1].write_text(file.read_text())
        return Target(read=read, files=files)

    return target


def _preset(file: Path) -> None:
    mapping.spec_root = lambda: file.parents[1]  # the folder of presets is fixed
    mapping.feature_map.__wrapped__(file.stem)


def _scenario(file: Path) -> None:
    family = families.load_family.__wrapped__(str(file))
    if not family.compound:
        build_case(family, 0)


def suite(folder: Path) -> Target:
    """The metrics of a suite of two cases."""
    file = folder / "suite.npz"
    values: dict[str, Any] = {
        field.name: np.ones((2, *COLUMNS.get(field.name, ())), np.float32)
        for field in dataclasses.fields(CaseMetrics)
    }
    runs = SuiteRuns(
        rows={"ours": CaseMetrics(**values)},
        ids=("a", "b"),
        groups=("g", "g"),
        preventable=np.ones(2, bool),
        trivial=np.zeros(2, bool),
        reference="ours",
        way=np.ones(2),
    )
    write_runs(file, runs)
    return Target(read=read_runs, files=[file])


def run(folder: Path) -> Target:
    """Reads what a run is resumed and exported from; no array is restored."""
    data: Any = types.SimpleNamespace(hash="d" * 64)
    describe_run(folder, TrainConfig(), data, {"git_commit": "2fe49aa"})
    step, line = folder / "3", {"loss": 0.5, "pair_accuracy": 0.75, "pairs": 64.0}
    step.mkdir()
    (step / "state").write_bytes(b"numbers")
    found = {"state": hashlib.sha256(b"numbers").hexdigest()}
    digests = step / checkpoint.DIGESTS
    digests.write_text(json.dumps({"files": found, "sha256": checkpoint.digest(found)}))
    metrics, sweep = folder / "metrics.jsonl", folder / SWEEP
    rows = [json.dumps({"step": k, **line, "queries_per_s": None}) for k in (1, 2, 3)]
    metrics.write_text("\n".join(rows) + "\n")
    write_json(sweep, sweep_result())
    readers = {
        folder / "run.json": lambda: (
            check_run(folder, TrainConfig(), data),
            read_config(folder),
        ),
        metrics: lambda: (last_metrics(folder), pairs_won(metrics, 2)),
        sweep: lambda: read_sweep(folder),
        digests: lambda: checkpoint._newest_whole(folder),
    }
    return Target(read=lambda file: readers[file](), files=[*readers])


def stages(folder: Path) -> Target:
    """stages.json: compared with what is there, a stage done, another forgotten."""
    outputs, verdict = [folder / "weights.msgpack"], [folder / "verdict.json"]
    made = Stages(folder=folder)

    def train() -> None:
        outputs[0].write_bytes(b"weights")

    def read(file: Path) -> None:
        made.run("train", {"seed": 0}, outputs, train, stale=("gate",))

    made.run("train", {"seed": 0}, outputs, train)
    made.run("gate", {}, verdict, lambda: verdict[0].write_text("{}"))
    return Target(read=read, files=[folder / "stages.json"])


READERS: dict[str, Callable[[Path], Target]] = {
    "weights": weights,
    "dataset": dataset,
    "features": packaged("features", _preset),
    "scenarios": packaged("scenarios", _scenario),
    "suite": suite,
    "run": run,
    "stages": stages,
    "tables": tables,
    "suggestions": suggestions,
    **{n: log(formats.format_of(n), x.write) for n, x in formats.modules().items()},
}


def inputs(target: Target, seed: str, count: int) -> Iterator[Path]:
    """So many changed files of a target."""
    return itertools.islice(target.changed(random.Random(seed)), count)
