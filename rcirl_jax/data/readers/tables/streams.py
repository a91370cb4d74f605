"""The text of a file, a few MiB at a time: unpacked, decoded, in whole lines.

What packs a file (gzip, zstd, bzip2) and how its characters are written (UTF-8 with
and without a mark, UTF-16, else Windows' 1252) is told by its bytes, not its name. No
more than a block and one line are held.
"""

import codecs
import contextlib
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

from rcirl_jax.errors import InputError, extra_module

READ_BYTES = 8 * 2**20  # bytes that are decoded at a time
MAX_LINE = 2**24  # characters of a line; pNEUMA writes a drive of minutes into one
MAX_SPAN = 20  # lines of one row, by line ends inside of quotes
HEAD_LINES = 60  # lines from which a layout is recognised
HEAD_BYTES = 2**16  # bytes read at a time for them
MIN_ASCII = 0.2  # share of a head's characters; another encoding has fewer
PACKED = {
    b"\x1f\x8b": "gzip",
    b"\x28\xb5\x2f\xfd": "zstd",
    b"BZh": "bz2",
}  # first bytes -> pyarrow's name
# first bytes -> what a file is that is no table, and what to do
NO_TABLES = {
    b"PK\x03\x04": "a spreadsheet or a zip archive: expected a table; export it as "
    "CSV, or unpack it",
    b"\xd0\xcf\x11\xe0": "an old spreadsheet: expected a table; export it as CSV",
    b"SQLite format 3": "a database: expected a table; export it as CSV",
}
POINTER = b"version https://git-lfs.github.com/spec/"


def first_bytes(path: Path, count: int = 64) -> bytes:
    """The first bytes of a file; none of what is no file."""
    if not path.is_file():
        return b""
    with path.open("rb") as file:
        return file.read(count)


def refuse_pointer(path: Path) -> None:
    """Git LFS leaves a text of three lines where it has not fetched the data.

    Raises:
      InputError: the file is one.
    """
    if first_bytes(path, len(POINTER)) == POINTER:
        raise InputError(
            f"{path}: Git LFS pointer: expected the data themselves; run git lfs pull"
        )


def packing(path: Path) -> str | None:
    """What packs a file, by its first bytes; None: nothing known."""
    head = first_bytes(path)
    return next(
        (name for first, name in PACKED.items() if head.startswith(first)), None
    )


@contextlib.contextmanager
def unpacked(path: Path) -> Iterator[tuple[Any, IO[bytes]]]:
    """(stream of the bytes inside, the file itself) of a file that may be packed.

    Raises:
      InputError: a damaged archive, a Git LFS pointer, a spreadsheet.
    """
    refuse_pointer(path)
    head = first_bytes(path)
    for first, what in NO_TABLES.items():
        if head.startswith(first):
            raise InputError(f"{path}: {what}")
    packed = packing(path)
    with path.open("rb") as file:
        if packed is None:
            yield file, file
            return
        arrow = extra_module("pyarrow")
        try:
            with arrow.CompressedInputStream(arrow.PythonFile(file), packed) as stream:
                yield stream, file
        except (OSError, arrow.ArrowException) as error:
            why = " ".join(str(error).split())[:200]
            raise InputError(
                f"{path}: {packed}: {why}: expected a whole file"
            ) from error


def head_of(path: Path, encoding: str = "") -> tuple[str, list[str]]:
    """(encoding, first whole lines) of a text; fewer where they are long.

    Args:
      path: file.
      encoding: of its characters; "": recognised.

    Raises:
      InputError: an empty file, no text, an unknown encoding, a line without an end.
    """
    with unpacked(path) as (stream, _):
        data = stream.read(HEAD_BYTES)
        encoding = encoding or _recognised(path, data)
        decode, found, ended = _Decoder(path, encoding), "", False
        while not ended and found.count("\n") < HEAD_LINES and len(found) <= MAX_LINE:
            ended = not data
            found += decode(data)
            data = stream.read(HEAD_BYTES)
    whole = found if ended else found[: found.rfind("\n") + 1]
    if not whole and not ended:
        raise line_error(path)
    if not whole.strip():
        raise InputError(f"{path}: rows: none: expected a header and rows")
    some = whole[:HEAD_BYTES]
    if sum(map(str.isascii, some)) < MIN_ASCII * len(some):  # digits are
        raise InputError(
            f"{path}: header: hardly any ASCII as {encoding}: expected a table"
        )
    return encoding, whole.removesuffix("\n").split("\n")[:HEAD_LINES]


