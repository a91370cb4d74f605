"""How a run goes about its work, and the file that says what it is."""

import dataclasses
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import read_json, write_whole
from rcirl_jax.train.processes import is_first
from rcirl_jax.train.state import TrainConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class Running:
    """How a run goes about its work; nothing here changes its result."""

    # "jit", or over the devices of all processes "pmap" or "shard_map"
    parallel: str = "jit"
    # MiB of scenes up to which the training split is loaded whole
    in_memory_mb: float = 1024.0
    # batches read ahead of the step
    prefetch: int = 4
    # steps between checkpoints, besides those at the end of each epoch (0: none)
    checkpoint_every: int = 0
    # of `rcirl_jax.train.trackers`; None: TensorBoard if it is installed
    trackers: tuple[str, ...] | None = None
    # called with the number of each finished step
    on_step: Callable[[int], None] = lambda step: None

    def __post_init__(self) -> None:
        """Reject values out of range with the flag's name."""
        least = {"in_memory_mb": 0, "prefetch": 1, "checkpoint_every": 0}
        for name, low in least.items():
            value = getattr(self, name)
            if not value >= low:
                raise InputError(f"{name}: {value}: expected >= {low}")


def check_run(workdir: Path, config: TrainConfig, dataset: Demonstrations) -> None:
    """Check that an existing run.json says the same.

    Raises:
      InputError: the folder holds a run with other settings (names the first).
    """
    path = workdir / "run.json"
    if not path.exists():
        return
    found = _read_run(path)
    made = of_today(found["config"])
    described = _described(config, dataset)
    usual = _described(TrainConfig(), dataset)["config"]  # of settings added since
    if found.get("dataset_hash") != described["dataset_hash"]:
        raise InputError(f"{path}: dataset_hash: made from another dataset")
    for name in made:
        if name not in described["config"]:
            raise InputError(f"{path}: {name}: unknown: expected a run of this version")
    for name, setting in described["config"].items():
        before = made.get(name, usual[name])
        if isinstance(before, dict) and isinstance(usual[name], dict):
            before = {**usual[name], **before}
        if before != setting and name != "epochs":
            raise InputError(
                f"{path}: {name}: {before}: expected {setting} to resume; "
                "use another folder for other settings"
            )


def of_today(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a run without removed ones that had no effect.

    A run that also learned from judgements keeps `preferences`, which is unknown.
    """
    gone = ["preference_weight"]
    if not settings.get("preferences"):
        gone.append("preferences")
    return {name: value for name, value in settings.items() if name not in gone}


def describe_run(
    workdir: Path, config: TrainConfig, dataset: Demonstrations, provenance: dict
) -> None:
    """Write run.json (process 0)."""
    if not is_first():
        return
    path = workdir / "run.json"
    text = json.dumps({**_described(config, dataset), **provenance}, indent=2)
    write_whole(path, text + "\n")


def _described(config: TrainConfig, dataset: Demonstrations) -> dict:
    return {
        "config": json.loads(json.dumps(dataclasses.asdict(config))),
        "dataset_hash": dataset.hash,
    }


def _read_run(path: Path) -> dict:
    """The contents of run.json; one line if it is not the file of a run."""
    found = read_json(path, "the file of a training run")
    try:
        if isinstance(found["config"], dict):
            return found
        reason = "config: not a table"
    except (KeyError, TypeError) as error:
        reason = f"{type(error).__name__}: {error}"
    raise InputError(f"{path}: {reason}: expected the file of a training run")
