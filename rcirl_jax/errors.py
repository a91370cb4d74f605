"""One error type for bad input: it reads as one clear line, never a traceback.

Library code raises `InputError("FILE: field: value: what was expected")`, or with the
name of an argument in place of the file. The command line puts the flag's dashes before
such a name and ends with that line and exit status 2. Any other exception is a fault of
this package.
"""

import contextlib
import difflib
import importlib
import struct
from collections.abc import Iterable, Iterator
from types import ModuleType

HEAD, TAIL = 1400, 400  # characters kept of the ends of a line too long
# packages that are in an extra only
EXTRAS = {
    **dict.fromkeys(("jinja2", "markupsafe", "matplotlib"), "report"),
    **dict.fromkeys(("defusedxml", "pyarrow", "pyproj", "shapely"), "logs"),
    "optuna": "optuna",
}
# what libraries raise of bytes and numbers that are not what they should be
BAD_DATA = (
    ArithmeticError,
    EOFError,
    MemoryError,
    RecursionError,
    ValueError,
    struct.error,
)
# and what reading a damaged file as plain dicts and lists raises besides
MALFORMED = (*BAD_DATA, AttributeError, LookupError, TypeError)


class InputError(ValueError):
    """Something the user gave is wrong: file or argument, field, value, expectation.

    The message is a single printable line. It begins with the file or the argument,
    then names the field and the value that was found, then what was expected instead.
    """

    def __init__(self, message: str) -> None:
        line = " ".join(str(message).split())
        if len(line) > HEAD + TAIL:
            line = f"{line[:HEAD]} ... {line[-TAIL:]}"
        super().__init__("".join(c if c.isprintable() else "?" for c in line))


class LostWorkError(InputError):
    """Work cannot go on (lost memory, nodes; too many names); what is done stays."""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Returns the end of a line on an unknown name: the nearest known one, or "".

    Args:
      name: what was given.
      known: what there is.
    """
    near = difflib.get_close_matches(name, list(known), 1)
    return f"; did you mean {near[0]}?" if near else ""


def counted(count: int, what: str) -> str:
    """Returns a count with its noun: 1 recording, 2 recordings."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"


@contextlib.contextmanager
def as_input_error(what: str, expected: str) -> Iterator[None]:
    """Turns what libraries raise of bad data (`BAD_DATA`) into one line.

    Any other exception is a bug: it passes, with a note on what was read.

    Args:
      what: file or recording that is read, first in the line.
      expected: what was expected of it.

    Raises:
      InputError: from one of `BAD_DATA`.
    """
    try:
        yield
    except InputError:
        raise
    except BAD_DATA as error:
        raise InputError(
            f"{what}: {type(error).__name__}: {str(error)[:200]}: expected {expected}"
        ) from error
    except Exception as error:
        error.add_note(f"while reading {what}")
        raise


def extra_module(name: str, extra: str = "logs") -> ModuleType:
    """Imports a module of an extra; one clear line where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            f"{name}: not installed ({error}): expected "
            f"pip install 'rcirl-jax[{extra}]'"
        ) from error


def extra_of(error: BaseException) -> InputError | None:
    """Returns what to install where an import failed for want of an extra, or None.

    Args:
      error: what was raised.
    """
    package = str(getattr(error, "name", None)).partition(".")[0]
    if not isinstance(error, ModuleNotFoundError) or package not in EXTRAS:
        return None
    return InputError(
        f"{package}: not installed: expected pip install 'rcirl-jax[{EXTRAS[package]}]'"
    )
