"""XML from files that nobody vouches for: no entities, no DTD, bounded size."""

from pathlib import Path
from xml.etree.ElementTree import Element, ParseError

from rcirl_jax.errors import InputError


def read_xml(path: Path, tag: str, max_bytes: int) -> Element:
    """The root element, which has to be called `tag`.

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
