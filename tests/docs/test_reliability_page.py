"""docs/reliability.md: what its rows name is there, and how a row is run."""

import re
import sys

import pytest

from benchmarks.reliability.table import rows_of, words
from tests.docs.pages import DOCS, REPO

ROWS = rows_of((DOCS / "reliability.md").read_text())
KEYWORD = re.compile(r"\b(?!and\b|or\b|not\b)\w+")


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.fault[:40])
def test_what_a_row_runs_is_there(row):
    command = words(row.command)
    if command[0] == "make":
        assert re.search(rf"^{command[1]}:", (REPO / "Makefile").read_text(), re.M)
        return
    assert command[:2] == [sys.executable, "-m"]
    if command[2] != "pytest":
        path = REPO / command[2].replace(".", "/")
        assert path.with_suffix(".py").is_file()
        return
    files = [word for word in command if word.endswith(".py")]
    text = "".join((REPO / name).read_text() for name in files)
    names = " ".join(re.findall(r"def (test_\w+)", text))
    assert names
    chosen = command[command.index("-k") + 1] if "-k" in command else ""
    for word in KEYWORD.findall(chosen):
        assert word in names or f'"{word}"' in text, word
