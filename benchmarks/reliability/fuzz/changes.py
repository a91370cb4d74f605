"""Bytes, texts and trees of dicts, lists and scalars, changed at random."""

import contextlib
import math
import random
import re
from typing import Any

NUMBERS = (
    *(0, 1, -1, 2, 255, 65535, 2**31 - 1, 2**31, 2**53, 2**63 - 1, 2**63, 2**64),
    *(-(2**63), 10**30, 10**400, 0.0, 0.5, -1.5, 1e-320, 1e-30, 1e9, 1e18, 1e38),
    *(1e300, -1e300, math.nan, math.inf, -math.inf),
)
TEXTS = (
    *("", " ", "a", "0", "-1", "1e999", "nan", "inf", "true", "null", "1_000", "-"),
    *("../../../etc/passwd", "/etc/passwd", "..", "a/b", "C:\\x", "~", "file:///"),
    *("a\0b", "\x1b[31mred", "two\nlines", "\u2028", "\ud800", "\u00e9\u4e2d", "'\"`;"),
    *("a/" * 3000, "a." * 3000 + "a", "1,5", '"', "0x10", "١٢", "\ufeff", "%s%n"),
    *("$(touch x)", "{0.__class__}", "x" * 5000, "9" * 5000, "[" * 400, "<a>" * 400),
)
BYTES = (
    *(b"", b"\0", b"\xff" * 8, b"\x7f\xff\xff\xff", b"\x80\0\0\0", b"\0" * 16, b"NaN"),
    *(b"\0\0\0\0\0\0\xf8\x7f", b"\0\0\0\0\0\0\xf0\x7f", b"\0\0\xc0\x7f", b"\n", b"["),
    *(b"\xff" * 9 + b"\x01", b"\x80" * 10, b"GP", b"SQLite format 3\0"),
)
OTHERS = (None, True, False, [], {}, [[]], {"": {}}, [None])
TOKEN = re.compile(r"[\w.+-]+|\s+|.", re.S)  # numbers, names, marks
GROWN = 2000  # nodes more, after which a tree is changed no further
most_copies = [20]  # of one piece, in its place


def odd(rng: random.Random) -> Any:  # noqa: ANN401 - that is the point
    """A number, a text or an empty container that few readers expect."""
    return rng.choice(rng.choice((NUMBERS, NUMBERS, TEXTS, OTHERS)))


def copies(rng: random.Random) -> int:
    """How often a piece is put in once more."""
    return rng.choice((1, 1, 2, most_copies[0]))


def times(rng: random.Random) -> range:
    """One to four changes, mostly one."""
    return range(rng.choice((1, 1, 1, 2, 4)))


def changed_bytes(data: bytes, rng: random.Random) -> bytes:
    """Bytes inserted, removed, doubled, replaced, or all from there cut off."""
    for _ in times(rng):
        at = rng.randrange(len(data) + 1)
        head, tail, end = data[:at], data[at:], at + rng.choice((1, 2, 8, 100))
        word, other = rng.choice(BYTES), bytes([rng.randrange(256)])
        made = [head + word + tail, head + data[end:], data[:end] + tail]
        made += [head + word + data[at + len(word) :], head]
        data = rng.choice([*made, *[head + other + tail[1:]] * 3])
    return data


def changed_text(text: str, rng: random.Random) -> str:
    """Numbers, names and marks of a text made others, removed or doubled."""
    tokens = TOKEN.findall(text) or [""]
    for _ in times(rng):
        at, kind = rng.randrange(len(tokens)), rng.randrange(8)
        end = at + rng.choice((1, 1, 2, 8, 100))
        if kind < 4:
            tokens[at] = near(tokens[at], rng)
        elif kind < 6:
            tokens[at] = str(rng.choice(rng.choice((TEXTS, NUMBERS[:-4]))))
        elif kind == 6:
            del tokens[at:end]
        else:
            tokens[at:at] = tokens[at:end] * copies(rng)
        tokens = tokens or [""]
    return "".join(tokens)


def near(value: Any, rng: random.Random) -> Any:  # noqa: ANN401
    """A value of the same type, or nearly, as the one that is there."""
    if isinstance(value, bool) or value is None:
        return rng.choice((True, False, None, 0, 1))
    if isinstance(value, int | float):
        factor = rng.choice((-1, 0, 2, 10, 1000, 0.1, 1e-3, 1e12))
        return rng.choice((value + 1, value - 1, value * factor, float(value)))
    if isinstance(value, str):
        with contextlib.suppress(ValueError, OverflowError):
            return str(near(float(value), rng))
        at, word = rng.randrange(len(value) + 1), chr(rng.randrange(1, 768))
        return value[:at] + word + value[at + rng.randrange(2) :]
    return changed_bytes(value, rng) if isinstance(value, bytes) else odd(rng)


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


def _change(node: Any, key: Any, rng: random.Random) -> None:  # noqa: ANN401
    """One node made another, removed, doubled or renamed; few are put deep inside."""
    kind = rng.randrange(40)
    if kind < 17:
        node[key] = near(node[key], rng)
    elif kind < 27:
        node[key] = odd(rng)
    elif kind < 31:
        del node[key]
    elif isinstance(node, list):
        node[key:key] = [node[key]] * copies(rng)
    else:
        node[near(str(key), rng)] = node[key] if kind < 36 else node.pop(key)


def changed_tree(tree: Any, rng: random.Random) -> Any:  # noqa: ANN401
    """The tree changed in place at one to four nodes; its root may be another.

    Copies of copies of copies would be gigabytes: a tree that has grown is left.
    """
    most = None
    for _ in times(rng):
        places = _places(tree) if isinstance(tree, dict | list) else []
        if not places:
            return odd(rng)
        most = most or 2 * len(places) + GROWN
        if len(places) <= most:
            _change(*rng.choice(places), rng)
    return tree
