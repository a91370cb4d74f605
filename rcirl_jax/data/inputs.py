"""The input of an import: files, time slices of long ones, and their recordings."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

from rcirl_jax.data.formats import files_of, parts, pieces, read_part
from rcirl_jax.data.formats.files import is_long_file
from rcirl_jax.data.formats.format import FORMATS
from rcirl_jax.data.recording import LEAVE_OUT, PIECE, refusal
from rcirl_jax.errors import InputError
from rcirl_jax.types import Recording


@dataclasses.dataclass(frozen=True, kw_only=True)
class InputFile:
    """An input that can be read without the others, or a time slice of a long one."""

    format: str
    input: Path
    spec: dict

    @property
    def label(self) -> str:
        """Folder and file, and which of its scenes."""
        first, last = self.spec.get(PIECE, (None, None))
        which = "" if first is None else f", {first} to {last}"
        return f"{self.input.parent.name}/{self.input.name}{which}"


# read where it is worked on, or read already
WorkUnit = InputFile | tuple[InputFile | None, Recording]


def input_files(
    name: str, input_path: Path | None, source: Path | None = None
) -> list[InputFile]:
    """Return all input files, in order; arguments and errors as `formats.parts`."""
    found, spec = parts(name, input_path, source)
    return [InputFile(format=name, input=path, spec=spec) for path in found]


def leaving_out(files: Sequence[InputFile]) -> list[InputFile]:
    """Return the files, to be read so that refused recordings are left out, counted."""
    return [
        dataclasses.replace(file, spec={**file.spec, LEAVE_OUT: True}) for file in files
    ]


def work_units(files: Sequence[InputFile], workers: int) -> Iterator[WorkUnit]:
    """Yield files, to be read where they are used; of few or long ones, recordings."""
    dealt = []
    for file in files:
        try:
            specs = pieces(file.format, file.input, file.spec)
            dealt += [dataclasses.replace(file, spec=spec) for spec in specs]
        except InputError:  # cannot be opened: whoever reads it says why
            dealt.append(file)
    is_few = len(dealt) < workers
    for file in dealt:
        if is_few or is_long(file):
            yield from ((file, recording) for recording in recordings_of(file))
        else:
            yield file


def recordings_in(unit: WorkUnit) -> Iterator[tuple[InputFile | None, Recording]]:
    """Yield the recordings of a unit of work, each with its file."""
    if isinstance(unit, InputFile):
        yield from ((unit, recording) for recording in recordings_of(unit))
    else:
        yield unit


def recordings_of(file: InputFile) -> Iterator[Recording]:
    """Yield all recordings of a file, one at a time.

    Where recordings may be left out, a file that cannot be read any further ends
    with one that says why.
    """
    try:
        yield from read_part(file.format, file.input, file.spec)
    except InputError as error:
        if not file.spec.get(LEAVE_OUT):
            raise
        yield refusal(f"{file.label}, the rest", error)


def is_long(file: InputFile) -> bool:
    """Return whether a file's recordings may be too many to be held at once."""
    if PIECE in file.spec:
        return False
    form = FORMATS[file.format]
    if form.is_cut:
        return is_long_file(file.input, file.spec)
    if form.shard_bytes and file.input.is_file():
        sizes = (x.stat().st_size for x in files_of(file.format, file.input))
        return sum(sizes) > form.shard_bytes
    return not form.is_small
