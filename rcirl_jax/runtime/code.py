"""Which code made something: a hash of the modules that it uses.

A module uses those that it imports anywhere in its text, those that they import, and
the `__init__` of every package on the way. Docstrings, comments and what stands under
`if TYPE_CHECKING:` decide nothing. Of data_specs the folders count whose reader is
among the modules.
"""

import ast
import functools
from collections.abc import Iterable
from pathlib import Path

from rcirl_jax.runtime.pipeline import digest, file_sha256
from rcirl_jax.runtime.specs import spec_root

PACKAGE = Path(__file__).resolve().parents[1]
# what packages read besides their modules: a folder of data_specs, or of the package
READ = {
    "rcirl_jax.features": "features",
    "rcirl_jax.simulation.catalogue": "scenarios",
    "rcirl_jax.data.formats": "sources",
    "rcirl_jax.report": "report/templates",
}
# packages that import their parts by name
BY_NAME = {"rcirl_jax.data.formats": "*/reader.py"}


def code_of(modules: Iterable[str], package: Path = PACKAGE) -> str:
    """Sha256 of the code that modules use.

    Args:
      modules: dotted names inside the package, e.g. "rcirl_jax.train.loop".
      package: its folder.
    """
    used = used_by(modules, package)
    found = {name: _parsed(path)[1] for name, path in used.items()}
    for reader, folder in READ.items():
        if reader in used:
            for root in (spec_root(), package):
                for file in sorted((root / folder).glob("*.*")):
                    found[f"{folder}/{file.name}"] = file_sha256(file)
    return digest(found)


def used_by(modules: Iterable[str], package: Path = PACKAGE) -> dict[str, Path]:
    """Modules of the package that these use, themselves included, by dotted name."""
    found: dict[str, Path] = {}
    left = list(modules)
    while left:
        name = left.pop()
        path = _file(name, package)
        if path is None or name in found:
            continue
        found[name] = path
        parent = name.rpartition(".")[0]
        left += [*_parsed(path)[0], *([parent] if parent else [])]
        if name in BY_NAME:
            parts = path.parent.glob(BY_NAME[name])
            left += [f"{name}.{part.parent.name}.{part.stem}" for part in parts]
    return dict(sorted(found.items()))


def _file(name: str, package: Path) -> Path | None:
    """The file of a module; None: it is none of the package."""
    first, *rest = name.split(".")
    if first != package.name:
        return None
    place = package.joinpath(*rest)
    for path in (place / "__init__.py", place.with_suffix(".py")):
        if path.is_file():
            return path
    return None


class _Running(ast.NodeTransformer):
    """Takes away what only type checkers read."""

    def visit_If(self, node: ast.If) -> ast.AST | list[ast.stmt]:
        """Of `if TYPE_CHECKING:` what stands under its `else`."""
        for_types = isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
        return node.orelse if for_types else self.generic_visit(node)


@functools.cache
def _parsed(path: Path) -> tuple[tuple[str, ...], str]:
    """What a file imports, and the sha256 of its syntax tree without docstrings.

    Of `from a import b` both a and a.b count: b may be a module.
    """
    tree, names = _Running().visit(ast.parse(path.read_bytes())), []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.append(node.module)
            names += [f"{node.module}.{alias.name}" for alias in node.names]
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and _is_text(body[0]):
            del body[0]
    return tuple(names), digest(ast.dump(tree))


def _is_text(node: ast.AST) -> bool:
    value = node.value if isinstance(node, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str)
