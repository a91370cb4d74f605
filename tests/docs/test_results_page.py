"""Every number of docs/results.md comes from a file that a command makes again."""

import json
import re
import subprocess

import pytest

from benchmarks import remake, tables
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.pipeline import code_sha256
from tests.docs.pages import DOCS, REPO

CITED = re.findall(r"`(\w+)\.json`", (DOCS / "results.md").read_text())
MADE = [file for command in remake.COMMANDS for file in command.files]


def git(*words):
    return subprocess.run(
        ["git", "-C", str(REPO), *words], capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("name", CITED)
def test_a_cited_file_can_be_made_again_and_says_what_made_it(name):
    assert name in MADE
    body = json.loads((remake.RESULTS / f"{name}.json").read_text())
    commit = body["made_by"]["git_commit"].rstrip("+")
    if git("rev-parse", "--is-shallow-repository").stdout.strip() != "false":
        pytest.skip("the history is not here")
    found = git("merge-base", "--is-ancestor", commit, "HEAD")
    assert found.returncode == 0, f"{name}: {commit}: not in the history"


@pytest.mark.parametrize("page", tables.PAGES)
def test_the_tables_of_a_page_are_those_of_the_files(page):
    text = (DOCS / page).read_text()
    assert tables.PLACE.search(text)
    assert tables.filled(text) == text, "python -m benchmarks.tables"


def test_only_what_is_missing_or_old_is_made_and_numbers_keep_five_digits(tmp_path):
    given, folder = tmp_path / "given.json", tmp_path / "runs"
    made_by = {"code_sha256": code_sha256()}
    given.write_text(json.dumps({"x": 1.2345678, "made_by": made_by}))
    lines = f"json.tool {given} {{out}}/b && json.tool {{out}}/b {{out}}/a.json"
    tiny = remake.Command("tiny", 1, lines, {"shift": "a.json"})
    (folder / "tiny").mkdir(parents=True)
    assert remake.left_of([tiny], tmp_path) == {"tiny": ["shift.json missing"]}
    remake.make(tiny, folder, tmp_path, {})
    assert remake.left_of([tiny], tmp_path) == {}
    assert json.loads((tmp_path / "shift.json").read_text())["x"] == 1.2346
    made_by["code_sha256"] = "0" * 64
    (tmp_path / "shift.json").write_text(json.dumps({"made_by": made_by}))
    assert remake.left_of([tiny], tmp_path) == {"tiny": ["shift.json of other code"]}
    given.unlink()
    with pytest.raises(InputError, match="tiny: its command ended with status"):
        remake.make(tiny, folder, tmp_path, {})
