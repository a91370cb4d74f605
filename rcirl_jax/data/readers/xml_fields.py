"""Numbers out of XML elements, with errors that name file and field."""

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from rcirl_jax.errors import InputError


class Fields:
    """Reads numbers out of elements; errors name file, element and field."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def child(self, parent: Element, tag: str, where: str) -> Element:
        """A child element that has to be there."""
        found = parent.find(tag)
        if found is None:
            raise InputError(f"{self.path}: {where}: {tag}: missing: expected it")
        return found

    def number(self, element: Element, where: str) -> float:
        """A finite number from an element's text."""
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
        """<tag><exact> or the middle of <tag><intervalStart>/<intervalEnd>."""
        node = self.child(parent, tag, where)
        exact = node.find("exact")
        if exact is not None:
            return self.number(exact, f"{where}: {tag}")
        low = self.child(node, "intervalStart", f"{where}: {tag}")
        high = self.child(node, "intervalEnd", f"{where}: {tag}")
        return 0.5 * (self.number(low, where) + self.number(high, where))

    def point(self, parent: Element, where: str) -> tuple[float, float]:
        """<x>, <y> of a point-like element."""
        x = self.number(self.child(parent, "x", where), where)
        return x, self.number(self.child(parent, "y", where), where)
