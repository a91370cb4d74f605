"""Artefacts say what made them: commit, versions, flags, hashes of what was read."""

import html
import json
import re

import pytest

from rcirl_jax.data.importing import import_logs
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.export.reader import load_weights
from tests.data.small_logs import CONFIG, write_logs
from tests.helpers.commands import succeeded
from tests.helpers.weights_files import random_weights

COMMON = ("flags", "git_commit", "code_sha256", "versions")
DATA = "--data={root}/data"
WEIGHTS = "--weights={root}/w.msgpack"
# command: what it is given, what it writes, and which hashes stand there
ARTEFACTS = {
    "rank": (
        (WEIGHTS, DATA, "--output={out}/ranking.json"),
        ("ranking.json",), ("weights_sha256", "data_hash"),
    ),
    "inspect": (
        (DATA, "--scenes=1", "--output={out}"), ("index.html",), (),
    ),
    "replay": (
        (WEIGHTS, "--case=free_cruise/000@0", "--duration=2", "--output={out}"),
        ("case.html",), ("weights_sha256",),
    ),
    "simulate": (
        (WEIGHTS, "--suite=recorded", DATA, "--baselines=", "--cases=1",
         "--output={out}"),
        ("suite.json",), ("weights_sha256", "data_hash"),
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Logs, the dataset of them, and weights."""
    folder = tmp_path_factory.mktemp("provenance")
    import_logs(write_logs(folder / "logs", 2), folder / "data", CONFIG)
    random_weights(folder / "w.msgpack")
    return folder


def said(path):
    """What an artefact says of its making."""
    text = path.read_text()
    if path.suffix == ".json":
        return json.loads(text)["made_by"]
    block = r"(?is)<h2[^>]*>(?:page )?made by</h2>\n<pre[^>]*>(\{.*?)</pre>"
    (found,) = re.findall(block, text)
    return json.loads(html.unescape(found))


@pytest.mark.slow
@pytest.mark.parametrize("name", ARTEFACTS)
def test_it_says_what_made_it(name, root, tmp_path):
    flags, files, hashes = ARTEFACTS[name]
    out = tmp_path / "out"
    given = [flag.format(root=root, out=out) for flag in flags]
    succeeded("rcirl_jax", name, *given)
    weights = root / "w.msgpack"
    expected = {
        "weights_sha256": {str(weights): load_weights(weights).sha256},
        "data_hash": open_dataset(root / "data").hash,
    }
    for file in files:
        made_by = said(out / file)
        assert all(made_by[key] for key in COMMON)
        for flag in given:
            assert flag[2:].partition("=")[0] in made_by["flags"]
        for key in hashes:
            assert made_by[key] == expected[key]
