"""Files of one form changed inside that form, checksums and lengths made right.

A codec takes the bytes of a file and a source of randomness, and returns the bytes of
a file of the same form with something else in it. Where the bytes are no such file,
it raises anything, and the caller changes plain bytes instead.
"""

import functools
import hashlib
import json
import math
import random
import re
import struct
import tomllib
from collections.abc import Callable, Iterable
from typing import Any
from xml.etree.ElementTree import Element, tostring

import google_crc32c
import msgpack
from defusedxml import ElementTree
from google.protobuf.empty_pb2 import Empty
from google.protobuf.message import DecodeError
from google.protobuf.unknown_fields import UnknownFieldSet

from benchmarks.reliability.fuzz import containers
from benchmarks.reliability.fuzz.trees import (
    TEXTS,
    copies,
    mutate_bytes,
    mutate_text,
    mutate_tree,
    near,
    odd_scalar,
)
from rcirl_jax.data.readers.tfrecord import FOOTER, FRAME_BYTES, HEADER, mask

Codec = Callable[[bytes, random.Random], bytes]
HUGE = "0x" + "f" * 4000  # Python reads it, and writes no decimal of so many digits
VARINT, LENGTH = 0, 2  # wire types of protocol buffers
# of numbers of one size: as the library gives them, and as what they are changed
FIXED = {1: ("<Q", "<d"), 5: ("<I", "<f")}
MAX_NESTED = 12  # levels of messages that are gone into
CELLS = (
    *("", " ", "0", "-1", "1e300", "-1e300", "1e12", "NaN", "inf", "-inf", "1e-320"),
    *("99999999999999999999", "0x10", "1_000", "1,5", '"', '"a,b"', "car", "\0", "١٢"),
    *("\ufeff", "\u2028", "x" * 3000, "2147483648", "true", "None", "NULL", "-", "+"),
)


def json_file(data: bytes, rng: random.Random) -> bytes:
    """JSON: the tree of values."""
    return json.dumps(mutate_tree(json.loads(data), rng)).encode()


def json_lines(data: bytes, rng: random.Random) -> bytes:
    """JSON Lines: one line, or their order."""
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    if rng.random() < 0.1:
        lines[at:at] = [rng.choice(lines)] * copies(rng)
    else:
        lines[at] = json_file(lines[at], rng)
    return b"\n".join(lines)


def sealed(field: str) -> Codec:
    """JSON that holds the digest of its own canonical form."""

    def mutate(data: bytes, rng: random.Random) -> bytes:
        payload = json.loads(data)
        payload.pop(field, None)
        return resealed(mutate_tree(payload, rng), field)

    return mutate


def resealed(payload: dict, field: str) -> bytes:
    """As the dataset's own sealing, in one line and so many times faster."""
    text = json.dumps(
        payload, sort_keys=True, separators=(",", ":"), allow_nan=False
    ).encode()
    digest = hashlib.sha256(text).hexdigest()
    return text[:-1] + f',"{field}":"{digest}"}}'.encode()


def toml_file(data: bytes, rng: random.Random) -> bytes:
    """TOML: the tree of values."""
    text = toml_text(mutate_tree(json.loads(_toml_as_json(data)), rng))
    if rng.random() < 0.02:
        text = re.sub(r"(?<== )[0-9.]+", HUGE, text, count=1)
    return text.encode()


@functools.lru_cache(maxsize=512)
def _toml_as_json(data: bytes) -> str:
    return json.dumps(tomllib.loads(data.decode()))


def toml_text(tree: dict) -> str:
    """A dict as TOML, a line per key."""
    return "\n".join(f"{_key(key)} = {_toml(value)}" for key, value in tree.items())


def _key(key: object) -> str:
    text = str(key)
    return text if re.fullmatch(r"[A-Za-z0-9_.-]+", text) else json.dumps(text)


def _toml(value: Any) -> str:  # noqa: ANN401
    if isinstance(value, dict):
        inner = ", ".join(f"{_key(k)} = {_toml(v)}" for k, v in value.items())
        return f"{{{inner}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, int | float):
        return repr(value)
    return json.dumps(str(value))


