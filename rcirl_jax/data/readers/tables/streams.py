"""The text of a file, a few MiB at a time: unpacked, decoded, in whole rows.

What packs a file (gzip, zstd, bzip2) and how its characters are written (UTF-8 with
and without a mark, UTF-16) is told by its bytes, not its name; where they do not tell,
by names that it should hold, else it is read as Windows' 1252. No more than a block and
one line are held.
"""

import codecs
import contextlib
import io
import re
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import IO, Any

from rcirl_jax.errors import InputError, extra_module

READ_CHARS = 8 * 2**20  # characters that are read at a time
MAX_LINE = 2**24  # characters of a line; pNEUMA writes a drive of minutes into one
MAX_SPAN = 20  # lines of one row, by line ends inside of quotes
HEAD_LINES = 60  # lines from which a layout is recognised
HEAD_BYTES = 2**16  # bytes from which an encoding is recognised
MIN_ASCII = 0.2  # share of a head's characters; another encoding has fewer
# first bytes -> pyarrow's name of what packs a file
PACKED = {b"\x1f\x8b": "gzip", b"\x28\xb5\x2f\xfd": "zstd", b"BZh": "bz2"}
# first bytes -> what a file is that is no table, and what to do
NO_TABLES = {
    b"PK\x03\x04": "a spreadsheet or a zip archive: expected a table; export it as "
    "CSV, or unpack it",
    b"\xd0\xcf\x11\xe0": "an old spreadsheet: expected a table; export it as CSV",
    b"SQLite format 3": "a database: expected a table; export it as CSV",
}
POINTER = b"version https://git-lfs.github.com/spec/"
BYTE_ORDERS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}  # first bytes -> encoding, the longer first


# beside ASCII no letters and no units
NO_LETTERS = re.compile(r"[^\w\x00-\x7f°²³µ]|[¼-¾]|(?<=[a-z])[ªº¹]")
# encodings that bytes do not tell apart, the likelier first; those of one byte a
# character, and others
ONE_BYTE = ("cp1252", "cp1250", "cp1251", "cp1253", "cp1254")
UNTOLD = (*ONE_BYTE, "shift_jis", "gb18030")


def first_bytes(path: Path, count: int = 64) -> bytes:
    """Returns the first bytes of a file; none of what is no file."""
    if not path.is_file():
        return b""
    with path.open("rb") as file:
        return file.read(count)


def refuse_pointer(path: Path) -> None:
    """Refuses the text of three lines that Git LFS leaves where it fetched no data.

    Raises:
      InputError: the file is one.
    """
    if first_bytes(path, len(POINTER)) == POINTER:
        raise InputError(
            f"{path}: Git LFS pointer: expected the data themselves; run git lfs pull"
        )


def packing(path: Path) -> str | None:
    """Returns what packs a file, by its first bytes; None: nothing known."""
    head = first_bytes(path)
    return next((name for mark, name in PACKED.items() if head.startswith(mark)), None)


@contextlib.contextmanager
def unpacked(path: Path) -> Iterator[tuple[Any, IO[bytes]]]:
    """Opens a file that may be packed: (stream of the bytes inside, the file itself).

    Raises:
      InputError: a damaged archive, a Git LFS pointer, a spreadsheet.
    """
    refuse_pointer(path)
    head, packed = first_bytes(path), packing(path)
    for mark, what in NO_TABLES.items():
        if head.startswith(mark):
            raise InputError(f"{path}: {what}")
    with path.open("rb") as file:
        if packed is None:
            yield file, file
            return
        arrow = extra_module("pyarrow")
        try:
            with arrow.CompressedInputStream(arrow.PythonFile(file), packed) as stream:
                yield stream, file
        except (OSError, arrow.ArrowException) as error:
            raise InputError(
                f"{path}: {packed}: {str(error)[:200]}: expected a whole file"
            ) from error


@contextlib.contextmanager
def _text(path: Path, encoding: str) -> Iterator[tuple[io.TextIOWrapper, IO[bytes]]]:
    """Opens a text: line feeds end its lines, bad bytes show as numbers."""
    with unpacked(path) as (stream, file):
        try:
            made = io.TextIOWrapper(stream, encoding, "backslashreplace")
        except (LookupError, ValueError) as error:
            raise InputError(
                f"{path}: table.encoding: {encoding[:40]}: expected one that Python "
                "knows, such as utf-8, utf-16, cp1252"
            ) from error
        try:
            yield made, file
        except (TypeError, UnicodeError) as error:  # no text, or no mark of utf-16
            raise InputError(
                f"{path}: text: {str(error)[:100]}: expected {encoding[:40]}"
            ) from error
        finally:
            made.detach()


