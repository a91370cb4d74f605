"""Files that are there whole or not at all, also with two writers."""

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


def test_an_old_file_stays_if_the_new_one_cannot_be(tmp_path):
    (tmp_path / "a.json").mkdir()
    with pytest.raises(OSError, match=r"a\.json"):
        write_whole(tmp_path / "a.json", "text")
    assert [x.name for x in tmp_path.iterdir()] == ["a.json"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"{", "a.json: Expecting .*: expected colours"),
        (b"\xff\xfe", "a.json: .*utf-8.*: expected colours"),
        (b"[" * 100_000, "a.json: nested too deep: expected colours"),
        (b"[" * (MAX_DEPTH + 1) + b"]" * (MAX_DEPTH + 1), "nested too deep"),
        (b"1" * 5000, "a.json: .*digits.*: expected colours"),
        (b'{"\\ud800": 1}', "a.json: .*surrogates.*: expected colours"),
        (b'["a\\uDC00"]', "a.json: .*surrogates.*: expected colours"),
    ],
)
def test_json_that_is_none_is_one_line(tmp_path, content, message):
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_json(tmp_path / "a.json", "colours")


@pytest.mark.parametrize(
    "text",
    [
        *(
            '"\ud800"',
            '"\udfff"',
            b'"\xed\xa0\x80"',
            '{"\\uDEAD": 1}',
            '["\\ud83d \\ude97"]',
        ),
        *("{", b"\xff", "[" * 10**5, "1" * 5000),
    ],
)
def test_json_from_outside_is_a_body_or_a_value_error(text):
    with pytest.raises(ValueError, match=r"."):
        parse_json(text)


def test_finite_json_has_no_other_numbers():
    assert parse_json("[1e9, -2, 0.5]", finite=True) == [1e9, -2, 0.5]
    for text in ("[NaN]", "-Infinity", '{"a": 1e999}'):
        assert parse_json(text) is not None
        with pytest.raises(ValueError, match="number"):
            parse_json(text, finite=True)


def test_json_with_whole_pairs_is_text(tmp_path):
    (tmp_path / "a.json").write_bytes(b'"\\ud83d\\ude97"')
    assert read_json(tmp_path / "a.json", "a car") == "\U0001f697"
    (tmp_path / "a.json").write_bytes(b'\xef\xbb\xbf["as some editors write it"]')
    assert read_json(tmp_path / "a.json", "a text") == ["as some editors write it"]


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


def test_json_that_is_not_there_is_one_line(tmp_path):
    for path in (tmp_path / "none.json", tmp_path):
        with pytest.raises(InputError, match=f"{path.name}: .*: expected colours"):
            read_json(path, "colours")