def xml_file(data: bytes, rng: random.Random) -> bytes:
    """XML: attributes, texts, tags and the order and number of elements."""
    root = ElementTree.fromstring(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        nodes = list(root.iter())
        _change_element(rng.choice(nodes), nodes, rng)
    return tostring(root)


def _change_element(node: Element, nodes: list[Element], rng: random.Random) -> None:
    kind = rng.randrange(8)
    word = rng.choice(CELLS)
    if kind <= 1 and node.attrib:
        node.set(rng.choice(sorted(node.attrib)), word)
    elif kind == 2 and node.attrib:
        del node.attrib[rng.choice(sorted(node.attrib))]
    elif kind == 3 and len(node):
        node.remove(rng.choice(list(node)))
    elif kind == 4 and len(node):
        node.extend([rng.choice(list(node))] * copies(rng))
    elif kind == 5:
        other = rng.choice(nodes)
        node.tag, node.text, node.attrib = other.tag, other.text, dict(other.attrib)
    elif kind == 6 and rng.random() < 0.1:
        for _ in range(rng.choice((10, 100, 400))):
            child = Element(node.tag)
            node.append(child)
            node = child
    else:
        node.text = word if rng.random() < 0.5 else near(node.text or "", rng)


def table(data: bytes, rng: random.Random) -> bytes:
    """Text in rows and columns: cells, columns, the order and number of rows."""
    text = data.decode()
    separator = next((mark for mark in ",;\t " if mark in text), ",")
    rows = text.split("\n")
    for _ in range(rng.choice((1, 1, 2, 4))):
        rows = _change_rows(rows, separator, rng)
    return "\n".join(rows).encode()


def _change_rows(rows: list[str], separator: str, rng: random.Random) -> list[str]:
    kind, at = rng.randrange(10), rng.randrange(len(rows))
    cells = rows[at].split(separator)
    column = rng.randrange(len(cells))
    if kind <= 3:
        cells[column] = _cell(cells[column], rng)
        return [*rows[:at], separator.join(cells), *rows[at + 1 :]]
    if kind == 4:
        return rows[:at] + rows[at + rng.choice((1, 5, 50)) :]
    if kind == 5:
        return [*rows[:at], *[rows[at]] * copies(rng), *rows[at:]]
    if kind == 6:
        head, rest = rows[:1], rows[1:]
        rng.shuffle(rest)
        return head + rest
    if kind == 7:
        return [_without(row, separator, column) for row in rows]
    if kind == 8:
        return _same_column(rows, separator, column, _cell(cells[column], rng))
    return rows[: rng.choice((0, 1, 2, at))]


def _cell(cell: str, rng: random.Random) -> str:
    if rng.random() < 0.5:
        return rng.choice(CELLS)
    try:
        return str(near(float(cell), rng))
    except ValueError:
        return mutate_text(cell, rng)


def _without(row: str, separator: str, column: int) -> str:
    cells = row.split(separator)
    return separator.join(cells[:column] + cells[column + 1 :])


def _same_column(rows: list[str], separator: str, column: int, value: str) -> list[str]:
    """One value in a whole column; the head keeps its name."""
    made = rows[:1]
    for row in rows[1:]:
        cells = row.split(separator)
        if column < len(cells):
            cells[column] = value
        made.append(separator.join(cells))
    return made


def varint(value: int) -> bytes:
    """A base-128 number."""
    value &= 2**64 - 1
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _packed(parts: Iterable[tuple[int, int, Any]]) -> bytes:
    out = []
    for number, wire, value in parts:
        out.append(varint(number << 3 | wire))
        if wire == VARINT:
            out.append(varint(value))
        elif wire == LENGTH:
            out.append(varint(len(value)) + value)
        else:
            out.append(struct.pack(FIXED[wire][0], value))
    return b"".join(out)


def message(data: bytes, rng: random.Random, depth: int = 0) -> bytes:
    """A protocol buffer: one field somewhere in the messages it holds."""
    found = UnknownFieldSet(Empty.FromString(data))
    parts = [(field.field_number, field.wire_type, field.data) for field in found]
    if not parts:
        return varint(rng.randrange(1, 30) << 3) + varint(rng.choice((0, 1, 2**63)))
    at, kind = rng.randrange(len(parts)), rng.randrange(10)
    number, wire, value = parts[at]
    if kind == 0:
        del parts[at]
    elif kind == 1:
        parts[at:at] = [parts[at]] * copies(rng)
    elif kind == 2:
        parts[at] = (rng.choice((number + 1, 1, 2, 3, 2**20)), wire, value)
    elif kind == 3:
        parts[at] = parts[rng.randrange(len(parts))]
    else:
        parts[at] = (number, wire, _wire_value(wire, value, rng, depth))
    return _packed(parts)


def _wire_value(wire: int, value: Any, rng: random.Random, depth: int) -> Any:  # noqa: ANN401
    if wire == VARINT:
        odd = odd_scalar(rng)
        return odd if type(odd) is int else near(value, rng).__int__()
    if wire in FIXED:
        whole, real = FIXED[wire]
        return struct.unpack(whole, struct.pack(real, _real(rng)))[0]
    if depth < MAX_NESTED and rng.random() < 0.85:
        try:
            return message(value, rng, depth + 1)
        except (DecodeError, ValueError, OverflowError):
            pass
    if rng.random() < 0.3:
        return rng.choice(TEXTS).encode(errors="surrogatepass")
    return mutate_bytes(value, rng)


def _real(rng: random.Random) -> float:
    return rng.choice(
        (0.0, -1.0, 1e-30, 1e7, 1e30, -1e30, math.nan, math.inf, rng.gauss(0.0, 1e3))
    )


def tfrecord(data: bytes, rng: random.Random) -> bytes:
    """A TFRecord file: one record, or their number; sums are those of the data."""
    records, at = [], 0
    while at < len(data):
        (size, _) = HEADER.unpack_from(data, at)
        records.append(data[at + HEADER.size : at + HEADER.size + size])
        at += FRAME_BYTES + size
    which = rng.randrange(len(records))
    if rng.random() < 0.1:
        odd = rng.choice((records, [b""], [b"\0" * 9], [records[which]] * copies(rng)))
        records[which:which] = odd
    else:
        records[which] = message(records[which], rng)
    return b"".join(map(_framed, records))


def _framed(record: bytes) -> bytes:
    size = struct.pack("<Q", len(record))
    sums = [FOOTER.pack(mask(google_crc32c.value(part))) for part in (size, record)]
    return size + sums[0] + record + sums[1]


def cyber(data: bytes, rng: random.Random) -> bytes:
    """A cyber record: one section's message, its kind, or the order of sections."""
    head, at, sections = data[: 16 + 2048], 16 + 2048, []
    while at + 16 <= len(data):
        kind, size = struct.unpack_from("<i4xq", data, at)
        if size < 0:  # would be read again and again
            raise ValueError(f"a section of {size} bytes")
        sections.append((kind, data[at + 16 : at + 16 + size]))
        at += 16 + size
    which = rng.randrange(len(sections))
    kind, body = sections[which]
    if rng.random() < 0.1:
        sections[which:which] = [rng.choice(sections)] * copies(rng)
    else:
        sections[which] = (rng.choice((kind,) * 9 + (1, 2, 4)), message(body, rng))
    return head + b"".join(struct.pack("<i4xq", k, len(b)) + b for k, b in sections)


def weights(data: bytes, rng: random.Random) -> bytes:
    """A weights file: the tree of its body; the sha256 is the body's."""
    outer = msgpack.unpackb(data)
    if rng.random() < 0.1:
        return msgpack.packb(mutate_tree(outer, rng)) or b""
    body = msgpack.packb(mutate_tree(msgpack.unpackb(outer["body"]), rng)) or b""
    outer.update(body=body, sha256=hashlib.sha256(body).hexdigest())
    return msgpack.packb(outer) or b""


CODECS: dict[str, Codec] = {
    "bytes": mutate_bytes,
    "cyber": cyber,
    "hash": sealed("hash"),
    "json": json_file,
    "json_lines": json_lines,
    "message": message,
    "npz": containers.npz,
    "parquet": containers.parquet,
    "sha256": sealed("sha256"),
    "sqlite": containers.sqlite,
    "table": table,
    "tfrecord": tfrecord,
    "toml": toml_file,
    "weights": weights,
    "xml": xml_file,
}
SUFFIXES = {
    **{".json": "json", ".zarray": "json", ".zattrs": "json", ".jsonl": "json_lines"},
    **{".toml": "toml", ".xml": "xml", ".osm": "xml", ".osm_xy": "xml"},
    **{".csv": "table", ".txt": "table", ".parquet": "parquet", ".npz": "npz"},
    **{".db": "sqlite", ".gpkg": "sqlite", ".pb": "message", ".msgpack": "weights"},
}


def form_of(name: str) -> str:
    """The codec of a file, by its name."""
    if ".tfrecord" in name:
        return "tfrecord"
    if ".record" in name:
        return "cyber"
    suffix = "." + name.rsplit(".", 1)[-1]
    return {"manifest.json": "hash", "shard.json": "sha256"}.get(
        name, SUFFIXES.get(suffix, "bytes")
    )


def mutate(data: bytes, form: str, rng: random.Random) -> bytes:
    """A changed file of this form; changed bytes where it is none."""
    if rng.random() < 0.8:
        try:
            return CODECS[form](data, rng)
        except (Exception, RecursionError):
            return mutate_bytes(data, rng)
    return mutate_bytes(data, rng)
