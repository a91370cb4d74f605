"""Python that a user gives by its place, FILE.py:NAME; importing it runs it.

Knows nothing of JAX, so that processes that need it start at once.
"""

import ast
import contextlib
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


def neighbours(file: Path) -> dict[str, Path]:
    """Returns the modules that a Python file imports of its own folder, by name.

    Those that they import in their turn belong to them; what is not written as an
    import does not.
    """
    found: dict[str, Path] = {}
    left = [("", file)]  # package that a file is in, and the file
    while left:
        package, at = left.pop()
        names: list[str] = []
        with contextlib.suppress(SyntaxError, ValueError):  # importing it will say so
            for node in ast.walk(ast.parse(at.read_bytes())):
                if isinstance(node, ast.Import):
                    names += [one.name for one in node.names]
                elif isinstance(node, ast.ImportFrom):
                    parents = package.split(".")
                    base = (
                        parents[: len(parents) + 1 - node.level] if node.level else []
                    )
                    base = [part for part in (*base, node.module) if part]
                    names += [".".join([*base, one.name]) for one in node.names]
        for name in names:
            parts = name.split(".")
            for count in range(1, len(parts) + 1):
                module, within = ".".join(parts[:count]), ".".join(parts[: count - 1])
                path = file.parent.joinpath(*parts[:count])
                init, alone = path / "__init__.py", path.with_name(f"{path.name}.py")
                for one, of in ((init, module), (alone, within)):
                    if one.is_file() and module not in found:
                        found[module] = one
                        left.append((of, one))
    return found


def source_sha256(file: Path) -> str:
    """Returns the sha256 of a file and, of Python, what it imports of its folder."""
    total = hashlib.sha256(file.read_bytes())
    if file.suffix == ".py":
        for name, one in sorted(neighbours(file.resolve()).items()):
            total.update(f"{name}\n".encode() + one.read_bytes())
    return total.hexdigest()


def python_sha256(place: str, what: str) -> str:
    """Returns `source_sha256` of the file of a place.

    Raises:
      InputError: no such file, or no FILE.py:NAME; `what` it is begins the line.
    """
    if not is_python(place):
        raise InputError(f"{what}: {place}: expected FILE.py:NAME")
    try:
        return source_sha256(python_file(place))
    except OSError as error:
        raise InputError(
            f"{what}: {place}: {error.strerror}: expected FILE.py:NAME"
        ) from error


_folders: list[str] = []  # of users' files, the last imported first


def python_object(place: str) -> Any:  # noqa: ANN401
    """Imports the file of a place, and returns what bears its name.

    The file may import its neighbours, which come after all that is installed, and
    before those of other users' files: two versions of a file have each their own.
    """
    file, name = python_file(place).resolve(), place.partition(".py:")[2]
    spec = importlib.util.spec_from_file_location(str(file), file)
    if spec is None or spec.loader is None:
        raise ValueError(f"{file}: expected a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look up their module there
    others = [folder for folder in _folders if folder != str(file.parent)]
    heads = {one.partition(".")[0] for one in neighbours(file)}
    for one, known in [*sys.modules.items()]:
        if one.partition(".")[0] not in heads:
            continue
        places = [
            getattr(known, "__file__", None) or "",
            *getattr(known, "__path__", ()),
        ]
        if any(Path(x).is_relative_to(folder) for x in places for folder in others):
            del sys.modules[one]
    _folders[:] = [str(file.parent), *others]
    sys.path[:] = [*(path for path in sys.path if path not in _folders), *_folders]
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
