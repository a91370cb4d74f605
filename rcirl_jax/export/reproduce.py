"""A weights file trained again from what it says of itself, and compared.

Everything that decides a training run is in the file's provenance: the configuration
(which the flags became), the seed, the hash of the data, versions and commit. A member
of a sweep has the whole grid there besides, and is trained with its group.
"""

import contextlib
import dataclasses
import datetime
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.errors import UNFORESEEN, InputError
from rcirl_jax.evaluation.ranking.sweep import (
    SweepConfig,
    member_name,
    open_split,
    train_group,
)
from rcirl_jax.export.from_run import (
    config_of,
    export_run,
    verification_samples,
)
from rcirl_jax.export.reader import RANGES, Reward
from rcirl_jax.export.sweep.run import write_member
from rcirl_jax.runtime.settings import typed_settings
from rcirl_jax.train.loop import train
from rcirl_jax.train.running import Running, of_today
from rcirl_jax.train.state import TrainConfig

NEEDED = ("config", "flags", "seed", "dataset_sha256")
# where all of these are the same, so is every bit
SETUP = ("versions", "git_commit", "machine", "cpu", "cores", "device", "devices")
# the same, in files that say it: older ones do not
ALSO = ("code_sha256", "environment")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reproduction:
    """How a file and its second training compare."""

    # tensor -> largest difference, of its largest entry; inf: another shape
    differences: Mapping[str, float]
    # what differs of the setup, in words; empty: every bit has to be the same
    warnings: tuple[str, ...]
    tolerance: float  # allowed where the setups differ

    @property
    def allowed(self) -> float:
        """The largest difference that still counts as reproduced."""
        return self.tolerance if self.warnings else 0.0

    @property
    def worst(self) -> tuple[str, float]:
        """The tensor that differs most; any where none does."""
        name = max(self.differences, key=lambda name: self.differences[name])
        return name, self.differences[name]

    @property
    def reproduced(self) -> bool:
        """Whether it is the same reward."""
        return self.worst[1] <= self.allowed

    def text(self) -> str:
        """One line of verdict."""
        name, most = self.worst
        found = "bit for bit" if most == 0.0 else f"{name} differs by {most:.3g}"
        word = "reproduced" if self.reproduced else "not reproduced"
        return f"{word}: {found} (of its largest entry; allowed: {self.allowed:g})"


