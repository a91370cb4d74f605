"""The commands that are disturbed, on small data, and what has to come out of each.

Every run has a folder of its own and names it by relative paths, so that everything
written is equal to the byte, but for times: `created` in weights files, rates and
seconds in metrics and sweeps. Those are left out, and a dataset's `made_by.json`, which
holds flags and machine.
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path

import jax
import numpy as np

from rcirl_jax.data.store.files import FACTS
from rcirl_jax.export.from_run import read_config
from rcirl_jax.export.weights import to_json
from rcirl_jax.runtime.pipeline import FILE, digest, file_sha256
from rcirl_jax.train.loop import restore_run
from tests.data import small_logs

Facts = Mapping[str, str]  # what came out -> digest
SAID = ("ranking.json", "verdict.json")  # what a tuning run says


@dataclasses.dataclass(frozen=True, kw_only=True)
class Job:
    """A command and what it makes in its folder."""

    name: str
    module = "rcirl_jax"
    flags: tuple[str, ...]
    outcome: Callable[[Path], Facts]
    finished: Callable[[Path], int]  # things in its folder that are finished


def different(found: Facts, expected: Facts) -> list[str]:
    """Returns what did not come out as expected, by name."""
    names = sorted(found.keys() | expected.keys())
    return [name for name in names if found.get(name) != expected.get(name)]


def write_logs(folder: Path) -> None:
    """CSV logs of platoons on a straight road."""
    small_logs.write_logs(folder, files=8, seconds=20.0)


def jobs(root: Path) -> dict[str, Job]:
    """The four commands; `root` holds logs/ and data/, the dataset of them."""
    logs = ("--format=csv", f"--input={root / 'logs'}")
    data = f"--data={root / 'data'}"
    steps = ("--batch_size=8", "--epochs=3")
    made = [
        Job(
            name="import",
            flags=("import", *logs, "--output=data", "--stride=1", "--workers=2"),
            outcome=lambda folder: _files(folder / "data"),
            finished=_files_like("data/shards/*/shard.json"),
        ),
        Job(
            name="train",
            flags=("train", data, "--output=run", *steps, "--checkpoint_every=3"),
            outcome=_of_training,
            finished=_files_like("run/checkpoints/*/sha256.json"),  # 3 are kept
        ),
        Job(
            name="sweep",
            flags=(
                "sweep",
                *(data, "--output=sweep", "--quick", "--batch_size=8"),
                *("--recipe=paper", "--hidden_sizes=6,0", "--leaky_rates=0.05,0.3"),
            ),
            outcome=_of_sweep,
            finished=_files_like("sweep/groups/*.json"),
        ),
        Job(
            name="autotune",
            flags=(
                "autotune",
                *(*logs, "--output=run", "--stride=2", "--batch_size=8"),
                *("--epochs=1", "--suite=free_cruise,stopped_lead"),
                *("--cases=15", "--duration=2"),  # the gate judges no fewer
            ),
            outcome=_of_tuning,
            finished=lambda folder: _stages(folder / "run" / FILE),
        ),
    ]
    return {job.name: job for job in made}


def _files_like(pattern: str) -> Callable[[Path], int]:
    """Of a folder, the number of its files that match."""
    return lambda folder: sum(1 for _ in folder.glob(pattern))


def _stages(path: Path) -> int:
    """The finished stages that a stages.json names."""
    return len(json.loads(path.read_text())["stages"]) if path.exists() else 0


def _files(folder: Path) -> Facts:
    """Of every file, whatever it is called, but who made it with which flags."""
    files = [x for x in folder.rglob("*") if x.is_file() and x.name != FACTS]
    return {str(path.relative_to(folder)): file_sha256(path) for path in files}


def _of_training(folder: Path) -> Facts:
    """All of the last state (weights, optimiser, key, step), and the metrics."""
    run = folder / "run"
    state = restore_run(run, read_config(run)[0])
    plain = state.replace(key=jax.random.key_data(state.key))
    found = {
        jax.tree_util.keystr(name): hashlib.sha256(np.asarray(leaf).tobytes())
        for name, leaf in jax.tree_util.tree_leaves_with_path(plain)
    }
    return {
        **{name: sha.hexdigest() for name, sha in found.items()},
        "metrics.jsonl": digest(_untimed_metrics(run / "metrics.jsonl")),
    }


def _untimed_metrics(path: Path) -> list[dict]:
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    return [{k: v for k, v in x.items() if k != "queries_per_s"} for x in lines]


def _of_weights(path: Path) -> str:
    """The body of a weights file: tensors, samples, provenance but for times."""
    body = to_json(path.read_bytes())
    provenance = body["provenance"]
    del provenance["created"]
    provenance["metrics"].pop("queries_per_s", None)
    return digest(body)


def _weights_below(folder: Path) -> Facts:
    files = sorted(folder.rglob("*.msgpack"))
    return {str(x.relative_to(folder)): _of_weights(x) for x in files}


def _of_sweep(folder: Path) -> Facts:
    """Every member's weights, the choice and the table of sweep.json."""
    report = json.loads((folder / "sweep" / "sweep.json").read_text())
    for member in report["members"].values():
        del member["sha256"]  # of a file that says when it was made
    del report["groups"]  # seconds, compiles
    del report["made_by"]["created"]
    return {"sweep.json": digest(report), **_weights_below(folder / "sweep")}


def _of_tuning(folder: Path) -> Facts:
    """Dataset, weights, ranking, drives, verdict."""
    run = folder / "run"
    (data,) = run.glob("dataset-*")
    names = ("ranking.txt", "suite/metrics.npz", "suite/cases.csv")
    said = {name: json.loads((run / name).read_text()) for name in SAID}
    for body in said.values():
        del body["made_by"]["weights_sha256"]  # of files that say when they were made
    return {
        **{name: file_sha256(run / name) for name in names},
        **{name: digest(body) for name, body in said.items()},
        **{f"dataset/{name}": sha for name, sha in _files(data).items()},
        **_weights_below(run),
    }
