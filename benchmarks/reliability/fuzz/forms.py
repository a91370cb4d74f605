"""Files of every form, changed inside it, checksums and lengths made right.

Most forms are read as a tree of dicts, lists and scalars, which is changed somewhere
and written again (`in_tree`). Where bytes are no such file, they are changed as bytes.
"""

import ast
import contextlib
import functools
import hashlib
import io
import json
import random
import re
import sqlite3
import struct
import tomllib
import zipfile
from collections.abc import Callable
from typing import Any
from xml.etree.ElementTree import Element, tostring

import google_crc32c
import msgpack
import numpy as np
import pyarrow
import pyarrow.parquet
from defusedxml import ElementTree
from google.protobuf.empty_pb2 import Empty
from google.protobuf.message import DecodeError
from google.protobuf.unknown_fields import UnknownFieldSet

from benchmarks.reliability.fuzz.changes import (
    TEXTS,
    changed_bytes,
    changed_tree,
    copies,
)
from rcirl_jax.data.readers.tfrecord import FOOTER, FRAME_BYTES, HEADER, mask

Codec = Callable[[bytes, random.Random], bytes]
HUGE = "0x" + "f" * 4000  # Python reads it, and writes no decimal of so many digits
VARINT, LENGTH = 0, 2  # wire types of protocol buffers
FIXED = {1: ("<Q", "<d"), 5: ("<I", "<f")}  # as whole numbers, and as real ones
MAX_NESTED = 12  # levels of messages that are gone into


def in_tree(load: Callable[[bytes], Any], dump: Callable[[Any], bytes]) -> Codec:
    """A form that is read as a tree and written from one."""
    return lambda data, rng: dump(changed_tree(load(data), rng))


def resealed(payload: dict, field: str) -> bytes:
    """JSON with the digest of its own canonical form in a field, in one line."""
    payload.pop(field, None)
    text = json.dumps(
        payload, sort_keys=True, separators=(",", ":"), allow_nan=False
    ).encode()
    digest = hashlib.sha256(text).hexdigest()
    return text[:-1] + f',"{field}":"{digest}"}}'.encode()


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
    return repr(value) if isinstance(value, int | float) else json.dumps(str(value))


def _toml_file(data: bytes, rng: random.Random) -> bytes:
    text = toml_text(changed_tree(json.loads(_toml_as_json(data)), rng))
    if rng.random() < 0.02:
        text = re.sub(r"(?<== )[0-9.]+", HUGE, text, count=1)
    return text.encode()


@functools.lru_cache(maxsize=512)
def _toml_as_json(data: bytes) -> str:
    return json.dumps(tomllib.loads(data.decode()))


def _element(node: Element) -> list:
    return [node.tag, dict(node.attrib), node.text or "", [*map(_element, node)]]


def _xml(tree: list) -> Element:
    tag, attributes, text, children = tree
    node = Element(str(tag), {str(k): str(v) for k, v in attributes.items()})
    node.text = str(text)
    node.extend([_xml(child) for child in children])
    return node


def _table(data: bytes, rng: random.Random) -> bytes:
    """Text in rows and columns: one column in every fifth, else rows and cells."""
    text = data.decode()
    mark = next((mark for mark in ",;\t " if mark in text), ",")
    rows = [row.split(mark) for row in text.split("\n")]
    if rng.random() < 0.2:
        at, word = rng.randrange(len(rows[0])), rng.choice(([], [rng.choice(TEXTS)]))
        head = rows[:1] if word else []  # a column that is gone has no name either
        rows = head + [row[:at] + word + row[at + 1 :] for row in rows[len(head) :]]
    else:
        rows = changed_tree(rows, rng)
    cells = [row if isinstance(row, list) else [row] for row in rows]
    return "\n".join(mark.join(map(str, row)) for row in cells).encode()


def varint(value: int) -> bytes:
    """A base-128 number."""
    value &= 2**64 - 1
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _field(number: int, wire: int, value: Any) -> bytes:  # noqa: ANN401
    head = varint(number << 3 | wire)
    if wire == VARINT:
        return head + varint(int(value))
    if wire == LENGTH:
        whole = value.encode(errors="surrogatepass") if type(value) is str else value
        return head + varint(len(whole)) + whole
    plain, real = FIXED[wire]
    if type(value) is float:
        return head + struct.pack(real, value)
    return head + struct.pack(plain, value % 2 ** (8 * struct.calcsize(plain)))


