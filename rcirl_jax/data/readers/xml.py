"""XML from untrusted files: no entities, no DTD, bounded size.

A `Node` is an element that knows its place, so that what it lacks is one clear line.
"""

import math
from pathlib import Path
from typing import cast
from xml.etree.ElementTree import Element, ParseError

from rcirl_jax.data.readers.tables.streams import refuse_pointer
from rcirl_jax.errors import InputError


def read_xml(path: Path, tag: str, max_bytes: int) -> Element:
    """Reads the root element, which has to be called `tag`.

    Raises:
      InputError: too large a file, a DTD, entities or external references, XML
        that is not well formed, or another root.
    """
    from defusedxml import DefusedXmlException
    from defusedxml import ElementTree as Safe

    refuse_pointer(path)
    size = path.stat().st_size
    if size > max_bytes:
        raise InputError(f"{path}: size: {size} bytes: expected at most {max_bytes}")
    try:
        root = cast(Element, Safe.parse(path, forbid_dtd=True).getroot())
    except DefusedXmlException as error:
        kind = type(error).__name__
        raise InputError(
            f"{path}: xml: {kind}: expected no DTD, entities or external references"
        ) from error
    except (ParseError, ValueError, LookupError) as error:
        raise InputError(f"{path}: xml: {error}: expected well-formed XML") from error
    if root.tag != tag:
        raise InputError(f"{path}: root: {root.tag[:40]!r}: expected {tag}")
    return root


class Node:
    """An element and its place, which is first in errors."""

    def __init__(self, element: Element, where: str) -> None:
        self.element, self.where = element, where

    def error(self, field: str, found: object, expected: str) -> InputError:
        """Makes the line for something wrong in this element."""
        return InputError(f"{self.where}: {field}: {found}: expected {expected}")

    def child(self, tag: str) -> "Node":
        """Returns a child element that has to be there."""
        found = self.element.find(tag)
        if found is None:
            raise self.error(tag, "missing", "it")
        return Node(found, f"{self.where}: {tag}")

    def each(self, path: str) -> list["Node"]:
        """Returns all elements at a path of tags, each with its id in its place."""
        return [
            Node(one, f"{self.where}: {one.tag} {one.get('id', '(no id)')}")
            for one in self.element.iterfind(path)
        ]

    def text(self, tag: str) -> str:
        """Returns the text of a child; "" without one."""
        return (self.element.findtext(tag) or "").strip()

    def number(self, tag: str, default: float | None = None) -> float:
        """Reads a finite number from the text of a child.

        Args:
          tag: of the child.
          default: where there is none; None: it has to be there.
        """
        found = self.element.find(tag)
        if found is None and default is not None:
            return default
        text = "missing" if found is None else found.text or ""
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.error(tag, f"'{text.strip()[:40]}'", "a finite number")
        return value

    def scalar(self, tag: str) -> float:
        """Reads <tag><exact> or the middle of <tag><intervalStart>/<intervalEnd>."""
        node = self.child(tag)
        if node.element.find("exact") is not None:
            return node.number("exact")
        return 0.5 * (node.number("intervalStart") + node.number("intervalEnd"))

    def point(self) -> tuple[float, float]:
        """Reads <x>, <y>."""
        return self.number("x"), self.number("y")
