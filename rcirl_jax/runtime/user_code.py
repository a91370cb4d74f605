"""Python that a user gives by its place, FILE.py:NAME; importing it runs it.

Knows nothing of JAX, so that processes that need it start at once.
"""

import hashlib
import importlib.util
import sys
import types
from pathlib import Path
from typing import Any

from rcirl_jax.errors import InputError, did_you_mean


def is_python(place: str) -> bool:
    """True for FILE.py:NAME."""
    return ".py:" in place and not place.startswith("planner:")


def python_file(place: str) -> Path:
    """Returns the file of a place."""
    return Path(place.partition(".py:")[0] + ".py")


def python_sha256(place: str, what: str) -> str:
    """Returns the sha256 of the file of a place.

    Raises:
      InputError: no such file, or no FILE.py:NAME; `what` it is begins the line.
    """
    if not is_python(place):
        raise InputError(f"{what}: {place}: expected FILE.py:NAME")
    try:
        return hashlib.sha256(python_file(place).read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(
            f"{what}: {place}: {error.strerror}: expected FILE.py:NAME"
        ) from error


def python_object(place: str) -> Any:  # noqa: ANN401
    """Imports the file of a place, and returns what bears its name.

    The file may import its neighbours, which come after all that is installed.
    """
    file, name = python_file(place).resolve(), place.partition(".py:")[2]
    spec = importlib.util.spec_from_file_location(str(file), file)
    if spec is None or spec.loader is None:
        raise ValueError(f"{file}: expected a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look up their module there
    if str(file.parent) not in sys.path:
        sys.path.append(str(file.parent))
    spec.loader.exec_module(module)
    return getattr(module, name)


def loaded(place: str, what: str) -> Any:  # noqa: ANN401
    """Returns `python_object`, or says in one line why not.

    Args:
      place: FILE.py:NAME.
      what: it is, for the line.

    Raises:
      InputError: no such file or name, or an error of the file's own.
    """
    try:
        return python_object(place)
    except FileNotFoundError as error:
        raise InputError(
            f"{what}: {place}: {error.strerror}: expected FILE.py:NAME"
        ) from error
    except Exception as error:
        name = place.partition(".py:")[2]
        if isinstance(error, AttributeError) and error.name == name:
            known = [
                one
                for one, value in vars(error.obj).items()
                if not one.startswith("_") and not isinstance(value, types.ModuleType)
            ]
            raise InputError(
                f"{place}: expected a name of that file: {', '.join(known) or 'none'}"
                + did_you_mean(name, known)
            ) from error
        raise InputError(
            f"{place}: {type(error).__name__}: {error}: expected a file that Python "
            "can import"
        ) from error
