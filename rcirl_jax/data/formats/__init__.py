"""Importers: one module per log format, each yielding valid Recordings.

`format.FORMATS` says how a format's files are recognised and how workers share them.
Its module has `recordings`: (input path, source spec) -> iterator of Recording. The
spec is the TOML of data_specs/sources (or the user's own). Each passes its recordings
through `validate_recording` with the file's name.
"""

import importlib
import itertools
import re
import types
from collections.abc import Callable, Iterator
from pathlib import Path

from rcirl_jax.data.formats.declared import over_packaged
from rcirl_jax.data.formats.files import log_name, with_log_names
from rcirl_jax.data.formats.format import FORMATS
from rcirl_jax.data.formats.options import USER_KEYS, check_options
from rcirl_jax.data.formats.sites import BESIDE, beside, with_roads
from rcirl_jax.data.readers.tables.rows import NoRowsError
from rcirl_jax.data.readers.tables.streams import refuse_pointer
from rcirl_jax.data.recording import empty_recording
from rcirl_jax.errors import InputError, as_input_error
from rcirl_jax.runtime.atomic_files import is_text
from rcirl_jax.runtime.specs import load_toml, spec_root
from rcirl_jax.types import Recording

Importer = Callable[[Path, dict], Iterator[Recording]]

IMPORTERS = tuple(FORMATS)  # their modules are loaded when they are asked for


def read_part(name: str, path: Path, spec: dict) -> Iterator[Recording]:
    """Yields all recordings of one part, each validated; arguments as of `parts`."""
    importer: Importer = module_of(name).recordings
    for file in files_of(name, path):
        refuse_pointer(file)
    with as_input_error(str(path), f"a sound log of format {name}"):
        try:
            yield from with_roads(name, importer, path, spec)
        except NoRowsError as error:
            if error.path != path:
                raise  # a table beside the log
            yield empty_recording(log_name(path, spec, path.name), str(error))


def pieces(name: str, path: Path, spec: dict) -> list[dict]:
    """Returns specs that each read a share of one part; arguments as of `parts`.

    A format whose module has no `pieces(path, spec)` reads a part as a whole.
    """
    split = getattr(module_of(name), "pieces", None)
    return [spec] if split is None else split(path, spec)


def files_of(name: str, path: Path) -> list[Path]:
    """Returns the files of one part: itself, if its module says nothing."""
    found = getattr(module_of(name), "files_of", None)
    return [path] if found is None else found(path)


def module_of(name: str) -> types.ModuleType:
    """Loads the module of a format."""
    return importlib.import_module(f"{__name__}.{FORMATS[name].module or name}")


def parts(
    name: str, input_path: Path | None, source: Path | None = None
) -> tuple[list[Path], dict]:
    """Returns inputs that can be read apart from each other, in order, and the spec.

    The recordings of all parts, one part after the other, are those of the whole
    input. A format whose module has no `parts(path, spec)` is one part. Where it has
    `own_name(file)`, logs that are called alike in several folders are told apart;
    lanes that a log does not give are those of all files that show one place.

    Args:
      name: key of `IMPORTERS`.
      input_path: file or folder; None is allowed for "synthetic" only.
      source: TOML of columns, units and licence; default: the packaged one.

    Raises:
      InputError: unknown format, missing path, or nothing to read.
    """
    if name not in IMPORTERS:
        raise InputError(f"format: {name}: expected one of {sorted(IMPORTERS)}")
    packaged = spec_root() / "sources" / f"{name}.toml"
    spec_path = source or packaged
    spec = load_toml(spec_path)
    own = [] if source is None else sorted(spec)
    options = f"options as in the TOML of format {name}"
    if source is not None:
        form, usual = FORMATS[name], load_toml(packaged)
        with as_input_error(str(source), options):
            check_options(spec, usual, form)
        if name not in ("csv", "synthetic"):  # what they do not say is no default
            spec = over_packaged(spec, usual, form.free)
    spec = {**spec, USER_KEYS: own}
    if input_path is None:
        if name != "synthetic":
            raise InputError("input: not given: expected a file or folder")
        input_path = spec_path
    if not input_path.exists():
        raise InputError(f"{input_path}: input: missing: expected a file or folder")
    module = module_of(name)
    split = getattr(module, "parts", None)
    with as_input_error(str(input_path), f"logs of format {name}, and {options}"):
        found = [input_path] if split is None else split(input_path, spec)
        found = sorted(found, key=_by_numbers)  # of a stream in the order of time
        name_of = getattr(module, "own_name", None)
        if name_of is not None:
            spec = with_log_names(input_path, found, spec, name_of)
        if len(found) > 1:
            spec = {**spec, BESIDE: beside(found)}
    for path in found:
        if not is_text(str(path)):
            raise InputError(f"{path}: name: {path.name!a}: expected UTF-8; rename it")
    return found, spec


def _by_numbers(path: Path) -> list:
    """Returns the key by which log2 comes before log10."""
    texts = re.split(r"(\d+)", str(path))
    return [int(text) if k % 2 else text for k, text in enumerate(texts)]


def read_recordings(
    name: str, input_path: Path | None, source: Path | None = None
) -> Iterator[Recording]:
    """Yields all recordings of an input; arguments and errors as of `parts`."""
    found, spec = parts(name, input_path, source)
    return itertools.chain.from_iterable(read_part(name, path, spec) for path in found)
