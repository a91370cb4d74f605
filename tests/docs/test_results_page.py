"""Every number of docs/results.md comes from a file that a command makes again."""

import json
import re
import subprocess

import pytest

from benchmarks import remake, tables
from tests.docs.pages import DOCS, REPO

CITED = re.findall(r"`(\w+)\.json`", (DOCS / "results.md").read_text())
MADE = [file for command in remake.COMMANDS for file in command.files]


@pytest.mark.parametrize("name", CITED)
def test_a_cited_file_can_be_made_again_and_says_what_made_it(name):
    assert name in MADE
    body = json.loads((remake.RESULTS / f"{name}.json").read_text())
    commit = body["made_by"]["git_commit"].rstrip("+")
    git = ["git", "-C", str(REPO)]
    if (
        subprocess.run(
            [*git, "rev-parse", "--is-shallow-repository"],
            capture_output=True,
            check=False,
            text=True,
        ).stdout.strip()
        != "false"
    ):
        pytest.skip("the history is not here")  # fmt: skip
    found = subprocess.run(
        [*git, "merge-base", "--is-ancestor", commit, "HEAD"], check=False
    )
    assert found.returncode == 0, f"{name}: {commit}: not in the history"


@pytest.mark.parametrize("page", tables.PAGES)
def test_the_tables_of_a_page_are_those_of_the_files(page):
    text = (DOCS / page).read_text()
    assert tables.PLACE.search(text)
    assert tables.filled(text) == text, "python -m benchmarks.tables"
