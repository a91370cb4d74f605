"""The pages name things that exist: pages, anchors, files, commands, flags, numbers."""

import importlib.util
import json
import os
import re
import subprocess
import sys
import tomllib

import pytest

from rcirl_jax.cli.rcirl import COMMANDS
from rcirl_jax.evaluation.gate.types import EXIT_CODES, GateConfig
from rcirl_jax.evaluation.gate.verdict import MATERIAL
from rcirl_jax.train.featurise import NORMALISER_SCENES
from tests.docs.pages import (
    ALL,
    DOCS,
    PAGES,
    REPO,
    anchors,
    code,
    links,
    name_of,
    section,
    spans,
    table,
)  # fmt: skip

PRESETS = sorted((REPO / "data_specs" / "features").glob("*.toml"))
MODULE = r"(?:experiments|benchmarks)(?:\.[a-z_0-9]+)+|rcirl [a-z][a-z-]+"
COMMAND = re.compile(rf"(?<![\w/.])({MODULE})\b([^\n|&]*)")
FLAG = re.compile(r"(?<!\S)--([a-z_0-9]+)")
VALUE = re.compile(r"(?<![\w-])--([a-z_0-9]+)=([^\s\\]+)")
PATH = re.compile(r"[\w.-]+/[\w./*-]*")
PLACEHOLDER = re.compile(r"[A-Z]{3}")  # NAME.toml, SCENE.csv
BUILT_IN = {"help", "helpfull", "flagfile"}
# what has a path's shape in prose, but is made by a command or by the reader
ELSEWHERE = {"out", "build"}


@pytest.mark.parametrize("page", ALL, ids=name_of)
def test_links_resolve(page):
    for link in links(page.read_text()):
        if link.startswith(("http://", "https://")):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{name_of(page)}: {link}"
        if page in PAGES:  # a page of the site cannot link out of it
            assert target.is_relative_to(DOCS), f"{name_of(page)}: {link}"
        if anchor:
            assert anchor in anchors(target.read_text()), f"{name_of(page)}: {link}"


def rooms():
    """Names that begin a path of this repository, and where they may be."""
    top = {item.name for item in REPO.iterdir() if item.is_dir()} - ELSEWHERE
    package = {item.name for item in (REPO / "rcirl_jax").iterdir() if item.is_dir()}
    return top | package


@pytest.mark.parametrize("page", ALL, ids=name_of)
def test_named_files_exist(page):
    known = rooms()
    for span in spans(page.read_text()):
        if not PATH.fullmatch(span) or span.split("/")[0] not in known:
            continue
        if PLACEHOLDER.search(span.replace("README", "")):
            continue
        places = (REPO, REPO / "rcirl_jax", page.parent)
        found = any(any(place.glob(span.rstrip("/"))) for place in places)
        assert found, f"{name_of(page)}: `{span}`"


def test_the_navigation_has_every_page():
    text = (REPO / "mkdocs.yml").read_text()
    named = re.findall(r"^ +- (?:[^:\n]+: )?(\S+\.md)$", text, re.M)
    assert sorted(named) == [str(page.relative_to(DOCS)) for page in PAGES]


def test_make_targets_exist():
    makefile = (REPO / "Makefile").read_text()
    for block in (block for page in ALL for block in code(page.read_text())):
        for target in re.findall(r"^make ([a-z-]+)\b", block, re.M):
            assert re.search(rf"^{target}:", makefile, re.M), target


LIST_FLAGS = """
import importlib, json, sys
from absl import flags
OURS = ("experiments", "benchmarks", "rcirl_jax.cli")
found, refused = {}, []
given = json.load(sys.stdin)
for name in sys.argv[1:]:
    for flag in list(flags.FLAGS):
        if flags.FLAGS.find_module_defining_flag(flag, "").startswith(OURS):
            delattr(flags.FLAGS, flag)
    for module in [m for m in sys.modules if m.startswith(OURS)]:
        del sys.modules[module]
    importlib.import_module(name)
    found[name] = [
        flag for flag in flags.FLAGS
        if flags.FLAGS.find_module_defining_flag(flag, "").startswith(OURS)
    ]
    for flag, value in given.get(name, []):
        if flag in found[name]:
            try:
                flags.FLAGS[flag].parser.parse(value)
            except ValueError as error:
                refused.append(f"{name}: --{flag}={value}: {error}")
print(json.dumps([found, refused]))
"""


def commands():
    """(page, module, text behind it) of every command that a page names."""
    return [
        (name_of(page), module_of(match[1]), match[2])
        for page in ALL
        for block in code(page.read_text())
        for match in COMMAND.finditer(block)
    ]


def module_of(name):
    """Of a command as a page names it: `rcirl rank`, `experiments.evaluate`."""
    name, _, command = name.partition(" ")
    module, _ = COMMANDS.get(command, (command, ""))
    return f"rcirl_jax.cli.{module}" if command else name


