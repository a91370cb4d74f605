"""Which files are one bag: a folder with metadata.yaml, or a file of its own.

Of metadata.yaml only the list of files and the way of packing are read, line by line:
rosbag2 writes one entry a line, and so no YAML library is needed.
"""

import re
from pathlib import Path

from rcirl_jax.data.formats.files import is_input
from rcirl_jax.data.formats.options import patterns
from rcirl_jax.errors import InputError

METADATA = "metadata.yaml"
PATTERNS = ("*.mcap", "*.db3")
MAX_METADATA_BYTES = 64 * 2**20  # bytes; rosbag2 repeats the profiles of each topic
PACKED = (".zstd", ".lz4")  # endings of files that rosbag2 compressed as a whole


def bags_of(path: Path, spec: dict) -> list[Path]:
    """The bags of an input: folders with metadata.yaml, and files outside of them."""
    if path.is_file() or (path / METADATA).is_file():
        return [path]
    wanted = patterns(spec, PATTERNS)
    found = [file for pattern in wanted for file in path.rglob(pattern)]
    found += path.rglob(METADATA)
    files = {file for file in found if is_input(path, file)}
    folders = {file.parent for file in files if file.name == METADATA}
    bags = folders | {file for file in files if file.parent not in folders}
    if not bags:
        raise InputError(
            f"{path}: no file matches {', '.join(wanted)}, nor {METADATA}: "
            "expected ROS 2 bags"
        )
    return sorted(bags)


def files_in(bag: Path) -> list[Path]:
    """The files of a bag, in the order of time.

    Raises:
      InputError: packed by rosbag2, no files, or one that is missing.
    """
    if bag.is_file() or not (bag / METADATA).is_file():
        return [_unpacked(bag)]
    metadata = bag / METADATA
    if metadata.stat().st_size > MAX_METADATA_BYTES:
        raise InputError(
            f"{metadata}: {metadata.stat().st_size} bytes: expected at most "
            f"{MAX_METADATA_BYTES}"
        )
    text = metadata.read_text(errors="replace")
    mode = _value(text, "compression_mode").lower()
    if mode == "message":
        raise InputError(
            f"{metadata}: compression_mode: MESSAGE: expected messages as they were "
            "sent; unpack them with `ros2 bag convert`"
        )
    names = _listed(text)
    if not names:
        raise InputError(
            f"{metadata}: relative_file_paths: none: expected the files of the bag; "
            "write it anew with `ros2 bag reindex`"
        )
    return [_unpacked(_file_of(metadata, name)) for name in names]


def name_of(bag: Path) -> str:
    """Name of a bag: its folder's, or the file's without its ending."""
    return bag.resolve().name if bag.is_dir() else bag.stem


def _value(text: str, key: str) -> str:
    """The value behind a key, "" without one."""
    found = re.search(rf"^ *{key}: *(.*)$", text, re.MULTILINE)
    return found[1].strip().strip("\"'") if found else ""


def _listed(text: str) -> list[str]:
    """Entries of relative_file_paths."""
    lines = iter(text.splitlines())
    names = []
    for line in lines:
        if line.strip() == "relative_file_paths:":
            break
    for line in lines:
        entry = line.strip()
        if not entry.startswith("- "):
            break
        names.append(entry[2:].strip().strip("\"'"))
    return names


def _file_of(metadata: Path, name: str) -> Path:
    # bags of Foxy name their folder as well; no file outside the bag is read
    file = metadata.parent / Path(name).name
    if not file.is_file():
        raise InputError(
            f"{metadata}: relative_file_paths: {name[:200]}: missing: expected this "
            "file in the bag; `ros2 bag reindex` lists those that are there"
        )
    return file


def _unpacked(file: Path) -> Path:
    if file.suffix in PACKED:
        raise InputError(
            f"{file}: compressed as a whole: expected .mcap or .db3; unpack it, for "
            "example with `zstd -d`, and name the files so in metadata.yaml"
        )
    return file
