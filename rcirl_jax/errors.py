"""One error type for bad input: it reads as one clear line, never a traceback.

Library code raises `InputError("FILE: field: value: what was expected")`; the
commands turn it into that line on stderr and exit status 2.
"""

import contextlib
import difflib
import importlib
import struct
import traceback
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType

HEAD, TAIL = 1400, 400  # characters kept of the ends of a line too long
# packages that are in an extra only
EXTRAS = {
    **dict.fromkeys(("jinja2", "markupsafe", "matplotlib"), "report"),
    **dict.fromkeys(("defusedxml", "pyarrow", "pyproj", "shapely"), "logs"),
    "optuna": "optuna",
}


class InputError(ValueError):
    """Something the user gave is wrong: file, field, value, expectation.

    The message is a single printable line. It names the file first, then the field
    and the value that was found, then what was expected instead.
    """

    def __init__(self, message: str) -> None:
        line = " ".join(str(message).split())
        if len(line) > HEAD + TAIL:
            line = f"{line[:HEAD]} ... {line[-TAIL:]}"
        super().__init__("".join(c if c.isprintable() else "?" for c in line))


class LostWorkError(InputError):
    """Work cannot go on (lost memory, nodes; too many names); what is done stays."""


# what reading an unforeseen file may end in; anything else is a fault of ours
UNFORESEEN = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    RecursionError,
    SystemError,
    TypeError,
    ValueError,
    struct.error,
)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The end of a line on an unknown name: the nearest known one, "" if none is near.

    Args:
      name: what was given.
      known: what there is.
    """
    near = difflib.get_close_matches(name, list(known), 1)
    return f"; did you mean {near[0]}?" if near else ""


@contextlib.contextmanager
def as_input_error(what: str, expected: str) -> Iterator[None]:
    """A last net: errors that no check foresaw become one line as well.

    The line names the place in the code, for a report of the fault.

    Args:
      what: file or recording that is read, first in the line.
      expected: what was expected of it.

    Raises:
      InputError: from one of `UNFORESEEN`.
    """
    try:
        yield
    except InputError:
        raise
    except UNFORESEEN as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        raise InputError(
            f"{what}: {type(error).__name__}: {str(error)[:200]} "
            f"({Path(place.filename).name}:{place.lineno}): expected {expected}"
        ) from error


def extra_module(name: str, extra: str = "logs") -> ModuleType:
    """A module of an extra; one clear line where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            f"{name}: not installed ({error}): expected "
            f"pip install 'rcirl-jax[{extra}]'"
        ) from error


def extra_of(error: BaseException) -> InputError | None:
    """What to install where an import failed for want of an extra; None: for another.

    Args:
      error: what was raised.
    """
    if not isinstance(error, ModuleNotFoundError):
        return None
    package = str(error.name).partition(".")[0]
    if package not in EXTRAS:
        return None
    return InputError(
        f"{package}: not installed: expected pip install 'rcirl-jax[{EXTRAS[package]}]'"
    )
