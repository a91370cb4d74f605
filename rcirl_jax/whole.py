"""Files that are there whole or not at all."""

import json
import os
from collections.abc import Mapping
from pathlib import Path


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file; who reads it sees the old one or the new one.

    Its folder is made. What a kill leaves behind ends in ".tmp".
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".tmp")
    part.write_bytes(content.encode() if isinstance(content, str) else content)
    os.replace(part, path)


def write_json(path: Path, body: Mapping[str, object]) -> None:
    """The body as JSON of finite numbers, whole."""
    write_whole(path, json.dumps(body, indent=2, allow_nan=False) + "\n")
