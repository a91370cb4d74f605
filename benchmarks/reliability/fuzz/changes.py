"""Bytes, texts and trees of dicts, lists and scalars, changed at random."""

import contextlib
import math
import random
from typing import Any

NUMBERS = (
    *(0, 1, -1, 2, 7, 255, 256, 65535, 2**31 - 1, 2**31, 2**32, 2**53, 2**63 - 1),
    *(2**63, 2**64, -(2**31), -(2**63), 10**30, 10**400),
    *(0.0, -0.0, 0.5, -1.5, 1e-320, 1e-30, 1e7, 1e9, 1e18, 1e30, 1e38, 1e300, -1e300),
    *(math.nan, math.inf, -math.inf),
)
TEXTS = (
    *("", " ", "a", "0", "-1", "1e999", "nan", "inf", "true", "null", "NULL", "1_000"),
    *("../../../etc/passwd", "/etc/passwd", "..", ".", "a/b", "C:\\x", "~", "file:///"),
    *("a\0b", "\x1b[31mred", "two\nlines", "\u2028", "\ud800", "\u00e9\u4e2d", "'\"`;"),
    *("a/" * 3000, "a." * 3000 + "a", "1,5", '"', "0x10", "١٢", "\ufeff", "-"),
    *("$(touch x)", "%s%n", "{0.__class__}", "__class__", "x" * 5000, "9" * 5000),
)
BYTES = (
    *(b"", b"\0", b"\xff" * 8, b"\x7f\xff\xff\xff", b"\x80\0\0\0", b"\xff\xff\xff\xff"),
    *(b"\0" * 16, b"NaN", b"inf", b"1e308", b"-", b"..", b"/", b"\n", b'"', b"<", b"["),
    *(b"{", b"\0\0\0\0\0\0\xf8\x7f", b"\0\0\0\0\0\0\xf0\x7f", b"\0\0\xc0\x7f"),
    *(b"\xff" * 9 + b"\x01", b"\x80" * 10, b"GP", b"SQLite format 3\0"),
)
OTHERS = (None, True, False, [], {}, [[]], {"": {}}, [None])
COPIES = 20  # most of one piece, in its place
GROWN = 2000  # nodes more, after which a tree is changed no further
MAX_DEEP = 900  # levels put around a value; writers of more recurse too deeply


def odd(rng: random.Random) -> Any:  # noqa: ANN401 - that is the point
    """A number, a text or an empty container that few readers expect."""
    return rng.choice(rng.choice((NUMBERS, NUMBERS, TEXTS, OTHERS)))


def copies(rng: random.Random) -> int:
    """How often a piece is put in once more."""
    return rng.choice((1, 1, 2, COPIES))


def edited(data: Any, rng: random.Random) -> Any:  # noqa: ANN401 - a text or bytes
    """A piece inserted, removed, doubled, replaced, or all from there cut off."""
    is_text = isinstance(data, str)
    word = rng.choice(TEXTS if is_text else BYTES)
    other = chr(rng.randrange(1, 768)) if is_text else bytes([rng.randrange(256)])
    at = rng.randrange(len(data) + 1)
    end = at + rng.choice((1, 2, 8, 100))
    head, tail = data[:at], data[at:]
    made = [head + word + tail, head + data[end:], data[:end] + tail, word]
    made += [head + word + data[at + len(word) :]]
    made += [head + other + tail[1:]] * 3 + [head] * (rng.random() < 0.2)
    return rng.choice(made)


def changed_bytes(data: bytes, rng: random.Random) -> bytes:
    """Bytes changed at one to four places."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        data = edited(data, rng)
    return data


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
    if isinstance(value, str) and rng.random() < 0.5:
        with contextlib.suppress(ValueError):
            return str(near(float(value), rng))
    return edited(value, rng) if isinstance(value, str | bytes) else odd(rng)


def _places(tree: Any) -> list[tuple[Any, Any]]:  # noqa: ANN401
    """(container, key) of every node below the root."""
    found, left = [], [tree]
    while left:
        node = left.pop()
        for key in node if isinstance(node, dict) else range(len(node)):
            found.append((node, key))
            if isinstance(node[key], dict | list):
                left.append(node[key])
    return found


def _deep(value: Any, rng: random.Random) -> Any:  # noqa: ANN401
    """The value inside of many lists or maps."""
    is_list = rng.random() < 0.5
    for _ in range(rng.choice((1, 10, 70, 400, MAX_DEEP))):
        value = [value] if is_list else {"a": value}
    return value


def _change(node: Any, key: Any, rng: random.Random) -> None:  # noqa: ANN401
    """One node made another, removed, doubled or renamed; few are put deep inside."""
    kind, is_list = rng.randrange(40), isinstance(node, list)
    if kind == 0:
        node[key] = _deep(node[key], rng)
    elif kind < 17:
        node[key] = near(node[key], rng)
    elif kind < 27:
        node[key] = odd(rng)
    elif kind < 31:
        del node[key]
    elif kind < 36 and is_list:
        node[key:key] = [node[key]] * copies(rng)
    elif is_list:
        other = rng.randrange(len(node))
        node[key], node[other] = node[other], node[key]
    else:
        old = node[key] if kind < 36 else node.pop(key)
        node[edited(str(key), rng)] = old


def changed_tree(tree: Any, rng: random.Random) -> Any:  # noqa: ANN401
    """The tree changed in place at one to four nodes; its root may be another.

    Copies of copies of copies would be gigabytes: a tree that has grown is left.
    """
    most = None
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        places = _places(tree) if isinstance(tree, dict | list) else []
        if not places:
            return odd(rng)
        most = most or 2 * len(places) + GROWN
        if len(places) > most:
            break
        _change(*rng.choice(places), rng)
    return tree
