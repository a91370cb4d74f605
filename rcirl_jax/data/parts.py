"""What an import can read apart: parts of the input, and the pieces of a long one."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

from rcirl_jax.data.formats import (
    files_of,
    format_of,
    pieces,
    read_part,
)
from rcirl_jax.data.formats import parts as inputs_of
from rcirl_jax.data.formats.files import is_long_file
from rcirl_jax.data.recording import LEAVE_OUT, PIECE, refusal
from rcirl_jax.errors import InputError
from rcirl_jax.types import Recording


@dataclasses.dataclass(frozen=True, kw_only=True)
class Part:
    """One input that can be read without the others, or a piece of it."""

    format: str
    input: Path
    spec: dict

    @property
    def label(self) -> str:
        """Folder and file, and which of its scenes."""
        first, last = self.spec.get(PIECE, (None, None))
        which = "" if first is None else f", {first} to {last}"
        return f"{self.input.parent.name}/{self.input.name}{which}"


Item = Part | tuple[Part, Recording]


def parts_of(
    name: str, input_path: Path | None, source: Path | None = None
) -> list[Part]:
    """All parts of an input, in order; arguments and errors as `importers.parts`."""
    found, spec = inputs_of(name, input_path, source)
    return [Part(format=name, input=path, spec=spec) for path in found]


def leaving_out(parts: Sequence[Part]) -> list[Part]:
    """The parts, to be read so that refused recordings are left out and counted."""
    return [
        dataclasses.replace(part, spec={**part.spec, LEAVE_OUT: True}) for part in parts
    ]


def items(parts: Sequence[Part], workers: int) -> Iterator[Item]:
    """Parts, to be read where they are used; of few or long ones, each recording."""
    dealt = [piece for part in parts for piece in _pieces(part)]
    is_few = len(dealt) < workers
    for part in dealt:
        if is_few or is_long(part):
            yield from ((part, recording) for recording in recordings_of(part))
        else:
            yield part


def recordings_in(item: Item) -> Iterator[tuple[Part, Recording]]:
    """The recordings of an item, each with its part."""
    if isinstance(item, Part):
        yield from ((item, recording) for recording in recordings_of(item))
    else:
        yield item


def recordings_of(part: Part) -> Iterator[Recording]:
    """All recordings of a part, one at a time.

    Where recordings may be left out, a part that cannot be read any further ends
    with one that says why.
    """
    try:
        yield from read_part(part.format, part.input, part.spec)
    except InputError as error:
        if not part.spec.get(LEAVE_OUT):
            raise
        yield refusal(f"{part.label}, the rest", error)


def is_long(part: Part) -> bool:
    """Whether a part's recordings may be too many to be held at once."""
    if PIECE in part.spec:
        return False
    form = format_of(part.format)
    if form.is_cut:
        return is_long_file(part.input, part.spec)
    if form.shard_bytes and part.input.is_file():
        files = files_of(part.format, part.input)
        return sum(file.stat().st_size for file in files) > form.shard_bytes
    return not form.is_small


def _pieces(part: Part) -> list[Part]:
    """The pieces of a part that can be read apart; itself, where it has none.

    So it is where it cannot be opened: whoever reads it says why.
    """
    try:
        specs = pieces(part.format, part.input, part.spec)
    except InputError:
        return [part]
    return [dataclasses.replace(part, spec=spec) for spec in specs]
