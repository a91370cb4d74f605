"""The promises of every reader about any bytes, and how a breach of one is seen.

It returns, or it raises `InputError` (`WeightsError` for weights) of one printable
line that names the file, and not because memory was refused. It writes nothing outside
its folder, starts no program and unpickles nothing.
"""

import contextlib
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

from rcirl_jax.errors import InputError
from rcirl_jax.export.reader import WeightsError

MAX_S = 10.0  # s that one input may take
MAX_LINE = 2000  # characters
FORBIDDEN = (
    *("os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork"),
    *("subprocess.Popen", "pickle.find_class", "socket.connect", "urllib.Request"),
)
CHANGES = (
    *("os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.link", "os.symlink"),
    *("os.truncate", "os.chmod"),
)
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_readers: list[tuple[str, list[str]]] = []  # folder of the one that runs, what it did


def _placed(args: tuple) -> object:
    """The path of an event; one that is relative to an open folder made whole."""
    folders = [number for number in args[1:] if type(number) is int and number > 2]
    if isinstance(args[0], str) and not os.path.isabs(args[0]) and folders:
        with contextlib.suppress(OSError):
            return os.path.join(os.readlink(f"/proc/self/fd/{folders[-1]}"), args[0])
    return args[0]


def _hook(event: str, args: tuple) -> None:
    """Notes what is started, and what is written and changed outside of a folder."""
    if not _readers or event not in ("open", *FORBIDDEN, *CHANGES):
        return
    folder, seen = _readers[-1]
    if event in FORBIDDEN:
        seen.append(f"{event}: {args}"[:200])
        return
    writes = event != "open" or (isinstance(args[2], int) and args[2] & WRITING)
    path = args[0] if event == "open" else _placed(args)
    if writes and isinstance(path, str | bytes | os.PathLike):
        place = os.path.abspath(os.fsdecode(path))
        if not place.startswith((folder, "/dev/")):
            seen.append(f"{event} outside: {place}"[:200])


sys.addaudithook(_hook)


@contextlib.contextmanager
def watched(folder: Path) -> Iterator[list[str]]:
    """Notes what is done inside the `with` block that a folder's reader may not do."""
    found: list[str] = []
    _readers.append((str(folder.resolve()), found))
    try:
        yield found
    finally:
        _readers.pop()


def breach(read: Callable[[Path], object], folder: Path, file: Path) -> str | None:
    """Returns what reading a folder breaks, if anything, when one file was changed.

    The line of a refusal names the folder or something in it. A user's own options
    may name another file, by its whole path.
    """
    begin, found = time.perf_counter(), None
    with watched(folder) as seen:
        try:
            read(file)
        except (InputError, WeightsError) as error:
            starts = (str(folder), "source TOML", *"/" * (file.suffix == ".toml"))
            found = _wrong_with(error, starts)
        except Exception as error:
            found = f"{place_of(error)}: {error}"[:300]
    spent = time.perf_counter() - begin
    if spent > MAX_S:
        return f"{spent:.0f} s"
    return found or (seen[0] if seen else None)


def _wrong_with(error: Exception, names: tuple[str, ...]) -> str | None:
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError):
            return f"{place_of(cause)}: {cause}"[:300]
        cause = cause.__cause__ or cause.__context__
    line = str(error)
    if len(line.splitlines()) != 1 or not line.isprintable() or len(line) > MAX_LINE:
        return f"not one printable line: {line!r}"[:300]
    named = any(name in line for name in names)
    return None if named else f"no file named: {line}"[:300]


def place_of(error: BaseException) -> str:
    """Type, file and line of ours where it came from."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "/rcirl_jax/" in frame.filename]
    last = (ours or frames)[-1]
    return f"{type(error).__name__} at {Path(last.filename).name}:{last.lineno}"
