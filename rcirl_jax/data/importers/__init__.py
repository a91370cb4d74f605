"""Importers: one module per log format, each yielding valid Recordings.

An importer is a function (input path, source spec) -> iterator of Recording.
The spec is the TOML of data_specs/sources (or the user's own). Each passes its
recordings through `validate_recording` with the file's name.
"""

import importlib
from collections.abc import Callable, Iterator
from pathlib import Path

from rcirl_jax.errors import InputError
from rcirl_jax.specs import load_toml, spec_root
from rcirl_jax.types import Recording

Importer = Callable[[Path, dict], Iterator[Recording]]

# format -> module; loaded only when the format is asked for
IMPORTERS: dict[str, str] = {
    "commonroad": "commonroad",
    "csv": "csv_table",
    "ngsim": "ngsim",
    "synthetic": "synthetic",
}


def read_recordings(
    name: str, input_path: Path | None, source: Path | None = None
) -> Iterator[Recording]:
    """All recordings of an input, each validated.

    Args:
      name: key of `IMPORTERS`.
      input_path: file or folder; None is allowed for "synthetic" only.
      source: TOML of columns, units and licence; default: the packaged one.

    Raises:
      InputError: unknown format, missing path, nothing to read, or bad data.
    """
    if name not in IMPORTERS:
        raise InputError(f"--format: {name}: expected one of {sorted(IMPORTERS)}")
    spec_path = source or spec_root() / "sources" / f"{name}.toml"
    spec = load_toml(spec_path)
    if input_path is None:
        if name != "synthetic":
            raise InputError("--input: not given: expected a file or folder")
        input_path = spec_path
    if not input_path.exists():
        raise InputError(f"{input_path}: input: missing: expected a file or folder")
    module = importlib.import_module(f"{__name__}.{IMPORTERS[name]}")
    importer: Importer = module.recordings
    return importer(input_path, spec)