def message(data: bytes, rng: random.Random, depth: int = 0) -> bytes:
    """A protocol buffer: some fields of one of the messages that it holds."""
    found = UnknownFieldSet(Empty.FromString(data))
    parts = [[field.field_number, field.wire_type, field.data] for field in found]
    parts = parts or [[rng.randrange(1, 30), VARINT, 1]]
    inner = [part for part in parts if part[1] == LENGTH]
    if inner and depth < MAX_NESTED and rng.random() < 0.8:
        part = rng.choice(inner)
        with contextlib.suppress(DecodeError, ValueError, TypeError):
            part[2] = message(part[2], rng, depth + 1)
            return b"".join(_field(*part) for part in parts)
    return b"".join(_field(*part) for part in changed_tree(parts, rng))


def _one_of(parts: list, rng: random.Random) -> None:
    """One of [..., message] changed inside, or put in again."""
    at = rng.randrange(len(parts))
    if rng.random() < 0.1:
        parts[at:at] = [[*rng.choice(parts)]] * copies(rng)
    else:
        parts[at][-1] = message(parts[at][-1], rng)


def _tfrecord(data: bytes, rng: random.Random) -> bytes:
    records, at = [], 0
    while at < len(data):
        (size, _) = HEADER.unpack_from(data, at)
        records.append([data[at + HEADER.size : at + HEADER.size + size]])
        at += FRAME_BYTES + size
    _one_of(records, rng)
    out = b""
    for (record,) in records:
        size = struct.pack("<Q", len(record))
        sums = [FOOTER.pack(mask(google_crc32c.value(part))) for part in (size, record)]
        out += size + sums[0] + record + sums[1]
    return out


def _cyber(data: bytes, rng: random.Random) -> bytes:
    """A cyber record: one section's message, its kind, or the order of sections."""
    head, at, sections = data[: 16 + 2048], 16 + 2048, []
    while at + 16 <= len(data):
        kind, size = struct.unpack_from("<i4xq", data, at)
        if size < 0:  # would be read again and again
            raise ValueError(f"a section of {size} bytes")
        sections.append([kind, data[at + 16 : at + 16 + size]])
        at += 16 + size
    _one_of(sections, rng)
    if rng.random() < 0.1:
        rng.choice(sections)[0] = rng.choice((1, 2, 4))
    return head + b"".join(struct.pack("<i4xq", k, len(b)) + b for k, b in sections)


def _weights(data: bytes, rng: random.Random) -> bytes:
    outer = msgpack.unpackb(data)
    if rng.random() < 0.1:
        return msgpack.packb(changed_tree(outer, rng)) or b""
    body = msgpack.packb(changed_tree(msgpack.unpackb(outer["body"]), rng)) or b""
    outer.update(body=body, sha256=hashlib.sha256(body).hexdigest())
    return msgpack.packb(outer) or b""


def _quoted(name: object) -> str:
    return '"' + str(name).replace('"', '""') + '"'


def _tables(data: bytes) -> dict[str, list[list]]:
    """Of a SQLite database: table -> its head and rows."""
    with contextlib.closing(sqlite3.connect(":memory:")) as base:
        base.deserialize(data)
        kinds = "SELECT name FROM sqlite_master WHERE type = 'table'"
        found = {}
        for (name,) in base.execute(kinds).fetchall():
            rows = base.execute(f"SELECT * FROM {_quoted(name)}")
            found[name] = [[x[0] for x in rows.description], *map(list, rows)]
        return found


def _sqlite(tables: dict[str, list[list]]) -> bytes:
    with contextlib.closing(sqlite3.connect(":memory:")) as base:
        base.execute("PRAGMA page_size = 512")
        for name, (head, *rows) in tables.items():
            columns = ", ".join(map(_quoted, head))
            base.execute(f"CREATE TABLE {_quoted(name)} ({columns})")
            marks = ", ".join("?" * len(head))
            base.executemany(f"INSERT INTO {_quoted(name)} VALUES ({marks})", rows)
        base.commit()
        return base.serialize()


