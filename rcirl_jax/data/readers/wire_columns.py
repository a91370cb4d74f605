"""Protocol buffers of known fields as numpy columns, for large messages.

The format (https://protobuf.dev/programming-guides/encoding): a message is a
run of fields, each a varint tag `number << 3 | wire type` and a value; wire type
0 is a varint, 1 is 8 bytes, 2 a length and so many bytes, 5 is 4 bytes. Fields
that are not asked for, or that have another wire type, are skipped.

Two ways of reading keep Python loops away from samples. `walk` reads the fields
of ONE message and keeps equally long neighbours (the states of a track, the
points of a line) as one run. `columns` reads MANY small messages in lockstep:
step k decodes the k-th field of all of them with numpy.
"""

import dataclasses
import struct
from collections.abc import Iterable, Mapping

import numpy as np

from rcirl_jax.errors import InputError

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
MAX_VARINT = 10  # bytes
MAX_FIELDS = 2_000_000  # walked in one record; a scenario has some 1e5
MAX_SMALL = 4096  # bytes of a message that `columns` reads
PADDING = 32  # bytes behind the data, so that the last value may be read whole
# what `columns` reads: kind -> wire type
KINDS = {"int": VARINT, "double": FIXED64, "message": BYTES, "float": FIXED32}
SIZES = {FIXED64: 8, FIXED32: 4}
EXPECTED = "a protobuf message"


@dataclasses.dataclass(frozen=True)
class Fields:
    """The fields of one message that `walk` was asked for."""

    record: "Record"
    # tag -> varints, or runs (start, length, stride, count) of byte spans
    found: dict[int, list]

    def whole(self, number: int, default: int = 0) -> int:
        """A singular integer; the last one counts."""
        values = self.found.get(number << 3 | VARINT)
        return _signed(values[-1]) if values else default

    def wholes(self, number: int) -> list[int]:
        """A repeated integer, packed or not."""
        values = list(self.found.get(number << 3 | VARINT, []))
        for start, end in self.spans(number).tolist():
            at = start
            while at < end:
                value, at = self.record.varint(at, end)
                self.record.spend(1)
                values.append(value)
        return [_signed(value) for value in values]

    def double(self, number: int, default: float = 0.0) -> float:
        """A singular double; the last one counts."""
        runs = self.found.get(number << 3 | FIXED64)
        if not runs:
            return default
        return struct.unpack_from("<d", self.record.data, runs[-1][0])[0]

    def doubles(self, number: int) -> np.ndarray:
        """A repeated double, packed or not: [n] float64."""
        starts = _expand(self.found.get(number << 3 | FIXED64, []))[:, 0]
        pieces = [self.record.view("<f8")[starts]]
        for start, end in self.spans(number).tolist():
            if (end - start) % 8:
                raise self.record.error(
                    f"field {number}: {end - start} bytes", "a multiple of 8"
                )
            pieces.append(np.frombuffer(self.record.data[start:end], "<f8"))
        return np.concatenate(pieces)

    def text(self, number: int) -> str:
        """A singular string; the last one counts."""
        start, end = self.last(number) or (0, 0)
        try:
            return self.record.data[start:end].decode("utf-8")
        except UnicodeDecodeError as error:
            raise self.record.error(f"field {number}: {error}", "UTF-8") from error

    def last(self, number: int) -> tuple[int, int] | None:
        """Byte span of a singular message; the last one counts."""
        runs = self.found.get(number << 3 | BYTES)
        if not runs:
            return None
        start, length, stride, count = runs[-1]
        start += (count - 1) * stride
        return start, start + length

    def spans(self, number: int) -> np.ndarray:
        """Byte spans [n, 2] of a repeated message."""
        return _expand(self.found.get(number << 3 | BYTES, []))


def _signed(value: int) -> int:
    """A varint as int64, in which negative numbers are stored."""
    return value - (1 << 64) if value >> 63 else value


