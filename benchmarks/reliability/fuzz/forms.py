"""Files of every form, changed inside it, checksums and lengths made right.

Texts are changed word by word; other forms are read as a tree of dicts, lists and
scalars, which is changed somewhere and written again. Where bytes are no such file,
they are changed as bytes.
"""

import contextlib
import hashlib
import io
import json
import random
import sqlite3
import struct
import zipfile
from collections.abc import Callable
from typing import Any

import google_crc32c
import msgpack
from google.protobuf.empty_pb2 import Empty
from google.protobuf.message import DecodeError
from google.protobuf.unknown_fields import UnknownFieldSet

from benchmarks.reliability.fuzz.changes import (
    changed_bytes,
    changed_text,
    changed_tree,
    copies,
)
from rcirl_jax.data.readers.tfrecord import FOOTER, FRAME_BYTES, HEADER, mask

Codec = Callable[[bytes, random.Random], bytes]
VARINT, LENGTH = 0, 2  # wire types of protocol buffers
FIXED = {1: ("<Q", "<d"), 5: ("<I", "<f")}  # as whole numbers, and as real ones
MAX_NESTED = 12  # levels of messages that are gone into
CYBER_HEAD = 16 + 2048  # bytes before the sections of a cyber record


def resealed(payload: dict, field: str) -> bytes:
    """JSON with the digest of its own canonical form in a field, in one line."""
    payload.pop(field, None)
    text = json.dumps(
        payload, sort_keys=True, separators=(",", ":"), allow_nan=False
    ).encode()
    digest = hashlib.sha256(text).hexdigest()
    return text[:-1] + f',"{field}":"{digest}"}}'.encode()


def _sealed(field: str) -> Codec:
    return lambda data, rng: resealed(changed_tree(json.loads(data), rng), field)


def _text(data: bytes, rng: random.Random) -> bytes:
    return changed_text(data.decode(), rng).encode()


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
    at, sections = CYBER_HEAD, []
    while at + 16 <= len(data):
        kind, size = struct.unpack_from("<i4xq", data, at)
        sections.append([kind, data[at + 16 : at + 16 + size]])
        at += 16 + size
    _one_of(sections, rng)
    if rng.random() < 0.1:
        rng.choice(sections)[0] = rng.choice((1, 2, 4))
    parts = [struct.pack("<i4xq", kind, len(body)) + body for kind, body in sections]
    return data[:CYBER_HEAD] + b"".join(parts)


def _weights(data: bytes, rng: random.Random) -> bytes:
    outer = msgpack.unpackb(data)
    body = msgpack.packb(changed_tree(msgpack.unpackb(outer["body"]), rng)) or b""
    outer.update(body=body, sha256=hashlib.sha256(body).hexdigest())
    return msgpack.packb(outer) or b""


def _quoted(name: object) -> str:
    return '"' + str(name).replace('"', '""') + '"'


def _sqlite(data: bytes, rng: random.Random) -> bytes:
    """One cell, column or row of one table."""
    with contextlib.closing(sqlite3.connect(":memory:")) as base:
        base.deserialize(data)
        kinds = "SELECT name FROM sqlite_master WHERE type = 'table'"
        table = _quoted(rng.choice(base.execute(kinds).fetchall())[0])
        rows = base.execute(f"SELECT * FROM {table}")
        tree = [[x[0] for x in rows.description], *map(list, rows)]
        head, *rows = changed_tree(tree, rng)
        base.execute(f"DROP TABLE {table}")
        base.execute(f"CREATE TABLE {table} ({', '.join(map(_quoted, head))})")
        marks = ", ".join("?" * len(head))
        base.executemany(f"INSERT INTO {table} VALUES ({marks})", rows)
        base.commit()
        return base.serialize()


def archive_of(members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """A zip archive of these files."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content, method)
    return out.getvalue()


CODECS: dict[str, Codec] = {
    "manifest.json": _sealed("hash"),
    "shard.json": _sealed("sha256"),
    ".tfrecord": _tfrecord,
    ".record": _cyber,
    ".db": _sqlite,
    ".gpkg": _sqlite,
    ".pb": message,
    ".msgpack": _weights,
}
TEXTS = (".json", ".zarray", ".jsonl", ".toml", ".xml", ".osm", ".csv", ".txt", ".yaml")


def mutate(data: bytes, name: str, rng: random.Random) -> bytes:
    """A changed file of this name; changed bytes where it is none, and now and then."""
    codec = next((x for part, x in CODECS.items() if part in name), None)
    if codec is None and any(part in name for part in TEXTS):
        codec = _text
    if codec is not None and rng.random() < 0.8:
        # whatever a changed tree makes a writer raise
        with contextlib.suppress(Exception, RecursionError):
            return codec(data, rng)
    return changed_bytes(data, rng)