_first: list[bytes] = []


@functools.cache
def _seed_columns() -> str:
    found = pyarrow.parquet.read_table(io.BytesIO(_first[0])).to_pydict()
    return repr(found)


def _columns(data: bytes) -> dict[str, list]:
    """Of the first Parquet file given: a damaged one could end this process."""
    if not _first:
        _first.append(data)
    return ast.literal_eval(_seed_columns())


def _parquet(columns: dict[str, list]) -> bytes:
    out, rows = io.BytesIO(), max(map(len, columns.values()))
    made = {k: (v * rows)[:rows] for k, v in columns.items()}  # all of one length
    pyarrow.parquet.write_table(pyarrow.table(made), out, row_group_size=1 + rows // 2)
    return out.getvalue()


def archive_of(members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """A zip archive of these files."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return out.getvalue()


def _npz(data: bytes, rng: random.Random) -> bytes:
    """Members as values, or as what a head claims and the bytes of the numbers."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        whole = {name: archive.read(name) for name in archive.namelist()}
    tree = {
        name: [ast.literal_eval(content[10:128].decode()), content[128:]]
        if rng.random() < 0.5
        else np.load(io.BytesIO(content)).tolist()
        for name, content in whole.items()
    }
    made = changed_tree(tree, rng)
    return archive_of({str(name): _npy(value) for name, value in made.items()})


def _npy(value: Any) -> bytes:  # noqa: ANN401
    if isinstance(value, list) and len(value) == 2 and isinstance(value[1], bytes):
        text = repr(value[0]).encode().ljust(117) + b"\n"
        size = len(text).to_bytes(2, "little")
        return b"\x93NUMPY\x01\x00" + size + text + value[1]
    out = io.BytesIO()
    np.save(out, np.asarray(value), allow_pickle=False)
    return out.getvalue()


def _lines(data: bytes) -> list:
    return [json.loads(line) for line in data.splitlines()]


CODECS: dict[str, Codec] = {
    "bytes": changed_bytes,
    "cyber": _cyber,
    "hash": in_tree(json.loads, lambda tree: resealed(tree, "hash")),
    "json": in_tree(json.loads, lambda tree: json.dumps(tree).encode()),
    "json_lines": in_tree(_lines, lambda x: "\n".join(map(json.dumps, x)).encode()),
    "message": message,
    "npz": _npz,
    "parquet": in_tree(_columns, _parquet),
    "sha256": in_tree(json.loads, lambda tree: resealed(tree, "sha256")),
    "sqlite": in_tree(_tables, _sqlite),
    "table": _table,
    "tfrecord": _tfrecord,
    "toml": _toml_file,
    "weights": _weights,
    "xml": in_tree(
        lambda data: _element(ElementTree.fromstring(data)),
        lambda tree: tostring(_xml(tree)),
    ),
}
SUFFIXES = {
    **{".json": "json", ".zarray": "json", ".zattrs": "json", ".jsonl": "json_lines"},
    **{".toml": "toml", ".xml": "xml", ".osm": "xml", ".osm_xy": "xml"},
    **{".csv": "table", ".txt": "table", ".parquet": "parquet", ".npz": "npz"},
    **{".db": "sqlite", ".gpkg": "sqlite", ".pb": "message", ".msgpack": "weights"},
}


def form_of(name: str) -> str:
    """The codec of a file, by its name."""
    for part, form in ((".tfrecord", "tfrecord"), (".record", "cyber")):
        if part in name:
            return form
    suffix = "." + name.rsplit(".", 1)[-1]
    own = {"manifest.json": "hash", "shard.json": "sha256"}
    return own.get(name, SUFFIXES.get(suffix, "bytes"))


def mutate(data: bytes, form: str, rng: random.Random) -> bytes:
    """A changed file of this form; changed bytes where it is none, and now and then."""
    if rng.random() < 0.8:
        # whatever a changed tree makes a writer raise
        with contextlib.suppress(Exception, RecursionError):
            return CODECS[form](data, rng)
    return changed_bytes(data, rng)
