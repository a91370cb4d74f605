"""Checkpoints by orbax, which only this module imports.

    checkpoints/STEP/             under another name until it is whole
    checkpoints/STEP/state/       the arrays
    checkpoints/STEP/position/    the data position
    checkpoints/STEP/sha256.json  digests of all files but orbax's marks
    checkpoints/STEP.damaged/     put aside by a run that went on from an older one

orbax keeps no checksum of the arrays: the digests find what changed on disk.
"""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from jax.experimental import multihost_utils
from orbax.checkpoint import checkpoint_managers

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import read_json, write_json
from rcirl_jax.runtime.checked import checked
from rcirl_jax.runtime.pipeline import digest, file_sha256
from rcirl_jax.train.parallel import is_first
from rcirl_jax.train.state import TrainState

KEEP_LATEST = 3  # checkpoints kept
DIGESTS = "sha256.json"
# of orbax, written after the digests; no restore reads them
MARKS = ("commit_success.txt", "_CHECKPOINT_METADATA")
DAMAGED = ".damaged"
OVERHEAD_BYTES = 2**17  # of a checkpoint's files besides the arrays


class Checkpoints:
    """Saves and restores (TrainState, data position) under one folder.

    Saving is asynchronous. The data position makes a resumed run see the same batches
    in the same order.

    Attributes:
      latest_step: step of the newest whole checkpoint when this was made, or None.
      passed_over: a line for each newer one, which is damaged.
    """

    def __init__(self, folder: Path, *, read_only: bool = False) -> None:
        """Finds the newest whole checkpoint; puts damaged ones newer than it aside.

        Args:
          folder: of the checkpoints; made if missing.
          read_only: leave everything there as it is, also what another process is
            writing just now.

        Raises:
          InputError: there are checkpoints, and none is whole.
        """
        self._folder = folder.resolve()
        self.latest_step, bad = _newest_whole(self._folder)
        self.passed_over = [
            f"{self._folder}: checkpoint {step}: {why}; the one before it that is "
            f"whole: {self.latest_step}"
            for step, why in bad.items()
        ]
        if bad and not read_only:
            _put_aside(self._folder, list(bad))
        options = ocp.CheckpointManagerOptions(
            preservation_policy=checkpoint_managers.LatestN(KEEP_LATEST),
            create=not read_only,
            cleanup_tmp_directories=not read_only,
            save_root_metadata=False,
            async_options=ocp.AsyncOptions(post_finalization_callback=self._seal),
        )
        self._manager = ocp.CheckpointManager(
            self._folder, options=options, item_names=("state", "position")
        )

    def save(self, state: TrainState, position: dict) -> None:
        """Starts saving; returns before the files are complete.

        Once a step. With several processes all of them call it, and the state has
        to be on the devices of all.

        Raises:
          InputError: this one or the one before cannot be written.
        """
        with self._writing():
            self._manager.wait_until_finished()
            if is_first():
                self._check_room(state)
            self._manager.save(
                int(state.step),
                args=ocp.args.Composite(
                    state=ocp.args.StandardSave(state),
                    position=ocp.args.JsonSave(position),
                ),
                force=True,
            )

    def _seal(self) -> None:
        """Notes the digests of a checkpoint's files just before it gets its name."""
        if is_first():
            for folder in self._folder.glob("*.orbax-checkpoint-tmp*"):
                found = _digests(folder)
                write_json(folder / DIGESTS, {"files": found, "sha256": digest(found)})

    def restore(self, like: TrainState) -> tuple[TrainState, dict]:
        """Returns the newest whole checkpoint and its data position.

        Args:
          like: a state of the same structure; only shapes are read.

        Raises:
          InputError: the checkpoint was written with another structure.
        """
        abstract = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding), like
        )
        items = ocp.args.Composite(
            state=ocp.args.StandardRestore(abstract), position=ocp.args.JsonRestore()
        )
        try:
            found = self._manager.restore(self.latest_step, args=items)
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{self._folder}: checkpoint {self.latest_step}: {_first_line(error)}: "
                "expected the same features, hidden size and optimiser"
            ) from error
        return found["state"], found["position"]

    def close(self) -> None:
        """Waits for pending saves and releases the folder.

        Raises:
          InputError: the last checkpoint could not be written.
        """
        with self._writing():
            try:
                self._manager.wait_until_finished()
            finally:
                self._manager.close()

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

    def _check_room(self, state: TrainState) -> None:
        """Writes and removes as many bytes as a checkpoint may take.

        Where it cannot write, orbax waits for minutes and fills the terminal.
        """
        held = sum(x.nbytes for x in map(_numbers, jax.tree.leaves(state)))
        probe = self._folder / ".room"
        try:
            with probe.open("wb") as file:
                file.write(bytes(2 * held + OVERHEAD_BYTES))
                file.flush()
                os.fsync(file.fileno())
        finally:
            with contextlib.suppress(OSError):
                probe.unlink(missing_ok=True)


def _numbers(leaf: jax.Array) -> np.ndarray:
    """Returns a leaf on the host; typed keys as what they are made of."""
    is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if is_key else leaf)


def _newest_whole(folder: Path) -> tuple[int | None, dict[int, str]]:
    """Returns the newest whole checkpoint, and what is wrong with each newer one.

    Raises:
      InputError: there are some, and none is whole.
    """
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    bad: dict[int, str] = {}
    for step in sorted((int(x) for x in names if x.isdecimal()), reverse=True):
        why = _damage(folder / str(step))
        if why is None:
            return step, bad
        bad[step] = why
    if not bad:
        return None, {}
    reasons = "; ".join(f"{step}: {why}" for step, why in bad.items())
    raise InputError(
        f"{folder}: checkpoint {reasons}: expected one that is whole; use another "
        "folder to start again"
    )


def _damage(folder: Path) -> str | None:
    """Returns what is wrong with a checkpoint, if anything."""
    try:
        body = read_json(folder / DIGESTS, "digests")
        noted = checked(body["files"], dict[str, str], folder)
        if body["sha256"] != digest(noted):
            return f"{DIGESTS}: damaged"
    except (InputError, KeyError, TypeError):
        return f"{DIGESTS}: damaged or missing"
    found = _digests(folder)
    for name in sorted(noted.keys() | found.keys()):
        if noted.get(name) != found.get(name):
            return f"{name}: {'damaged' if name in found else 'missing'}"
    return None


def _digests(folder: Path) -> dict[str, str]:
    """Returns the sha256 of a checkpoint's files by their names inside the folder."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    names = {path: path.relative_to(folder).as_posix() for path in files}
    ours = {path: x for path, x in names.items() if path.name not in {DIGESTS, *MARKS}}
    return {name: file_sha256(path) for path, name in ours.items()}


def _put_aside(folder: Path, steps: list[int]) -> None:
    """Renames damaged checkpoints: their numbers will be written again."""
    multihost_utils.sync_global_devices("damaged checkpoints found")
    for step in steps if is_first() else ():
        aside = folder / f"{step}{DAMAGED}"
        shutil.rmtree(aside, ignore_errors=True)
        (folder / str(step)).rename(aside)
    multihost_utils.sync_global_devices("damaged checkpoints put aside")


def _first_line(error: BaseException) -> str:
    text = (str(error).splitlines() or [""])[0][:200]
    return text or type(error).__name__
