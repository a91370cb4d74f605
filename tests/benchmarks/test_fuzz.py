"""Damaged and hostile files for every reader, a few; more with the marker `long`."""

import json
import random
import resource
import tempfile
import time

import numpy as np
import psutil
import pytest

from benchmarks.reliability.fuzz import changes
from benchmarks.reliability.fuzz.contract import breach, watched
from benchmarks.reliability.fuzz.readers import READERS, inputs
from rcirl_jax.errors import as_input_error
from rcirl_jax.features import mapping
from rcirl_jax.runtime import pipeline

LOGS, OTHERS = 16, 60  # inputs of a whole log, and of other readers
LONG_S = 25.0  # s for each reader among the long tests
MEMORY = 2 * 2**30  # bytes on top of what the imports take


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A reader's own folder, which has its temporary files, too."""
    # a target points the reader of presets to its folder: not beyond a test
    monkeypatch.setattr(mapping, "spec_root", mapping.spec_root)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


@pytest.mark.parametrize("name", READERS)
def test_a_reader_returns_or_says_one_line(name, folder):
    """Whole files, and changed ones."""
    target = READERS[name](folder)
    for file in target.files:
        target.read(file)
    count = LOGS if (folder / "log").is_dir() else OTHERS
    for file in inputs(target, name, count):
        assert breach(target.read, folder, file) is None, file


@pytest.fixture
def little_memory():
    """No more than `MEMORY` while a test runs."""
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = psutil.Process().memory_info().vms + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (most, hard))
    yield
    resource.setrlimit(resource.RLIMIT_AS, (hard, hard))


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("most", [20, 3000], ids=["kilobytes", "megabytes"])
@pytest.mark.parametrize("name", READERS)
def test_a_reader_keeps_its_word_for_long(
    name, most, folder, little_memory, monkeypatch, capsys
):
    """As many inputs as there is time for; other ones each day."""
    monkeypatch.setattr(changes, "most_copies", [most])
    target, seed = READERS[name](folder), f"{name} {time.time() // 86400}"
    count, end = 0, time.monotonic() + LONG_S
    for file in target.changed(random.Random(seed)):
        assert breach(target.read, folder, file) is None, (file, file.read_bytes())
        count += 1
        if time.monotonic() > end:
            break
    with capsys.disabled():
        print(f" {count:,} inputs by the seed {seed!r}", end="")


def test_a_planted_defect_refused_memory_and_places_outside_are_seen(
    folder, monkeypatch
):
    """A stage's record is not looked at; half of all memory is asked for."""
    monkeypatch.setattr(pipeline, "checked", lambda body, kind, where: body)
    made = folder / "made"
    made.mkdir()
    target = READERS["stages"](made)
    (file,) = target.files
    content = json.loads(file.read_text())
    file.write_text(json.dumps({**content, "stages": 3}))
    assert breach(target.read, made, file).startswith(("AttributeError", "TypeError"))

    def read(_):
        with as_input_error(str(file), "rows"):
            np.empty(2**62, np.uint8)

    assert breach(read, made, file).startswith("MemoryError at ")
    with watched(made) as seen:
        (made / "fine").write_text("x")
    assert seen == []
    with watched(made) as seen:
        (folder / "secret").write_text("y")
        (folder / "secret").unlink()
    assert [x.split(" ")[0] for x in seen] == ["open", "os.remove"]
