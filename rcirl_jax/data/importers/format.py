"""What a format says of itself, in its folder, before its reader is loaded.

Cheap to import: which options its source TOML may have is known without its reader.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any


@dataclasses.dataclass(frozen=True, kw_only=True)
class Format:
    """A log format."""

    # options besides those of its packaged TOML, each with a value of its type; an
    # option that is a table has a value for each of its own
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    # tables in which any name may stand, or whose reader knows which may
    free: tuple[str, ...] = ()
    # options of several types, which the reader checks
    checked: tuple[str, ...] = ("pattern",)
