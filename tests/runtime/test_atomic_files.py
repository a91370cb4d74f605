"""Files that are there whole or not at all, also with two writers."""

import os
import stat
import subprocess
import sys

import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import (
    MAX_DEPTH,
    MAX_JSON_BYTES,
    parse_json,
    read_json,
    write_whole,
)
from tests.conftest import REPO

WRITER = """
import sys
from pathlib import Path
from rcirl_jax.runtime.atomic_files import write_whole
text = sys.argv[2] * int(sys.argv[3])
print("ready", flush=True)
sys.stdin.readline()  # both at once
for _ in range(300):
    write_whole(Path(sys.argv[1]), text)
"""


@pytest.mark.multiprocess
def test_two_writers_of_one_file_leave_one_whole(tmp_path):
    """Each would publish the other's half file if both wrote into one part."""
    path, sizes = tmp_path / "a.json", {"a": 200_000, "b": 300_000}
    writers = [
        subprocess.Popen(
            [sys.executable, "-c", WRITER, str(path), letter, str(size)], cwd=REPO,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )
        for letter, size in sizes.items()
    ]  # fmt: skip
    for writer in writers:
        assert writer.stdout.readline() == "ready\n"
    for writer in writers:
        writer.stdin.write("go\n")
        writer.stdin.close()
    seen = set()
    while any(writer.poll() is None for writer in writers):
        text = path.read_text() if path.exists() else ""
        if text:
            assert set(text) == {text[0]}
            assert len(text) == sizes[text[0]]
            seen.add(text[0])
    assert [writer.returncode for writer in writers] == [0, 0]
    for writer in writers:
        writer.stdout.close()
    assert seen
    assert [x.name for x in tmp_path.iterdir()] == ["a.json"]


def test_what_a_kill_left_is_written_over(tmp_path):
    (tmp_path / "a.json.tmp").write_text("half of another, and longer")
    write_whole(tmp_path / "a.json", "whole")
    assert (tmp_path / "a.json").read_text() == "whole"
    assert [x.name for x in tmp_path.iterdir()] == ["a.json"]


def test_an_interrupted_write_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path, seen = tmp_path / "a.json", []
    write_whole(path, "old")

    def fail(source, target):
        seen.append((source.parent, target, source.read_text()))
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", fail)
        with pytest.raises(OSError, match=r"No space left on device: .*a\.json"):
            write_whole(path, "new")
    # the whole file was there, in the same folder, before it took the name
    assert seen == [(tmp_path, path, "new")]
    assert [item.name for item in tmp_path.iterdir()] == ["a.json"]
    assert path.read_text() == "old"


def test_file_and_folder_are_on_disk_before_a_write_returns(tmp_path, monkeypatch):
    synced, real = [], os.fsync

    def record(descriptor):
        synced.append(stat.S_ISDIR(os.fstat(descriptor).st_mode))
        real(descriptor)

    monkeypatch.setattr(os, "fsync", record)
    write_whole(tmp_path / "a.json", "text")
    assert synced == [False, True]
    mask = os.umask(0o022)
    os.umask(mask)
    assert (tmp_path / "a.json").stat().st_mode & 0o077 == 0o066 & ~mask


@pytest.mark.parametrize(
    "text",
    ["{", b"\xff\xfe", "[" * (MAX_DEPTH + 1) + "]" * (MAX_DEPTH + 1), "1" * 5000,
     '{"\\ud800": 1}', "[NaN]", '{"a": 1e999}'],
)  # fmt: skip
def test_json_that_is_none_is_one_line(tmp_path, text):
    with pytest.raises(ValueError, match=r"."):
        parse_json(text)
    content = text.encode("utf-8", "surrogatepass") if isinstance(text, str) else text
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.json: .*: expected colours"):
        read_json(tmp_path / "a.json", "colours")
    for path in (tmp_path / "none.json", tmp_path):
        with pytest.raises(InputError, match=f"{path.name}: .*: expected colours"):
            read_json(path, "colours")


def test_json_of_any_size_takes_little_memory(tmp_path):
    path = tmp_path / "a.json"
    with path.open("wb") as file:
        file.truncate(2**40)  # a terabyte of nothing
    with pytest.raises(InputError, match="size: above 16 MiB: expected colours"):
        read_json(path, "colours")
    path.write_bytes(b" " * (MAX_JSON_BYTES - 2) + b"{}")
    assert read_json(path, "colours") == {}
    path.write_text("[" * MAX_DEPTH + "]" * MAX_DEPTH)
    assert isinstance(read_json(path, "colours"), list)