def settings_of(reward: Reward, dataset: Demonstrations) -> TrainConfig:
    """The configuration that the file was trained with.

    Raises:
      InputError: the provenance lacks what a second training needs, is of other
        data, or of a run that was exported before its end.
    """
    _check_source(reward, dataset, (*NEEDED, "steps"))
    found, file = reward.provenance, reward.file
    config = _config_of(reward)
    per_epoch = -(-dataset.indices("train").size // config.batch_size)
    if found["steps"] != per_epoch * config.epochs:
        raise InputError(
            f"{file}: provenance.steps: {found['steps']}: expected "
            f"{per_epoch * config.epochs}, a run that was trained to its end"
        )
    return config


def is_member(reward: Reward) -> bool:
    """Whether the file is of a sweep that kept its grid."""
    return reward.provenance.get("sweep") is not None


def sweep_of(
    reward: Reward, dataset: Demonstrations, names: Sequence[str]
) -> SweepConfig:
    """The sweep whose member the file is.

    Args:
      reward: the file.
      dataset: its data.
      names: where they lie.

    Raises:
      InputError: as `settings_of`, or the file is no member of its own grid.
    """
    _check_source(reward, dataset, (*NEEDED, "sweep"))
    found, file = reward.provenance, reward.file
    with _of_this_version(f"{file}: provenance.sweep"):
        grid = dict(found["sweep"])
        grid |= {"base": of_today(grid["base"]), "data": list(names)}
        sweep = typed_settings(SweepConfig, grid)
    member = _config_of(reward)
    if member not in sweep.members():
        raise InputError(
            f"{file}: provenance.config: {member_name(member)}: expected a member of "
            "provenance.sweep"
        )
    return sweep


def _config_of(reward: Reward) -> TrainConfig:
    """The configuration that the file names; its network is the one in the file."""
    where = f"{reward.file}: provenance.config"
    with _of_this_version(where):
        config = config_of(reward.provenance["config"])
    config.reward.check_own()  # no file may name code to import
    hidden = tuple(len(bias) for bias in reward.biases[:-1])
    if config.reward.hidden != hidden:
        raise InputError(
            f"{where}.reward.hidden: {list(config.reward.hidden)}: expected "
            f"{list(hidden)}, the layers of the file"
        )
    return config


def _check_source(
    reward: Reward, dataset: Demonstrations, needed: Sequence[str]
) -> None:
    """Check that a file says what a second training needs, and is of these data."""
    found, file = reward.provenance, reward.file
    for name in needed:
        if found.get(name) in (None, "", {}):
            raise InputError(
                f"{file}: provenance.{name}: missing: expected a file that "
                "experiments.train, autotune or sweep of this version made"
            )
    if found["dataset_sha256"] != dataset.hash:
        raise InputError(
            f"{file}: provenance.dataset_sha256: {found['dataset_sha256']}: expected "
            f"that of the given data, {dataset.hash}"
        )


@contextlib.contextmanager
def _of_this_version(where: str) -> Iterator[None]:
    """What settings of another version end in, as one line."""
    try:
        yield
    except UNFORESEEN as error:
        raise InputError(
            f"{where}: {error}: expected settings of this version"
        ) from error


def setup_warnings(
    before: Mapping[str, Any], now: Mapping[str, Any]
) -> tuple[str, ...]:
    """What differs between two setups (provenances), in words."""
    said = []
    for name in (*SETUP, *(name for name in ALSO if name in before)):
        was, is_now = before.get(name), now.get(name)
        if isinstance(was, Mapping) and isinstance(is_now, Mapping):
            for key in sorted({*was, *is_now}):
                if was.get(key) != is_now.get(key):
                    said.append(f"{name}.{key}: {was.get(key)}, now {is_now.get(key)}")
        elif was != is_now:
            said.append(f"{name}: {was}, now {is_now}")
    if str(before.get("git_commit")).endswith("+"):
        said.append("git_commit: of a checkout with changes, which are not recorded")
    return tuple(said)


def train_again(
    reward: Reward,
    dataset: Demonstrations,
    folder: Path,
    provenance: Mapping[str, Any],
) -> Reward:
    """Train FOLDER/run as the file was trained and write FOLDER/weights.msgpack.

    Args:
      reward: the file.
      dataset: its data.
      folder: a new folder.
      provenance: of this run.

    Raises:
      InputError: as `settings_of`; the folder has a run.
    """
    config, flags = settings_of(reward, dataset), reward.provenance["flags"]
    workdir = folder / "run"
    if workdir.exists():
        raise InputError(f"{workdir}: exists: expected a folder without a run")
    train(
        dataset,
        workdir,
        config,
        running=Running(parallel=str(flags.get("parallel", "jit"))),
        provenance=dict(provenance),
    )
    output = folder / "weights.msgpack"
    ranges = reward.seen is not None
    # an anchor is no outcome of the training: it is handed on
    return export_run(workdir, dataset, output, ranges=ranges, anchor=reward.anchor)


def member_again(
    reward: Reward, sweep: SweepConfig, folder: Path, provenance: Mapping[str, Any]
) -> Reward:
    """Train the group of a sweep's member and write FOLDER/weights.msgpack.

    The members that were trained in one call with it are trained again beside it: the
    compiled program is theirs, and so is every bit.

    Args:
      reward: the file.
      sweep: of `sweep_of`.
      folder: a new folder.
      provenance: of this run.

    Raises:
      InputError: the folder has weights; a feature turns NaN or infinite.
    """
    output, member = folder / "weights.msgpack", config_of(reward.provenance["config"])
    if output.exists():
        raise InputError(f"{output}: exists: expected a folder without weights")
    dataset, split, _ = open_split(sweep, verify=False)
    samples = verification_samples(split, sweep.base)
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    made_by = {**provenance, "dataset_sha256": dataset.hash, "created": now}
    parts = train_group(member.reward.hidden, sweep)
    part = next(part for part in parts if member in part.members)
    number = part.members.index(member)
    return write_member(output, part, number, samples, sweep, made_by)


def compare(before: Reward, after: Reward) -> dict[str, float]:
    """Tensor -> largest difference, as a share of its largest entry.

    Raises:
      InputError: features, activation or loss are not the same.
    """
    for name in ("preset", "names", "units", "activation", "leaky_slope", "loss"):
        was, found = getattr(before, name), getattr(after, name)
        if was != found:
            raise InputError(f"{after.file}: {name}: {found}: expected {was}")
    ours, theirs = _tensors(before), _tensors(after)
    found = {}
    for name in {**ours, **theirs}:
        a, b = ours.get(name), theirs.get(name)
        if a is None or b is None or a.shape != b.shape:
            found[name] = float("inf")
        elif a.tobytes() == b.tobytes():
            found[name] = 0.0
        else:
            apart = np.max(np.abs(a.astype(np.float64) - b))
            largest = float(max(np.max(np.abs(a)), np.finfo(np.float32).tiny))
            found[name] = max(float(apart), np.finfo(np.float64).tiny) / largest
    return found


def _tensors(reward: Reward) -> dict[str, np.ndarray]:
    found = {name: getattr(reward, name) for name in (*RANGES, "times", "gamma")}
    found["none_values"] = np.asarray(reward.none_values)
    for number, (kernel, bias) in enumerate(
        zip(reward.kernels, reward.biases, strict=True)
    ):
        found |= {f"layers[{number}].kernel": kernel, f"layers[{number}].bias": bias}
    more = {"context": reward.context, "seen": reward.seen}
    return found | {name: value for name, value in more.items() if value is not None}
