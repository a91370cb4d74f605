"""What is done to sound files: cut, garbled, emptied, numbers that are none."""

import os
import pickle
import re

import numpy as np


class Bomb:
    """Unpickling it creates a file."""

    def __init__(self, target):
        self.target = str(target)

    def __reduce__(self):
        return os.mkdir, (self.target,)


def text_of(path):
    """Content of a text file; None: it is none."""
    try:
        text = path.read_bytes().decode()
    except UnicodeDecodeError:
        return None
    return None if "\0" in text else text


def truncate(share):
    """Cut at a share of the file: of text, in the middle of the line there."""

    def apply(path, fixture, target):
        content = path.read_bytes()
        cut = int(share * len(content))
        if text_of(path) is not None:
            begin, end = content.rfind(b"\n", 0, cut) + 1, content.find(b"\n", cut)
            cut = (begin + (end if end >= 0 else len(content))) // 2
        path.write_bytes(content[:cut])
        return True

    return apply


def drop_lines(path, fixture, target):
    """Cut text between two lines, at nine tenths."""
    text = text_of(path)
    if text is None:
        return False
    path.write_text(text[: text.rfind("\n", 0, int(0.9 * len(text))) + 1])
    return True


def garble(path, fixture, target):
    size = max(min(path.stat().st_size, 20000), 64)
    path.write_bytes(np.random.default_rng(7).bytes(size))
    return True


def empty(path, fixture, target):
    path.write_bytes(b"")
    return True


def remove(path, fixture, target):
    path.unlink()
    return True


def plant_pickle(path, fixture, target):
    path.write_bytes(pickle.dumps(Bomb(target)) * 3)
    return True


def write_number(value):
    """Write something else for a number in the middle of a text file."""

    def apply(path, fixture, target):
        if path not in fixture.numbers:
            return False
        text = path.read_text()
        found = list(re.finditer(fixture.numbers[path], text, re.MULTILINE))
        start, end = found[len(found) // 2].span(1)
        path.write_text(text[:start] + value + text[end:])
        return True

    return apply


# damage -> (what is done, if it can be; whether a valid result is allowed too)
DAMAGES = {
    "truncated at 30 %": (truncate(0.3), lambda fixture: False),
    "truncated at 90 %": (truncate(0.9), lambda fixture: False),
    "truncated between lines": (drop_lines, lambda fixture: not fixture.is_counted),
    "emptied": (empty, lambda fixture: False),
    "random bytes": (garble, lambda fixture: False),
    "a pickle": (plant_pickle, lambda fixture: False),
    "removed": (remove, lambda fixture: True),
    "a word for a number": (write_number('"west"'), lambda fixture: fixture.drops_rows),
    "an absurd number": (write_number("1e30"), lambda fixture: fixture.drops_rows),
    "no number": (
        write_number("NaN"),
        lambda fixture: fixture.drops_rows or fixture.has_holes,
    ),
}