def is_main(module):
    path = REPO / (module.replace(".", "/") + ".py")
    ours = module.startswith("rcirl_jax.cli.")
    return path.is_file() and (ours or 'if __name__ == "__main__"' in path.read_text())


def values():
    """Module -> (flag, value) of its commands, but for NAMES and what is left open."""
    found = {}
    for _, module, rest in commands():
        for flag, value in VALUE.findall(rest):
            value = value.rstrip("`.,]")
            # N stands for a number; jsonl is the format that extending.md adds
            if not PLACEHOLDER.search(value) and value not in ("N", "jsonl"):
                found.setdefault(module, []).append((flag, value))
    return found


def known_flags():
    """Module -> its flags, and values that are none; one process imports them all."""
    named = {module for _, module, _ in commands() if is_main(module)}
    for file in (REPO / "benchmarks").rglob("*.py"):  # also those of no page
        if "run(main)" in file.read_text():
            named.add(".".join(file.relative_to(REPO).with_suffix("").parts))
    done = subprocess.run(
        [sys.executable, "-c", LIST_FLAGS, *sorted(named)], input=json.dumps(values()),
        capture_output=True, text=True, check=False, cwd=REPO, timeout=300,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


def test_commands_name_modules_flags_and_values_that_they_take():
    """--suite=smok, --epochs=ten: a page would say what no longer runs."""
    known, refused = known_flags()
    wrong = [*refused]
    for page, module, rest in commands():
        path = REPO / module.replace(".", "/")
        if not path.with_suffix(".py").is_file() and not path.is_dir():
            wrong.append(f"{page}: {module}: no such module")
        elif is_main(module):
            flags = set(known[module]) | BUILT_IN
            names = {name.removeprefix("no") if name not in flags else name
                     for name in FLAG.findall(rest)}  # fmt: skip
            wrong += [f"{page}: {module}: --{name}" for name in sorted(names - flags)]
    assert not wrong, "\n".join(wrong)
    assert len(known) > 15


@pytest.mark.parametrize("preset", PRESETS, ids=lambda path: path.stem)
def test_the_feature_dictionary_is_the_preset(preset):
    text = (DOCS / "features.md").read_text()
    rows = table(section(text, f"## `{preset.stem}`"))
    declared = tomllib.loads(preset.read_text())["feature"]
    assert len(rows) == len(declared)
    for number, (row, spec) in enumerate(zip(rows, declared, strict=True)):
        assert row[:3] == [str(number), spec["name"], spec["unit"]]
        assert [float(cell) for cell in row[3:]] == [
            spec[key] for key in ("none", "lower", "upper")
        ], spec["name"]


def test_the_gates_margins_and_exit_status_are_those_of_the_code():
    text = (DOCS / "gate.md").read_text()
    rows = table(section(text, "## Margins"))
    stated = {row[0].removeprefix("--").removesuffix("_margin"): row[1] for row in rows}
    assert {k: float(v) for k, v in stated.items()} == GateConfig().margins
    rows = table(section(text, "## Verdicts and exit status"))
    assert {row[0]: int(row[2]) for row in rows} == EXIT_CODES
    assert (MATERIAL, "is more than half of the margin" in text) == (0.5, True)


def test_the_guards_ranges_are_of_as_many_scenes_as_the_page_says():
    text = (DOCS / "guard.md").read_text()
    assert f"of up to {NORMALISER_SCENES:,} training scenes" in text


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the built site."""
    if importlib.util.find_spec("material") is None:
        pytest.skip("mkdocs-material not installed: pip install 'rcirl-jax[docs]'")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-d", folder],
        capture_output=True, text=True, check=False, cwd=REPO,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_the_site_builds_and_needs_no_network(site):
    pages = list(site.rglob("*.html"))
    assert len(pages) > len(PAGES)
    loaded = re.compile(r"<(?:script|img|iframe)[^>]+src=\"(?:https?:)?//")
    styles = re.compile(r"<link[^>]+rel=\"(?:stylesheet|preconnect)\"[^>]+//")
    for page in pages:
        text = page.read_text()
        assert not loaded.search(text), page
        assert not styles.search(text), page


@pytest.mark.parametrize(
    ("name", "shown_by"),
    [
        ("own_planner.py", "own_planner.md"),
        ("own_planner.cpp", "own_planner.md"),
        ("planner_program.py", "own_process.md"),
    ],
)
def test_the_page_shows_the_programs_as_they_are(name, shown_by):
    """A code host shows the page without the site's snippets."""
    page, file = (DOCS / shown_by).read_text(), REPO / "onboard/example" / name
    assert f'title="onboard/example/{name}"\n{file.read_text()}```' in page
    assert "--8<--" not in page
