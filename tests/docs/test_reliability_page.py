"""docs/reliability.md: every row has a command, and what it names is there."""

import re
import sys

import pytest

from benchmarks.reliability import table
from benchmarks.reliability.table import Row, rows_of, words
from rcirl_jax.errors import InputError
from tests.docs.pages import DOCS, REPO

ROWS = rows_of((DOCS / "reliability.md").read_text())
KEYWORD = re.compile(r"\b(?!and\b|or\b|not\b)\w+")


def test_every_row_of_the_page_is_one():
    text = (DOCS / "reliability.md").read_text()
    lines = [x for x in text.splitlines() if x.startswith("| ") and "`" in x]
    heads = [x for x in text.splitlines() if x.startswith("| fault ")]
    assert len(ROWS) == len(lines) > 30
    assert len(heads) == 7
    assert all(0 < row.minutes <= 120 for row in ROWS)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.fault[:40])
def test_what_a_row_runs_is_there(row):
    command = words(row.command)
    if command[0] == "make":
        makefile = (REPO / "Makefile").read_text()
        assert re.search(rf"^{command[1]}:", makefile, re.M)
        return
    assert command[:2] == [sys.executable, "-m"]
    if command[2] != "pytest":
        path = REPO / command[2].replace(".", "/")
        assert path.with_suffix(".py").is_file() or (path / "__main__.py").is_file()
        return
    files = [word for word in command if word.endswith(".py")]
    assert files
    texts = [(REPO / name).read_text() for name in files]
    names = " ".join(
        name for text in texts for name in re.findall(r"def (test_\w+)", text)
    )
    if "-k" in command:
        chosen = command[command.index("-k") + 1]
        for alternative in chosen.split(" or "):
            for word in KEYWORD.findall(alternative):
                assert word in names or f'"{word}"' in " ".join(texts), word


def test_a_row_without_minutes_is_one_line():
    line = "| SIGKILL | at random | 3 | the same | soon | `make test` |"
    with pytest.raises(InputError, match="SIGKILL: minutes: soon: expected a number"):
        rows_of(line)
    assert rows_of("| a | b |\n" + line.replace("soon", "2"))[0].command == "make test"


@pytest.mark.multiprocess
def test_what_came_of_a_row(monkeypatch, tmp_path):
    good = table.ran(Row(fault="a", minutes=1, command='python -c "print(3)"'))
    assert (good["status"], good["said"]) == (0, "3")
    bad = table.ran(Row(fault="b", minutes=1, command='python -c "assert 0"'))
    assert bad["status"] == 1
    assert bad["said"].startswith("AssertionError")
