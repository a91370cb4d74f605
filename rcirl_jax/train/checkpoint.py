"""Checkpoints: orbax behind three functions. Nobody else imports orbax."""

from pathlib import Path
from typing import Any

import jax
from orbax.checkpoint import v1 as ocp

from rcirl_jax.errors import InputError
from rcirl_jax.train.state import TrainState

KEEP_LATEST = 3  # checkpoints kept


class Checkpoints:
    """Saves and restores (TrainState, data position) under one folder.

    Saving is asynchronous; the data position travels as the checkpoint's own
    metadata, so that a resumed run sees the same batches in the same order.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder.resolve()
        self._folder.mkdir(parents=True, exist_ok=True)
        keep: Any = ocp.training.preservation_policies.LatestN(KEEP_LATEST)
        self._checkpointer = ocp.training.Checkpointer(
            str(self._folder),
            preservation_policy=keep,
            cleanup_tmp_directories=True,
        )

    def latest_step(self) -> int | None:
        """Step of the newest complete checkpoint, or None."""
        latest = self._checkpointer.latest
        return None if latest is None else int(latest.step)

    def save(self, state: TrainState, position: dict) -> None:
        """Start saving; returns before the files are complete.

        Once a step. With several processes all of them call it, and the state has
        to be on the devices of all.
        """
        self._checkpointer.save_async(
            int(state.step), state, force=True, custom_metadata={"position": position}
        )

    def restore(self, like: TrainState) -> tuple[TrainState, dict]:
        """The newest checkpoint and its data position.

        Args:
          like: a state of the same structure; only shapes are read.

        Raises:
          InputError: the checkpoint was written with another structure.
        """
        step = self.latest_step()
        abstract = jax.tree.map(_abstract, like)
        try:
            state = self._checkpointer.load(step, abstract)
        except (ValueError, KeyError, TypeError) as error:
            first = str(error).splitlines()[0]
            raise InputError(
                f"{self._folder}: checkpoint {step}: {first}: "
                "expected the same features, hidden size and optimiser"
            ) from error
        metadata: Any = self._checkpointer.metadata(step).custom_metadata or {}
        return state, dict(metadata.get("position", {}))

    def close(self) -> None:
        """Wait for pending saves and release the folder."""
        self._checkpointer.close()


def _abstract(leaf: jax.Array) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding)
