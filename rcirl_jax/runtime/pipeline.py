"""Stages of a run: each is done once for its inputs, and again when they change.

RUN/stages.json names, for every finished stage, the settings and hashes it was made
from and the sha256 of what it made. A stage is skipped if both are as they were; a
killed run goes on with the first stage that is not. It also says which commit, versions
and flags did the work, which decides nothing. One process at a time.
"""

import contextlib
import dataclasses
import functools
import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import locked, read_json, write_json
from rcirl_jax.runtime.checked import checked
from rcirl_jax.runtime.specs import spec_root

FILE = "stages.json"
LOCK = ".lock"  # in a folder that one process at a time works in
SCHEMA_VERSION = 1
PACKAGE = Path(__file__).resolve().parents[1]
READ = ("features", "scenarios", "sources")  # of data_specs
FileName = Annotated[str, msgspec.Meta(pattern=r"\A[^\0]*\Z")]


def file_sha256(path: Path) -> str:
    """Sha256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest(node: object) -> str:
    """Sha256 of anything that JSON can say."""
    text = json.dumps(node, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


@functools.cache
def code_sha256() -> str:
    """Sha256 of all that decides a result besides settings and data.

    The package's modules and page templates, and of data_specs what modules read by
    themselves. Recipes are settings. Any change counts, also of a comment.
    """
    found = {}
    for root, pattern in (
        (PACKAGE, "**/*.py"),
        (PACKAGE, "report/templates/*"),
        *((spec_root(), f"{folder}/*.toml") for folder in READ),
    ):
        for file in sorted(root.glob(pattern)):
            found[file.relative_to(root).as_posix()] = file_sha256(file)
    return digest(found)


class _Record(msgspec.Struct):
    """The fields of a stage's record that are read."""

    key: str
    outputs: dict[FileName, str]  # sha256 of each
    inputs: dict = {}
    seconds: float = 0.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stages:
    """The stages of one run folder."""

    folder: Path

    def run(
        self,
        name: str,
        inputs: Mapping[str, Any],
        outputs: Sequence[Path],
        work: Callable[[], object],
        stale: Sequence[str] = (),
        made_by: Mapping[str, Any] | None = None,
    ) -> bool:
        """Does the work unless it has been done from these inputs.

        Args:
          name: of the stage.
          inputs: settings and hashes that decide the outputs; JSON.
          outputs: files that the work writes, below the folder.
          work: writes them.
          stale: stages whose outputs would mislead beside new ones; they are removed
            before the work.
          made_by: commit, versions and flags, noted of work done now; they decide
            nothing.

        Returns:
          Whether it was done now.

        Raises:
          InputError: the work left an output unwritten.
        """
        if self.is_done(name, inputs, outputs):
            return False
        begin = time.monotonic()
        self._forget(stale)
        work()
        self.note(name, inputs, outputs, time.monotonic() - begin, made_by)
        return True

    def is_done(
        self, name: str, inputs: Mapping[str, Any], outputs: Sequence[Path]
    ) -> bool:
        """True if a stage was done from these inputs and its outputs are whole."""
        known = self.read().get(name, {})
        return known.get("key") == digest(inputs) and self._intact(known, outputs)

    def note(
        self,
        name: str,
        inputs: Mapping[str, Any],
        outputs: Sequence[Path],
        seconds: float,
        made_by: Mapping[str, Any] | None = None,
    ) -> None:
        """Notes that a stage has been done; arguments as of `run`.

        Raises:
          InputError: an output is missing.
        """
        made = {}
        for path in outputs:
            if not path.is_file():
                raise InputError(f"{path}: missing after stage {name}")
            made[str(path.relative_to(self.folder))] = file_sha256(path)
        record = {
            "key": digest(inputs),
            "inputs": dict(inputs),
            "outputs": made,
            "seconds": round(seconds, 1),
            **({"made_by": dict(made_by)} if made_by else {}),
        }
        self._write({**self.read(), name: record})

    def _forget(self, names: Sequence[str]) -> None:
        """Removes the outputs of stages, then their records."""
        known, inside = self.read(), self.folder.resolve()
        for name in names:
            for file in known.get(name, {}).get("outputs", {}):
                path = self.folder / file
                where = path.parent.resolve()  # the file itself may be a link
                if path.name == ".." or not where.is_relative_to(inside):
                    raise InputError(
                        f"{self.folder / FILE}: {name}: {file}: expected a file of"
                        " the run's folder"
                    )
                try:
                    path.unlink(missing_ok=True)
                except OSError as error:
                    raise InputError(
                        f"{self.folder / FILE}: {name}: {file}: {error.strerror}:"
                        " expected a file of the run's folder"
                    ) from error
        kept = {name: record for name, record in known.items() if name not in names}
        if kept != known:
            self._write(kept)

    def _intact(self, known: Mapping[str, Any], outputs: Sequence[Path]) -> bool:
        made = known.get("outputs", {})
        names = [str(path.relative_to(self.folder)) for path in outputs]
        return sorted(made) == sorted(names) and all(
            path.is_file() and file_sha256(path) == made[name]
            for path, name in zip(outputs, names, strict=True)
        )

    def check_kept(self, path: Path) -> None:
        """Checks that a file of the run, or its absence, is as a stage left it.

        Raises:
          InputError: another sha256 than the record's, or no record of it.
        """
        name = path.relative_to(self.folder).as_posix()
        records = [x["outputs"] for x in self.read().values()]
        made = [x[name] for x in records if name in x] or [None]
        if (file_sha256(path) if path.is_file() else None) not in made:
            raise InputError(
                f"{path}: changed since the run wrote it: expected the sha256 that "
                f"{FILE} has of it"
            )

    def read(self) -> dict[str, Any]:
        """Reads the finished stages by name.

        Raises:
          InputError: the file is not one of this version.
        """
        path = self.folder / FILE
        if not path.exists():
            return {}
        body = read_json(path, "the stages of a run")
        found = body if isinstance(body, dict) else {}
        version, stages = found.get("schema_version"), found.get("stages")
        if version != SCHEMA_VERSION:
            raise InputError(
                f"{path}: schema_version: {version}: expected {SCHEMA_VERSION}"
            )
        known = checked(stages, dict, f"{path}: stages")
        for name, record in known.items():
            checked(record, _Record, f"{path}: {name}")
        return known

    def _write(self, stages: Mapping[str, Any]) -> None:
        body = {"schema_version": SCHEMA_VERSION, "stages": dict(stages)}
        write_json(self.folder / FILE, body)


@contextlib.contextmanager
def only_one(folder: Path) -> Iterator[None]:
    """Holds a folder for this process; it is made if missing.

    The lock goes with the process, however that ends; its file means nothing. At the
    end it is removed, and so are folders made for it that are empty then.

    Args:
      folder: to hold.

    Raises:
      InputError: another process holds it.
    """
    path = folder / LOCK
    made = [x for x in (folder, *folder.parents) if not os.path.lexists(x)]
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(locked(path, wait=False))
        except BlockingIOError as error:
            raise InputError(
                f"{folder}: in use by another process: expected one run at a time"
            ) from error
        try:
            yield
        finally:
            path.unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                for one in made:
                    one.rmdir()
