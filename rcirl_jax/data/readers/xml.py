"""XML from untrusted files: no entities, no DTD, bounded size.

Numbers out of its elements come with errors that name file and field.
"""

from pathlib import Path
from xml.etree.ElementTree import Element, ParseError

import numpy as np

from rcirl_jax.data.readers.tables.streams import refuse_pointer
from rcirl_jax.errors import InputError


def read_xml(path: Path, tag: str, max_bytes: int) -> Element:
    """Reads the root element, which has to be called `tag`.

    Args:
      path: of the file.
      tag: of its root.
      max_bytes: larger files are refused.

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
        root = Safe.parse(path, forbid_dtd=True).getroot()
    except DefusedXmlException as error:
        kind = type(error).__name__
        raise InputError(
            f"{path}: xml: {kind}: expected no DTD, entities or external references"
        ) from error
    except (ParseError, ValueError, LookupError) as error:
        raise InputError(f"{path}: xml: {error}: expected well-formed XML") from error
    if root is None or root.tag != tag:
        found = "nothing" if root is None else str(root.tag)[:40]
        raise InputError(f"{path}: root: {found!r}: expected {tag}")
    return root


class Fields:
    """Reads numbers out of elements; errors name file, element and field."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def child(self, parent: Element, tag: str, where: str) -> Element:
        """Returns a child element that has to be there."""
        found = parent.find(tag)
        if found is None:
            raise InputError(f"{self.path}: {where}: {tag}: missing: expected it")
        return found

    def number(self, element: Element, where: str) -> float:
        """Reads a finite number from an element's text."""
        try:
            value = float(element.text or "")
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            found = (element.text or "").strip()[:40]
            raise InputError(
                f"{self.path}: {where}: {element.tag}: '{found}': "
                "expected a finite number"
            )
        return value

    def scalar(self, parent: Element, tag: str, where: str) -> float:
        """Reads <tag><exact> or the middle of <tag><intervalStart>/<intervalEnd>."""
        node = self.child(parent, tag, where)
        exact = node.find("exact")
        if exact is not None:
            return self.number(exact, f"{where}: {tag}")
        low = self.child(node, "intervalStart", f"{where}: {tag}")
        high = self.child(node, "intervalEnd", f"{where}: {tag}")
        return 0.5 * (self.number(low, where) + self.number(high, where))

    def point(self, parent: Element, where: str) -> tuple[float, float]:
        """Reads <x>, <y> of a point-like element."""
        x = self.number(self.child(parent, "x", where), where)
        return x, self.number(self.child(parent, "y", where), where)
