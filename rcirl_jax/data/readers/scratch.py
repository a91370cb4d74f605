"""Folders of scratch files: locked while in use, removed also after a kill."""

import contextlib
import fcntl
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

SCRATCH = "rcirl-scratch-"  # how folders of scratch files begin
LOCK = "lock"  # in such a folder, held while it is in use


@contextlib.contextmanager
def scratch() -> Iterator[Path]:
    """A locked folder for scratch files; removes those that killed imports left."""
    for left in Path(tempfile.gettempdir()).glob(f"{SCRATCH}*/{LOCK}"):
        with contextlib.suppress(OSError), left.open() as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # not while in use
            shutil.rmtree(left.parent, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix=SCRATCH) as name:
        folder = Path(name)
        with (folder / LOCK).open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield folder
