"""Checkpoints by orbax, which only this module imports.

    checkpoints/STEP/              as orbax writes it, under another name until whole
    checkpoints/STEP/position.json the data position; by this module, then
    checkpoints/STEP/sha256.json   digests of all its files: it is finished
    checkpoints/STEP.damaged/      put aside by a run that went on from an older one

orbax keeps no checksum of the arrays: the digests find what changed on disk.
"""

import contextlib
import os
import shutil
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from orbax.checkpoint import v1 as ocp

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import read_json, write_json
from rcirl_jax.runtime.checked import checked
from rcirl_jax.runtime.pipeline import digest, file_sha256
from rcirl_jax.train.parallel import is_first
from rcirl_jax.train.state import TrainState

KEEP_LATEST = 3  # checkpoints kept
DIGESTS = "sha256.json"
POSITION = "position.json"
DAMAGED = ".damaged"
PROBE = ".room"
OVERHEAD_BYTES = 2**17  # of a checkpoint's files besides the arrays


class Checkpoints:
    """Saves and restores (TrainState, data position) under one folder.

    Saving is asynchronous. The data position makes a resumed run see the same batches
    in the same order; it lies beside orbax's files, because orbax never frees the
    memory of metadata that it reads.

    `passed_over` has one line for each checkpoint that is newer than the newest
    whole one, which is the one to go on from.
    """

    def __init__(self, folder: Path, *, read_only: bool = False) -> None:
        """Find the newest whole checkpoint; put damaged ones newer than it aside.

        Args:
          folder: of the checkpoints; made if missing.
          read_only: leave everything there as it is, also what another process is
            writing just now.

        Raises:
          InputError: there are checkpoints, and none is whole.
        """
        self._folder = folder.resolve()
        if not read_only:
            self._folder.mkdir(parents=True, exist_ok=True)
        self._newest, bad = _newest_whole(self._folder)
        self.passed_over = [
            f"{self._folder}: checkpoint {step}: {why}; the one before it that is "
            f"whole: {'none' if self._newest is None else self._newest}"
            for step, why in bad.items()
        ]
        if not read_only:
            _put_aside(self._folder, list(bad))
        keep: Any = ocp.training.preservation_policies.LatestN(KEEP_LATEST)
        self._checkpointer = ocp.training.Checkpointer(
            str(self._folder),
            preservation_policy=keep,
            cleanup_tmp_directories=not read_only,
        )
        self._thread = ThreadPoolExecutor(1)
        self._pending: Future[None] | None = None

    def latest_step(self) -> int | None:
        """Step of the newest whole checkpoint when this was made, or None."""
        return self._newest

    def save(self, state: TrainState, position: dict) -> None:
        """Start saving; returns before the files are complete.

        Once a step. With several processes all of them call it, and the state has
        to be on the devices of all.

        Raises:
          InputError: this one or the one before cannot be written.
        """
        step = int(state.step)
        with self._writing():
            self._finish_pending()
            if is_first():
                _check_room(self._folder, state)
            response: Any = self._checkpointer.save_async(step, state, force=True)
            self._pending = self._thread.submit(self._seal, step, response, position)

    def _seal(self, step: int, response: Any, position: dict) -> None:  # noqa: ANN401
        """Once the files are complete, note the position and what they are."""
        response.result()
        if is_first():
            folder = self._folder / str(step)
            write_json(folder / POSITION, position)
            found = _digests(folder)
            write_json(folder / DIGESTS, {"files": found, "sha256": digest(found)})

    def _finish_pending(self) -> None:
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.result()

    def restore(self, like: TrainState) -> tuple[TrainState, dict]:
        """The newest whole checkpoint and its data position.

        Args:
          like: a state of the same structure; only shapes are read.

        Raises:
          InputError: the checkpoint was written with another structure, or its
            position is none.
        """
        step = self._newest
        abstract = jax.tree.map(_abstract, like)
        try:
            state = self._checkpointer.load(step, abstract)
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{self._folder}: checkpoint {step}: {_first_line(error)}: "
                "expected the same features, hidden size and optimiser"
            ) from error
        return state, read_position(self._folder / str(step) / POSITION)

    def close(self) -> None:
        """Wait for pending saves and release the folder.

        Raises:
          InputError: the last checkpoint could not be written.
        """
        with self._writing():
            try:
                self._finish_pending()
            finally:
                self._thread.shutdown()
                self._checkpointer.close()

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Failures of writing, which come late, as one line."""
        try:
            yield
        except (OSError, RuntimeError, ValueError) as error:
            raise InputError(
                f"{self._folder}: cannot be written: {_first_line(error)}: expected "
                "room for a checkpoint; the ones before are kept, run again to go on"
            ) from error


def read_position(path: Path) -> dict[str, int]:
    """The data position beside a checkpoint's state.

    Raises:
      InputError: the file is none.
    """
    return checked(read_json(path, "a data position"), dict[str, int], path)


def _check_room(folder: Path, state: TrainState) -> None:
    """Write and remove as many bytes as a checkpoint may take.

    Where it cannot write, orbax waits for minutes and fills the terminal.
    """
    held = sum(np.asarray(_numbers(leaf)).nbytes for leaf in jax.tree.leaves(state))
    probe = folder / PROBE
    try:
        with probe.open("wb") as file:
            file.write(bytes(2 * held + OVERHEAD_BYTES))
            file.flush()
            os.fsync(file.fileno())
    finally:
        with contextlib.suppress(OSError):
            probe.unlink(missing_ok=True)


def _numbers(leaf: jax.Array) -> jax.Array:
    """Typed keys as what they are made of."""
    is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return jax.random.key_data(leaf) if is_key else leaf


def _newest_whole(folder: Path) -> tuple[int | None, dict[int, str]]:
    """The newest whole checkpoint, and what is wrong with each newer one.

    Raises:
      InputError: there are finished ones, and none is whole.
    """
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    steps = sorted((int(name) for name in names if name.isdecimal()), reverse=True)
    bad: dict[int, str] = {}
    for step in steps:
        why = _damage(folder / str(step))
        if why is None:
            return step, bad
        bad[step] = why
    if not any((folder / str(step) / DIGESTS).exists() for step in steps):
        return None, bad  # killed while it wrote the first ones
    reasons = "; ".join(f"{step}: {why}" for step, why in bad.items())
    raise InputError(
        f"{folder}: checkpoint {reasons}: expected one that is whole; use another "
        "folder to start again"
    )


def _damage(folder: Path) -> str | None:
    """What is wrong with a checkpoint, if anything."""
    try:
        if not (folder / DIGESTS).exists():
            return f"{DIGESTS}: missing, it was not finished"
        noted = read_json(folder / DIGESTS, "digests")
        files = noted["files"]
        if not isinstance(files, dict) or noted["sha256"] != digest(files):
            return f"{DIGESTS}: damaged"
    except (ValueError, KeyError, TypeError):
        return f"{DIGESTS}: damaged"
    found = _digests(folder)
    for name in sorted(files.keys() | found.keys()):
        if files.get(name) != found.get(name):
            return f"{name}: {'damaged' if name in found else 'missing'}"
    return None


def _digests(folder: Path) -> dict[str, str]:
    """sha256 of every file of a checkpoint by its name inside the folder."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    names = {path: path.relative_to(folder).as_posix() for path in files}
    return {name: file_sha256(path) for path, name in names.items() if name != DIGESTS}


def _put_aside(folder: Path, steps: list[int]) -> None:
    """Rename damaged checkpoints: their numbers will be written again."""
    if not steps:
        return
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices("damaged checkpoints found")
    if is_first():
        for step in steps:
            aside = folder / f"{step}{DAMAGED}"
            shutil.rmtree(aside, ignore_errors=True)
            (folder / str(step)).rename(aside)
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices("damaged checkpoints put aside")


def _first_line(error: BaseException) -> str:
    text = (str(error).splitlines() or [""])[0][:200]
    return text or type(error).__name__


def _abstract(leaf: jax.Array) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding)