def _line(path: Path, text: io.TextIOWrapper) -> str:
    """The next line, "" at the end."""
    line = text.readline(MAX_LINE + 1)
    if len(line) > MAX_LINE:
        raise InputError(
            f"{path}: a line of more than {MAX_LINE} characters: expected one a row"
        )
    return line


def head_of(
    path: Path, encoding: str = "", known: Collection[str] = ()
) -> tuple[str, bool, list[str]]:
    """Returns the encoding of a text, whether it is a guess, and its first lines.

    The lines are fewer where they are long.

    Args:
      path: file.
      encoding: of its characters; "": recognised.
      known: names of which the text should hold some; they tell encodings apart.

    Raises:
      InputError: an empty file, no text, an unknown encoding, a line without an end.
    """
    is_guess = False
    if not encoding:
        with unpacked(path) as (stream, _):
            data = bytes(stream.read(HEAD_BYTES))
        encoding = _recognised(path, data)
        if not encoding:
            encoding, is_guess = _by_names(data, known)
    lines: list[str] = []
    with _text(path, encoding) as (text, _):
        while len(lines) < HEAD_LINES and sum(map(len, lines)) <= MAX_LINE:
            line = text.readline(MAX_LINE + 1) if lines else _line(path, text)
            if not line or len(line) > MAX_LINE:
                break
            lines.append(line)
    some = "".join(lines)[:HEAD_BYTES]
    if not some.strip():
        raise InputError(f"{path}: rows: none: expected a header and rows")
    if sum(map(str.isascii, some)) < MIN_ASCII * len(some):  # digits are
        raise InputError(
            f"{path}: header: hardly any ASCII as {encoding}: expected a table"
        )
    return encoding, is_guess, [line.removesuffix("\n") for line in lines]


def _by_names(data: bytes, known: Collection[str]) -> tuple[str, bool]:
    """Returns the encoding in which most names are found, and whether it is a guess.

    Of those that find as many it is the first in whose words all is letters: names of
    columns in Japanese are signs and fractions in others.
    """
    names = {name.casefold() for name in known if not name.isascii()}
    texts = {name: data.decode(name, "replace").casefold() for name in UNTOLD}
    found = {name: sum(n in text for n in names) for name, text in texts.items()}
    odd = {name: len(NO_LETTERS.findall(text)) for name, text in texts.items()}
    best = max(UNTOLD, key=lambda name: (found[name], -odd[name]))
    is_same = len({texts[name] for name in ONE_BYTE}) == 1
    return best, not (found[best] or is_same)


def _recognised(path: Path, data: bytes) -> str:
    """Returns the encoding of a text by its first bytes; "" one of `UNTOLD`."""
    for mark, name in BYTE_ORDERS.items():
        if data.startswith(mark):
            return name
    # of letters, digits and commas every other byte is 0
    for first, name in ((1, "utf-16-le"), (0, "utf-16-be")):
        zeros, others = data[first::2].count(0), data[1 - first :: 2].count(0)
        if zeros > 0.4 * len(data) and others < 0.05 * len(data):
            return name
    try:
        codecs.getincrementaldecoder("utf-8")().decode(data)
    except UnicodeDecodeError as error:
        if b"\0" in data:
            raise InputError(f"{path}: text: {error}: expected a table") from error
        return ""
    return "utf-8"


def blocks(
    path: Path, encoding: str, quote: str, show: Callable[[int], object] | None = None
) -> Iterator[tuple[int, str]]:
    """Yields (number of its first line, whole rows) of a text, a few MiB at a time.

    Args:
      path: file.
      encoding: of its characters.
      quote: inside of which a row may go on in the next line; "": nowhere.
      show: called with the bytes of the file just read.

    Raises:
      InputError: a damaged archive, a line without an end.
    """
    number, at = 1, 0
    with _text(path, encoding) as (text, file):
        while True:
            parts = [text.read(READ_CHARS), _line(path, text)]
            is_open = quote and sum(part.count(quote) for part in parts) % 2
            for _ in range(MAX_SPAN if is_open else 0):
                parts.append(_line(path, text))
                if parts[-1].count(quote) % 2:
                    break
            block = "".join(parts)
            if show is not None:
                show(file.tell() - at)
                at = file.tell()
            if not block:
                return
            yield number, block
            number += block.count("\n")
