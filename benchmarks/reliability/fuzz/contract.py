"""What every reader promises of any bytes, and how a breach of it is seen.

It returns, or it raises `InputError` (`WeightsError` for weights) of one printable
line that names the file, and not because memory was refused. It opens nothing outside
its folder for writing and nothing but code and system files for reading, and it starts
no program and unpickles nothing. Seconds and memory are limited by whoever runs it.
"""

import contextlib
import dataclasses
import os
import re
import sys
import traceback
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

from rcirl_jax.errors import InputError
from rcirl_jax.export.reader import WeightsError

# where a last net caught what no check foresaw
UNFORESEEN = re.compile(r"\((\w+\.py:\d+)\): expected ")
MAX_LINE = 2000  # characters
FORBIDDEN = (
    *("os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork"),
    *("subprocess.Popen", "pickle.find_class", "socket.connect", "urllib.Request"),
)
CHANGES = (
    *("os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.link", "os.symlink"),
    *("os.truncate", "os.chmod", "shutil.rmtree"),
)
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
SYSTEM = ("/proc/", "/dev/", "/sys/", "/usr/", "/lib", "/etc/localtime")


@dataclasses.dataclass(frozen=True)
class Breach:
    """A promise that was not kept."""

    kind: str  # what was broken; the same for all inputs of one defect
    text: str


class Watch:
    """Sees what is opened, changed and started while a reader runs."""

    def __init__(self, folder: Path) -> None:
        """Start watching this process, for good; `folder` is the reader's own."""
        self._folder = str(folder.resolve())
        code = {sys.prefix, sys.base_prefix, str(Path(__file__).parents[3])}
        self._readable = (*SYSTEM, self._folder, *code)
        self._on, self._seen = False, {}
        sys.addaudithook(self._hook)

    def __enter__(self) -> "Watch":
        self._on, self._seen = True, {}
        return self

    def __exit__(self, *_: object) -> None:
        self._on = False

    @property
    def seen(self) -> list[Breach]:
        """What was broken since it was entered, the first of each kind."""
        return list(self._seen.values())

    def _see(self, kind: str, text: str) -> None:
        self._seen.setdefault(kind, Breach(kind, text[:200]))

    def _hook(self, event: str, args: tuple) -> None:
        if not self._on:
            return
        if event == "open":
            self._opened(args[0], args[2])
        elif event == "sqlite3.connect":
            self._opened(str(args[0]).removeprefix("file://").split("?")[0], 0)
        elif event in FORBIDDEN or (
            event in CHANGES and not self._is_inside(_placed(args))
        ):
            self._see(event, str(args))

    def _opened(self, path: object, flags: object) -> None:
        writes = isinstance(flags, int) and bool(flags & WRITING)
        if writes and not self._is_inside(path):
            self._see("written outside", str(path))
        elif not self._is_inside(path, self._readable):
            self._see("read outside", str(path))

    def _is_inside(self, path: Any, places: tuple[str, ...] = ("/dev/",)) -> bool:  # noqa: ANN401 - whatever was opened
        if not isinstance(path, str | bytes | os.PathLike):
            return True
        return os.path.abspath(os.fsdecode(path)).startswith((self._folder, *places))


def _placed(args: tuple) -> Any:  # noqa: ANN401 - whatever was changed
    """The path of an event; one that is relative to an open folder made whole."""
    folders = [number for number in args[1:] if type(number) is int and number > 2]
    if isinstance(args[0], str) and not os.path.isabs(args[0]) and folders:
        with contextlib.suppress(OSError):
            return os.path.join(os.readlink(f"/proc/self/fd/{folders[-1]}"), args[0])
    return args[0]


def refusal_breach(
    line: str, names: Collection[str], elsewhere: bool = False
) -> Breach | None:
    """What is wrong with the text of a refusal.

    Args:
      line: the text.
      names: one of them is in it.
      elsewhere: or it begins with a path, which the input named.
    """
    if len(line.splitlines()) != 1 or not line.isprintable():
        return Breach("not one printable line", repr(line)[:300])
    if len(line) > MAX_LINE:
        return Breach("a line too long", f"{len(line)} characters: {line[:200]}")
    named = any(name in line for name in names)
    if not named and not (elsewhere and line.startswith("/")):
        return Breach("no file named", line[:300])
    return None


def _memory_breach(error: BaseException) -> Breach | None:
    """Whether a refusal comes of memory that was asked for and not given."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, MemoryError):
        cause = cause.__cause__ or cause.__context__
    return Breach(place_of(cause), str(cause)[:300]) if cause else None


def place_of(error: BaseException) -> str:
    """File and line of ours where it came from, and its type."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "/rcirl_jax/" in frame.filename]
    last = (ours or frames)[-1]
    return f"{type(error).__name__} at {Path(last.filename).name}:{last.lineno}"


def verdict(
    read: Callable[[], object], names: Collection[str], elsewhere: bool = False
) -> tuple[Breach | None, str | None]:
    """Read once; (what was broken, the line of a refusal). Args of `refusal_breach`."""
    try:
        read()
    except (InputError, WeightsError) as error:
        breach = _memory_breach(error) or refusal_breach(str(error), names, elsewhere)
        return breach, str(error)
    except Exception as error:
        return Breach(place_of(error), str(error)[:300]), None
    return None, None


def broken_by(
    breach: Breach | None, seen: Sequence[Breach], elsewhere: bool
) -> list[Breach]:
    """All that one input broke: its end, and what was seen meanwhile.

    Where it may name files elsewhere, reading them is none, and hides nothing.
    """
    found = [*seen] if breach is None else [breach, *seen]
    return [x for x in found if not (elsewhere and x.kind == "read outside")]
