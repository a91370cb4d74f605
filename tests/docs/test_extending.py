"""The changes of docs/extending.md fit the present code and pass its tests."""

import os
import shlex
import shutil
import subprocess
import sys

import pytest

from tests.docs.pages import DOCS, REPO, fences, section

PAGE = (DOCS / "extending.md").read_text()
ADDITIONS = ("A feature", "A loss", "A table of your own", "A scenario family")
COPIED = ("rcirl_jax", "experiments", "tests", "data_specs", "docs")


def run(command, folder):
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=folder,
        env={**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONDONTWRITEBYTECODE": "1"},
    )  # fmt: skip
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    return done.stdout


def copied(folder):
    """The repository's sources in a folder of their own."""
    for name in COPIED:
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(REPO / name, folder / name, ignore=ignored)
    for name in ("pyproject.toml", "README.md", "BUILD.md", "mkdocs.yml", "Makefile"):
        shutil.copy(REPO / name, folder / name)
    return folder


def changed(folder, addition):
    """Do what the section says; returns its commands that run tests."""
    checks = []
    for language, _, content in fences(section(PAGE, f"## {addition}")):
        if language == "diff":
            path = folder / "change.diff"
            path.write_text(content)
            run(["git", "apply", "-C1", "--whitespace=error", path.name], folder)
        elif content.startswith(".venv/bin/python -m pytest"):
            checks.append([sys.executable, *shlex.split(content)[1:]])
        else:
            run(shlex.split(content), folder)
    return checks


@pytest.mark.slow
@pytest.mark.multiprocess
@pytest.mark.parametrize("addition", ADDITIONS)
def test_the_changed_copy_passes(addition, tmp_path):
    (check,) = changed(copied(tmp_path), addition)
    flags = ["-p", "no:cacheprovider", "-p", "no:randomly"]
    out = run([*check, *flags], tmp_path)
    assert " passed" in out
    assert "skipped" not in out


def test_all_four_at_once(tmp_path):
    """One section's change does not stand in the way of another's."""
    folder = copied(tmp_path)
    for addition in ADDITIONS:
        assert len(changed(folder, addition)) == 1
