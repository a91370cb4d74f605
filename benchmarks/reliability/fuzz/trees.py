"""Mutations of bytes and of trees of dicts, lists and scalars."""

import random
from collections.abc import Callable
from typing import Any

NUMBERS = (
    *(0, 1, -1, 2, 7, 255, 256, 65535, 2**31 - 1, 2**31, 2**32, 2**53, 2**63 - 1),
    *(2**63, 2**64, -(2**31), -(2**63), 10**30, 10**400),
    *(0.0, -0.0, 0.5, -1.5, 1e-320, 1e-30, 1e7, 1e9, 1e18, 1e30, 1e38, 1e300, -1e300),
    *(float("nan"), float("inf"), float("-inf")),
)
TEXTS = (
    *("", " ", "a", "0", "-1", "1e999", "nan", "inf", "true", "null", "NULL"),
    *("../../../etc/passwd", "/etc/passwd", "..", ".", "a/b", "C:\\x", "~", "file:///"),
    *("a\0b", "\x1b[31mred", "two\nlines", "\u2028", "\ud800", "\u00e9\u4e2d", "'\"`;"),
    *("a/" * 3000, "a." * 3000 + "a"),
    *("$(touch x)", "%s%n", "{0.__class__}", "__class__", "x" * 5000, "9" * 5000),
)
BYTES = (
    *(b"", b"\0", b"\xff" * 8, b"\x7f\xff\xff\xff", b"\x80\0\0\0", b"\xff\xff\xff\xff"),
    *(b"\0" * 16, b"NaN", b"inf", b"1e308", b"-", b"..", b"/", b"\n", b'"', b"<", b"["),
    *(b"{", b"\0\0\0\0\0\0\xf8\x7f", b"\0\0\0\0\0\0\xf0\x7f", b"\0\0\xc0\x7f"),
    *(b"\xff" * 9 + b"\x01", b"\x80" * 10, b"GP", b"SQLite format 3\0"),
)
COPIES = 20  # most of one piece, in its place
GROWN = 2000  # nodes more, after which a tree is changed no further
MAX_DEEP = 900  # levels put around a value; writers of more recurse too deeply


def odd_scalar(rng: random.Random) -> Any:  # noqa: ANN401 - that is the point
    """A number, a text, bytes or an empty container that few readers expect."""
    kind = rng.randrange(8)
    if kind < 4:
        return rng.choice(NUMBERS)
    if kind < 6:
        return rng.choice(TEXTS)
    return rng.choice((None, True, False, [], {}, [[]], {"": {}}, [None]))


def copies(rng: random.Random) -> int:
    """How often a piece is put in once more."""
    return rng.choice((1, 1, 2, COPIES))


def near(value: Any, rng: random.Random) -> Any:  # noqa: ANN401
    """A value of the same type, or nearly, as the one that is there."""
    if isinstance(value, bool) or value is None:
        return rng.choice((True, False, None, 0, 1))
    if isinstance(value, int):
        step = rng.choice((1, -1, 2, 10, -10, 1000, 2**16))
        return rng.choice((value + step, -value, value * 2, float(value)))
    if isinstance(value, float):
        factor = rng.choice((-1.0, 0.0, 0.1, 10.0, 1e3, 1e-3, 1e12))
        return rng.choice((value * factor, value + 1.0, -value))
    if isinstance(value, str):
        return mutate_text(value, rng)
    if isinstance(value, bytes):
        return mutate_bytes(value, rng)
    return odd_scalar(rng)


def mutate_text(text: str, rng: random.Random) -> str:
    """A text with something inserted, removed, doubled or replaced."""
    at = rng.randrange(len(text) + 1)
    end = min(len(text), at + rng.randrange(1, 9))
    kind = rng.randrange(5)
    if kind == 0:
        return text[:at] + rng.choice(TEXTS) + text[at:]
    if kind == 1:
        return text[:at] + text[end:]
    if kind == 2:
        return text[:end] + text[at:]
    if kind == 3:
        return text[:at] + chr(rng.randrange(1, 0x300)) + text[at + 1 :]
    return rng.choice(TEXTS)


def mutate_bytes(data: bytes, rng: random.Random) -> bytes:
    """Bytes with flips, odd values, pieces removed, doubled or cut off."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        at = rng.randrange(len(out) + 1)
        kind = rng.randrange(7)
        if kind == 0 and at < len(out):
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 1 and at < len(out):
            out[at] = rng.randrange(256)
        elif kind == 2:
            word = rng.choice(BYTES)
            out[at : at + len(word)] = word
        elif kind == 3:
            out[at:at] = rng.choice(BYTES)
        elif kind == 4:
            del out[at : at + rng.choice((1, 2, 8, 100))]
        elif kind == 5:
            out[at:at] = out[at : at + rng.choice((1, 8, 100))]
        elif rng.random() < 0.2:
            del out[at:]
    return bytes(out)


def _places(tree: Any) -> list[tuple[Any, Any]]:  # noqa: ANN401
    """(container, key) of every node below the root."""
    found, left = [], [tree]
    while left:
        node = left.pop()
        keys = node if isinstance(node, dict) else range(len(node))
        for key in keys:
            found.append((node, key))
            if isinstance(node[key], dict | list):
                left.append(node[key])
    return found


def deep(value: Any, rng: random.Random) -> Any:  # noqa: ANN401
    """The value inside of many lists or maps."""
    key = rng.choice((None, "a"))
    for _ in range(rng.choice((1, 10, 70, 400, MAX_DEEP))):
        value = [value] if key is None else {key: value}
    return value


def _remove(rng: random.Random, node: Any, key: Any) -> None:  # noqa: ANN401
    del node[key]


def _double(rng: random.Random, node: Any, key: Any) -> None:  # noqa: ANN401
    if isinstance(node, list):
        node[key:key] = [node[key]] * copies(rng)
    else:
        node[rng.choice(TEXTS)] = node[key]


def _rename(rng: random.Random, node: Any, key: Any) -> None:  # noqa: ANN401
    if isinstance(node, dict):
        node[mutate_text(str(key), rng)] = node.pop(key)
    else:
        node.reverse()


def _set(how: Callable) -> Callable:
    def change(rng: random.Random, node: Any, key: Any) -> None:  # noqa: ANN401
        node[key] = how(node[key], rng)

    return change


CHANGES = (
    *(_set(near), _set(near), _set(near), _set(lambda _, rng: odd_scalar(rng))),
    *(_set(lambda _, rng: odd_scalar(rng)), _remove, _double, _rename),
)


def mutate_tree(tree: Any, rng: random.Random) -> Any:  # noqa: ANN401
    """The tree changed in place at one to four nodes; its root may be another.

    Copies of copies of copies would be gigabytes: a tree that has grown is left.
    """
    most = None
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        places = _places(tree) if isinstance(tree, dict | list) else []
        if not places:
            return odd_scalar(rng)
        most = most or 2 * len(places) + GROWN
        if len(places) > most:
            break
        node, key = rng.choice(places)
        if rng.random() < 0.02:
            node[key] = deep(node[key], rng)
        elif rng.random() < 0.1:
            other, at = rng.choice(places)
            node[key] = odd_scalar(rng) if at not in _keys(other) else _leaf(other[at])
        else:
            rng.choice(CHANGES)(rng, node, key)
    return tree


def _keys(node: Any) -> Any:  # noqa: ANN401
    return node if isinstance(node, dict) else range(len(node))


def _leaf(value: Any) -> Any:  # noqa: ANN401
    """A copy one level deep: a tree must not come to hold itself."""
    if isinstance(value, dict | list):
        return type(value)()
    return value