def _expand(runs: list[tuple[int, int, int, int]]) -> np.ndarray:
    """Runs (start, length, stride, count) -> spans [n, 2]."""
    if not runs:
        return np.zeros((0, 2), np.int64)
    if len(runs) == 1:
        start, length, stride, count = runs[0]
        begin = start + stride * np.arange(count)
        return np.stack([begin, begin + length], axis=1)
    start, length, stride, count = np.array(runs, np.int64).T
    first = np.cumsum(count) - count
    place = np.arange(count.sum()) - np.repeat(first, count)
    begin = np.repeat(start, count) + place * np.repeat(stride, count)
    return np.stack([begin, begin + np.repeat(length, count)], axis=1)


class Record:
    """One serialised message; counts the fields walked, to bound the work."""

    def __init__(self, where: str, data: bytes) -> None:
        self.where = where  # names file and record in errors
        self.data = data
        self._padded = np.frombuffer(data + bytes(PADDING), np.uint8)
        self._budget = MAX_FIELDS

    def error(self, found: str, expected: str) -> InputError:
        """The line for something wrong in this record."""
        return InputError(f"{self.where}: {found}: expected {expected}")

    def view(self, kind: str) -> np.ndarray:
        """The bytes as overlapping numbers: [i] is the number that starts at i."""
        size = np.dtype(kind).itemsize
        count = self._padded.size - size + 1
        return np.ndarray((count,), kind, self._padded, strides=(1,))

    def varint(self, at: int, end: int) -> tuple[int, int]:
        """(value, offset behind it) of the varint at an offset."""
        data, value = self.data, 0
        for place in range(min(MAX_VARINT, end - at)):
            byte = data[at + place]
            value |= (byte & 0x7F) << (7 * place)
            if byte < 0x80:
                return value & 0xFFFFFFFFFFFFFFFF, at + place + 1
        raise self.error(f"byte {at}: varint without end", EXPECTED)

    def walk(self, span: Iterable[int], wanted: Iterable[int]) -> Fields:
        """The wanted fields (by number) of the message in a span (start, end)."""
        at, end = (int(place) for place in span)
        numbers = frozenset(wanted)
        found: dict[int, list] = {}
        while at < end:
            tag, value_at = self.varint(at, end)
            kind, count = tag & 7, 1
            if kind == VARINT:
                entry, after = self.varint(value_at, end)
            else:
                length, value_at = self._length(kind, value_at, end)
                after = value_at + length
                stride = after - at
                if after < end and kind == BYTES:
                    count = self._run(at, value_at - at, stride, end)
                    after += (count - 1) * stride
                entry = (value_at, length, stride, count)
            if after > end or tag < 8:
                raise self.error(f"byte {at}: field {tag >> 3} of {end}", EXPECTED)
            self.spend(count)
            if tag >> 3 in numbers:
                found.setdefault(tag, []).append(entry)
            at = after
        return Fields(self, found)

    def _length(self, kind: int, at: int, end: int) -> tuple[int, int]:
        """(bytes of a value, its offset)."""
        if kind == BYTES:
            return self.varint(at, end)
        if kind not in SIZES:
            raise self.error(f"byte {at}: wire type {kind}", EXPECTED)
        return SIZES[kind], at

    def _run(self, at: int, head: int, stride: int, end: int) -> int:
        """How many fields from `at` on have the same tag and length bytes."""
        first = self.data[at : at + head]
        most = (end - at) // stride
        if most < 2 or self.data[at + stride : at + stride + head] != first:
            return 1
        count, step = 2, 64
        while count < most:
            step = min(step, most - count)
            begin, end = at + count * stride, at + (count + step) * stride
            same = np.ones(step, bool)
            for place, byte in enumerate(first):
                same &= self._padded[begin + place : end : stride] == byte
            if not same.all():
                return count + int(np.argmin(same))
            # steps grow with the run: looking ahead costs no more than the run
            count, step = count + step, 2 * step
        return count

    def spend(self, count: int) -> None:
        """Count fields or packed values that Python steps over."""
        self._budget -= count
        if self._budget < 0:
            raise self.error(f"more than {MAX_FIELDS} fields", "fewer")

    def columns(
        self, spans: np.ndarray, kinds: Mapping[int, str]
    ) -> dict[int, np.ndarray]:
        """Singular fields of many small messages.

        Args:
          spans: [n, 2] byte spans of the messages.
          kinds: field number -> "int", "double", "float" or "message".

        Returns:
          Per field [n] int64 or float64, zero where it is absent (proto2's
          default); for messages their spans [n, 2], of no length if absent.
        """
        longest = int((spans[:, 1] - spans[:, 0]).max(initial=0))
        if longest > MAX_SMALL:
            raise self.error(f"message of {longest} bytes", f"at most {MAX_SMALL}")
        found = {number: _empty(kind, len(spans)) for number, kind in kinds.items()}
        rows = np.flatnonzero(spans[:, 0] < spans[:, 1])
        at, end = spans[rows, 0], spans[rows, 1]
        while rows.size:
            at = self._column(rows, at, kinds, found)
            beyond = np.flatnonzero(at > end)
            if beyond.size:
                raise self.error(
                    f"byte {end[beyond[0]]}: field beyond its message", EXPECTED
                )
            more = at < end
            rows, at, end = rows[more], at[more], end[more]
        return found

    def _column(
        self,
        rows: np.ndarray,
        at: np.ndarray,
        kinds: Mapping[int, str],
        found: dict[int, np.ndarray],
    ) -> np.ndarray:
        """Store the next field of each row; returns the offsets behind it."""
        tags, at = self._varints(at)
        wires, numbers = tags & 7, tags >> 3
        after = np.full_like(at, -1)
        for kind, wire in KINDS.items():
            here = np.flatnonzero(wires == wire)
            if not here.size:
                continue
            values, after[here] = self._values(wire, at[here])
            for number in (n for n in kinds if kinds[n] == kind):
                match = numbers[here] == number
                found[number][rows[here[match]]] = values[match]
        bad = np.flatnonzero((after < 0) | (numbers == 0))
        if bad.size:
            raise self.error(f"byte {at[bad[0]]}: tag {tags[bad[0]]}", EXPECTED)
        return after

    def _values(self, wire: int, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(values, offsets behind them) of one wire type at offsets."""
        if wire == VARINT:
            return self._varints(at)
        if wire == BYTES:
            sizes, at = self._varints(at)
            far = len(self.data) + PADDING
            after = at + np.where((sizes < 0) | (sizes > far), far, sizes)
            return np.stack([at, after], axis=1), after
        values = self.view("<f8" if wire == FIXED64 else "<f4")[at]
        with np.errstate(invalid="ignore"):  # a signalling NaN is somebody's error
            return values.astype(np.float64), at + SIZES[wire]

    def _varints(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(values [n] int64, offsets behind them) of varints at offsets."""
        byte = self._padded[at]
        value, after = (byte & 0x7F).astype(np.int64), at + 1
        going = np.flatnonzero(byte >= 0x80)
        for place in range(1, MAX_VARINT):
            if not going.size:
                return value, after
            # behind the data lie zeros, which end every varint
            byte = self._padded[after[going]]
            value[going] |= (byte & 0x7F).astype(np.int64) << np.int64(7 * place)
            after[going] += 1
            going = going[byte >= 0x80]
        if going.size:
            raise self.error(f"byte {at[going[0]]}: varint without end", EXPECTED)
        return value, after


def _empty(kind: str, count: int) -> np.ndarray:
    if kind == "message":
        return np.zeros((count, 2), np.int64)
    return np.zeros(count, np.int64 if kind == "int" else np.float64)
