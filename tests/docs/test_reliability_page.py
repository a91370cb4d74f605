"""docs/reliability.md: every row has a command, and what it names is there."""

import json
import re
import sys

import pytest
from absl import flags
from absl.testing import flagsaver

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


def page(*commands):
    """A page of one row a command."""
    return "\n".join(f"| {x} | by hand | 1 | 0 | 1 | `{x}` |" for x in commands)


@pytest.fixture
def rows(monkeypatch, tmp_path):
    """(a function of pages and flags that runs the rows; the rows run by it)."""
    seen, real = [], table.ran
    monkeypatch.setattr(table, "PAGE", tmp_path / "page.md")
    monkeypatch.setattr(table, "ran", lambda row: seen.append(row.fault) or real(row))
    flags.FLAGS(["table"])

    def go(text, **given):
        table.PAGE.write_text(text)
        seen.clear()
        saved = flagsaver.flagsaver(output=str(tmp_path), **given)
        with saved, pytest.raises(SystemExit) as ended:
            table.main()
        result = json.loads((tmp_path / "reliability.json").read_text())
        return ended.value.code, [*seen], result

    return go


@pytest.mark.multiprocess
def test_what_came_out_as_stated_is_not_run_again(rows, monkeypatch):
    status, seen, result = rows(page("true", "false"))
    assert (status, seen) == (1, ["true", "false"])
    assert [row["status"] for row in result["rows"]] == [0, 1]
    status, seen, result = rows(page("true", "false", "make --version"), rows=["a"])
    assert (status, seen) == (1, ["false", "make --version"])
    assert [row["fault"] for row in result["rows"]] == [
        "true",
        "false",
        "make --version",
    ]
    status, seen, result = rows(page("true", "make --version"), anew=True, minutes=0.5)
    assert (status, seen) == (0, [])
    status, seen, result = rows(
        page("true", "make --version"), anew=True, rows=["true"]
    )
    assert (status, seen) == (0, ["true"])
    assert len(result["rows"]) == 2
    monkeypatch.setattr(table, "code_sha256", lambda: "other")
    status, seen, result = rows(page("true", "make --version"), rows=["true"])
    assert seen == ["true"]
    assert result["not_run"] == ["make --version"]


def test_a_result_of_something_else_is_one_line(tmp_path):
    (tmp_path / "reliability.json").write_text("[]")
    with pytest.raises(InputError, match=r"reliability\.json: expected a result of"):
        table.as_stated_before(tmp_path / "reliability.json", "")