def line_error(path: Path) -> InputError:
    """What is wrong with a line longer than `MAX_LINE`."""
    return InputError(
        f"{path}: a line of more than {MAX_LINE} characters: expected one a row"
    )


def _recognised(path: Path, data: bytes) -> str:
    """Encoding of a text by its first bytes."""
    for mark, name in (
        (codecs.BOM_UTF8, "utf-8-sig"),
        (codecs.BOM_UTF32_LE, "utf-32"),
        (codecs.BOM_UTF16_LE, "utf-16"),
        (codecs.BOM_UTF16_BE, "utf-16"),
    ):
        if data.startswith(mark):
            return name
    # of letters, digits and commas every other byte is 0
    for first, name in ((1, "utf-16-le"), (0, "utf-16-be")):
        zeros = data[first::2].count(0), data[1 - first :: 2].count(0)
        if zeros[0] > 0.4 * len(data) and zeros[1] < 0.05 * len(data):
            return name
    try:
        codecs.getincrementaldecoder("utf-8")().decode(data)
    except UnicodeDecodeError as error:
        if b"\0" in data:
            raise InputError(f"{path}: text: {error}: expected a table") from error
        return "cp1252"
    return "utf-8"


class _Decoder:
    """Bytes -> text, line feeds at its lines' ends; bad bytes show as numbers."""

    def __init__(self, path: Path, encoding: str) -> None:
        self._path, self._encoding = path, encoding
        try:
            made = codecs.getincrementaldecoder(encoding)("backslashreplace")
        except (LookupError, ValueError) as error:
            raise InputError(
                f"{path}: table.encoding: {encoding[:40]}: expected one that Python "
                "knows, such as utf-8, utf-16, cp1252"
            ) from error
        self._made = io.IncrementalNewlineDecoder(made, translate=True)

    def __call__(self, data: bytes) -> str:
        """The text of the next bytes; none end it."""
        try:
            return self._made.decode(bytes(data), final=not data)
        except (TypeError, ValueError) as error:  # no text, or no mark of utf-16
            why = " ".join(str(error).split())[:100]
            raise InputError(
                f"{self._path}: text: {why}: expected {self._encoding[:40]}"
            ) from error


def blocks(
    path: Path, encoding: str, quote: str, show: Callable[[int], object] | None = None
) -> Iterator[tuple[int, str, bool]]:
    """(number of its first line, whole lines, whether they end the file) of a text.

    Args:
      path: file.
      encoding: of its characters.
      quote: inside of which a row may go on in the next line; "": nowhere.
      show: called with the bytes of the file just read.

    Raises:
      InputError: a damaged archive, a line without an end.
    """
    decode, rest, line, at = _Decoder(path, encoding), "", 1, 0
    with unpacked(path) as (stream, file):
        while True:
            data = stream.read(READ_BYTES)
            rest += decode(data)
            if show is not None:
                show(file.tell() - at)
                at = file.tell()
            if not data:
                break
            cut = _cut(rest, quote)
            if cut == 0 and len(rest) > MAX_LINE:
                raise line_error(path)
            if cut:
                yield line, rest[:cut], False
                line, rest = line + rest.count("\n", 0, cut), rest[cut:]
    if rest:
        yield line, rest, True


def _cut(text: str, quote: str) -> int:
    """Where the last whole row ends: not inside of quotes, if that can be told."""
    last = text.rfind("\n") + 1
    if not quote or not last or text.count(quote, 0, last) % 2 == 0:
        return last
    cut = last
    for _ in range(MAX_SPAN):
        before = text.rfind("\n", 0, max(cut - 1, 0)) + 1
        if before == 0:
            break
        if text.count(quote, before, last) % 2 == 1:
            return before
        cut = before
    return last
