"""docs/reliability.md: every row has a command, and what it names is there."""

import json
import re
import shlex
import subprocess
import sys

import pytest
from absl import flags
from absl.testing import flagsaver

from benchmarks.reliability import table
from benchmarks.reliability.table import Row, rows_of, summed_up, words
from rcirl_jax.errors import InputError
from tests.docs.pages import DOCS, REPO

ROWS = rows_of((DOCS / "reliability.md").read_text())
RESULTS = REPO / "benchmarks" / "results"
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


def count_of(command):
    """The count cell of the row of a command that begins so."""
    (row,) = [row for row in ROWS if row.command.startswith(command)]
    return row.count


@pytest.mark.parametrize(
    ("command", "file", "count"),
    [
        ("fuzz --inputs", "fuzz", lambda x: sum(row["inputs"] for row in x["rows"])),
        ("fuzz --copies", "fuzz_copies", lambda x: sum(r["inputs"] for r in x["rows"])),
        ("faults", "faults_kill", lambda x: sum(row["count"] for row in x["rows"])),
        ("load --what=suite", "load_suite", lambda x: x["cases"]),
        ("load --what=import", "load_import", lambda x: x["scenes"]),
        ("soak", "soak", lambda x: f"{x['rounds']} rounds"),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_a_count_is_the_results(command, file, count):
    found = count(json.loads((RESULTS / f"{file}.json").read_text()))
    said = found if isinstance(found, str) else f"{found:,}"
    assert count_of(f"python -m benchmarks.reliability.{command}") == said


@pytest.mark.slow
@pytest.mark.multiprocess
def test_a_count_is_the_tests():
    tested = [row for row in ROWS if row.command.startswith("pytest ")]
    done = subprocess.run(
        [sys.executable, "-m", "tests.helpers.collected"], cwd=REPO, text=True,
        input=json.dumps([shlex.split(row.command)[1:] for row in tested]),
        capture_output=True, check=True,
    )  # fmt: skip
    said = {row.fault: int(row.count.split(" in ")[-1]) for row in tested}
    found = [row.fault for row in tested], json.loads(done.stdout)
    assert said == dict(zip(*found, strict=True))


def test_the_count_of_the_fuzzed_reader_is_what_was_said():
    """Of the last `make reliability` in the results, unless it left the row out."""
    result = json.loads((RESULTS / "reliability.json").read_text())
    if "make fuzz" in result["not_run"]:
        return
    (row,) = (row for row in result["rows"] if row["command"] == "make fuzz")
    assert row["status"] == 0
    assert row["said"] == f"fuzz: {count_of('make fuzz')} inputs, no crash"


def test_rows_of_the_world_are_rows():
    assert {row.command for row in ROWS} >= set(table.WORLD)


def test_a_row_without_minutes_is_one_line():
    line = "| SIGKILL | at random | 3 | the same | soon | `make test` |"
    with pytest.raises(InputError, match="SIGKILL: minutes: soon: expected a number"):
        rows_of(line)
    assert rows_of("| a | b |\n" + line.replace("soon", "2"))[0].command == "make test"


@pytest.mark.multiprocess
def test_what_came_of_a_row(monkeypatch, tmp_path):
    def ran(command):
        return table.ran(Row(fault="a", count="1", minutes=1, command=command))

    good = ran('python -c "print(3)"')
    assert (good["status"], good["said"]) == (0, "3")
    bad = ran('python -c "assert 0"')
    assert bad["status"] == 1
    assert bad["said"].startswith("AssertionError")
    test = tmp_path / "test_it.py"
    test.write_text(
        "import atexit, sys, pytest\n"
        "atexit.register(print, 'WARNING: late', file=sys.stderr)\n"
        "def test_a(): pass\n"
        "def test_b(): pytest.skip('no compiler')\n"
        "def test_c(): pass\n"
    )
    monkeypatch.setenv("PY_COLORS", "1")
    row = ran(f"pytest {test} -p no:cacheprovider -k 'test_a or test_b'")
    assert row["status"] == table.NOT_RUN
    assert row["said"].startswith("1 passed, 1 skipped, 1 deselected in ")
    row = ran(f"pytest {test} -p no:cacheprovider -k 'not test_b'")
    assert row["status"] == 0
    assert row["said"].startswith("2 passed, 1 deselected in ")


TWO = "12 passed in 3.10s\nmake[1]: Leaving directory '/x'\n"


@pytest.mark.parametrize(
    ("stdout", "stderr", "status", "said", "skipped"),
    [
        (TWO, "WARNING: Location '/x' is ignored", 0, "12 passed in 3.10s", False),
        ("1 passed, 2 skipped in 0.1s\n" + TWO, "", 0,
         "1 passed, 2 skipped in 0.1s", True),
        ("= 9 passed, 1 xfailed in 63.0s (0:01:03) =\nwritten: a\n", "", 0,
         "9 passed, 1 xfailed in 63.0s (0:01:03) =", False),
        ("5 skipped files\n", "", 0, "5 skipped files", False),
        ("1 failed, 3 passed in 1.00s\n", "make: *** [Makefile:9: x] Error 1", 2,
         "1 failed, 3 passed in 1.00s", False),
        (TWO, "error: audit: none\nmake: *** [Makefile:9: audit] Error 2\n", 2,
         "error: audit: none", False),
        ("", "make: *** No rule to make target 'x'.  Stop.", 2,
         "make: *** No rule to make target 'x'.  Stop.", False),
        ("fuzz: 4,259,727 inputs, no crash\n", "stat::peak_rss_mb: 616", 0,
         "fuzz: 4,259,727 inputs, no crash", False),
        ("", "", 0, "", False),
    ],
)  # fmt: skip
def test_what_sums_it_up(stdout, stderr, status, said, skipped):
    assert summed_up(stdout, stderr, status) == (said, skipped)


def test_the_code_is_what_git_knows(monkeypatch, tmp_path):
    def git(*words):
        subprocess.run(["git", "-C", str(tmp_path), *words], check=True)

    monkeypatch.setattr(table, "ROOT", tmp_path)
    with pytest.raises(InputError, match=r"git ls-files: .*: expected a checkout$"):
        table.tree_sha256()
    git("init", "-q")
    with pytest.raises(InputError, match="no files: expected a checkout"):
        table.tree_sha256()
    names = ("docs/a.js", "benchmarks/results/a.json", "README.md", "notes")
    code = (".ci/audit.py", "onboard/CMakeLists.txt", "a.msgpack", "tests/docs/a.py")
    for name in (*names, *code):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("before")
    git("add", *names[:3], *code)
    before = table.tree_sha256()
    for name in names:
        (tmp_path / name).write_text("after")
        assert table.tree_sha256() == before, name
    for name in code:
        (tmp_path / name).write_text("after")
        assert table.tree_sha256() != before, name
        (tmp_path / name).write_text("before")
    (tmp_path / code[0]).unlink()
    assert table.tree_sha256() != before
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match=r"^git: No such file or directory"):
        table.tree_sha256()


def page(*commands):
    """A page of one row a command."""
    return "\n".join(f"| {x} | by hand | 1 | 0 | 1 | `{x}` |" for x in commands)


@pytest.fixture
def rows(monkeypatch, tmp_path):
    """(a function of pages and flags that runs the rows; the rows run by it)."""
    seen, real = [], table.ran
    monkeypatch.setattr(table, "PAGE", tmp_path / "page.md")
    monkeypatch.setattr(table, "tree_sha256", lambda: "this")
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
    monkeypatch.setattr(table, "tree_sha256", lambda: "other")
    status, seen, result = rows(page("true", "make --version"), rows=["true"])
    assert seen == ["true"]
    assert result["not_run"] == ["make --version"]


def test_what_others_publish_is_looked_at_again(rows, monkeypatch):
    monkeypatch.setattr(table, "WORLD", ("true",))
    for _ in range(2):
        assert rows(page("true", "make --version"), rows=["true"])[:2] == (0, ["true"])
    result = rows(page("true", "make --version"), rows=["make"])[2]
    assert result["not_run"] == ["true"]


def test_a_result_of_something_else_is_one_line(tmp_path):
    (tmp_path / "reliability.json").write_text("[]")
    with pytest.raises(InputError, match=r"reliability\.json: expected a result of"):
        table.as_stated_before(tmp_path / "reliability.json", "")
