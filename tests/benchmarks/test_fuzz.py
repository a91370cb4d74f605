"""Damaged files for every reader, a few; benchmarks.reliability.fuzz has more."""

import importlib.util
import json
import random
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.reliability.fuzz import codecs, contract
from benchmarks.reliability.fuzz.readers import READERS, shares
from benchmarks.reliability.fuzz.trees import MAX_DEEP, deep, mutate_tree
from rcirl_jax.errors import InputError, as_input_error
from rcirl_jax.export.from_run import read_config
from rcirl_jax.export.sweep.result import read_sweep
from rcirl_jax.features import mapping
from rcirl_jax.report.ranking.sweep_picture import sweep_picture
from rcirl_jax.runtime import pipeline
from tests.helpers.commands import command, fresh

FEW = ("apollo", "nuplan", "argoverse2", "l5", "interaction", "suite", "scenarios")


@pytest.fixture(autouse=True)
def own_presets(monkeypatch):
    """A target points the reader of presets to its folder: not beyond a test."""
    monkeypatch.setattr(mapping, "spec_root", mapping.spec_root)


def drawn(target, count, seed):
    """Inputs of a target: mutated seeds."""
    rng = random.Random(seed)
    for _ in range(count):
        index = rng.randrange(len(target.seeds))
        content = codecs.mutate(target.seeds[index], target.forms[index], rng)
        yield bytes([index]) + content


def breaches(target, inputs):
    """What the inputs break, each kind once."""
    found = {}
    for data in inputs:
        target.put(data)
        breach, _ = contract.verdict(target.read, target.names)
        if breach is not None:
            found.setdefault(breach.kind, breach.text)
    return found


@pytest.mark.parametrize("name", sorted(READERS))
def test_a_reader_returns_or_says_one_line(name, tmp_path):
    target = READERS[name].make(tmp_path / "made")
    for index, content in enumerate(target.seeds):
        target.put(bytes([index]) + content)
        assert contract.verdict(target.read, target.names) == (None, None), index
    count = 15 if name in FEW else 60
    assert breaches(target, drawn(target, count, name)) == {}


# where in the file, bytes that go, bytes that come
EDITS = st.lists(
    st.tuples(st.floats(0.0, 1.0), st.integers(0, 9), st.binary(max_size=9)),
    min_size=1,
    max_size=4,
)


def edited(content, edits):
    """A file with pieces replaced."""
    for where, gone, new in edits:
        at = int(where * len(content))
        content = content[:at] + new + content[at + gone :]
    return content


def holds_after_any_edit(target, examples):
    """The property, over hypothesis' files."""

    @settings(max_examples=examples, derandomize=True, deadline=None, database=None)
    @given(index=st.integers(0, len(target.seeds) - 1), edits=EDITS)
    def holds(index, edits):
        target.put(bytes([index]) + edited(target.seeds[index], edits))
        breach, _ = contract.verdict(target.read, target.names)
        assert breach is None, breach

    holds()


@pytest.mark.parametrize("name", sorted(READERS))
def test_a_file_with_any_edit_is_read_or_one_line(name, tmp_path):
    target = READERS[name].make(tmp_path / "made")
    holds_after_any_edit(target, 10 if name in FEW else 30)


def test_a_sweep_that_is_read_can_be_drawn(tmp_path):
    target = READERS["sweeps"].make(tmp_path / "made")
    drawings = 0
    results = (data for data in drawn(target, 1200, 3) if target.index(data) == 0)
    for data in results:
        target.put(data)
        try:
            report = read_sweep(tmp_path / "made")
        except InputError:
            continue
        if drawings < 20:
            sweep_picture(tmp_path / "sweep.png", report)
            drawings += 1
    assert drawings == 20


@pytest.mark.parametrize(
    ("where", "name", "value"),
    [
        ("sampler", "max_jerk", "high"),
        ("sampler", "num_random", 10**60),
        ("sampler", "num_random", True),
        ("sampler", "cruise_times", [2.0, [3.0]]),
        ("sampler", "envelopes", [[1.0, 2.0]]),
        ("reward", "hidden", 15),
        ("reward", "hidden", [1.5]),
        ("reward", "odd", 1),
    ],
)
def test_settings_of_other_types(tmp_path, where, name, value):
    READERS["runs"].make(tmp_path / "made")
    file = tmp_path / "made" / "run.json"
    found = json.loads(file.read_text())
    found["config"][where][name] = value
    file.write_text(json.dumps(found))
    with pytest.raises(InputError, match=rf"run\.json: {where}\.{name}.*: expected"):
        read_config(tmp_path / "made")


def test_another_exception_is_a_breach(tmp_path, monkeypatch):
    """A planted defect: a stage's record is not looked at."""
    monkeypatch.setattr(pipeline, "_is_record", lambda record: True)
    target = READERS["stages"].make(tmp_path / "made")
    found = breaches(target, drawn(target, 60, 1))
    assert any(kind.startswith(("KeyError", "TypeError")) for kind in found), found
    with pytest.raises(AssertionError, match="KeyError"):
        holds_after_any_edit(target, 500)


@pytest.mark.parametrize(
    ("line", "kind"),
    [
        ("two\nlines of a.csv", "not one printable line"),
        ("a.csv: \x1b[31m", "not one printable line"),
        ("a.csv: " + "x" * 5000, "a line too long"),
        ("field: 3: expected 4", "no file named"),
        ("a.csv: field: 3: expected 4", None),
    ],
)
def test_what_a_refusal_may_say(line, kind):
    found = contract.refusal_breach(line, ["a.csv"])
    assert (found and found.kind) == kind


def test_reading_what_an_input_names_hides_nothing():
    read, other = (contract.Breach(kind, "") for kind in ("read outside", "KeyError"))
    written = contract.Breach("written outside", "")
    assert contract.broken_by(other, [read, written], True) == [other, written]
    assert contract.broken_by(None, [read], True) == []
    assert contract.broken_by(other, [read], False) == [other, read]
    assert contract.refusal_breach("/b.csv: x: 3: expected 4", ["a.csv"], True) is None
    assert contract.refusal_breach("/b.csv: x: 3: expected 4", ["a.csv"]) is not None


def test_errors_are_one_short_printable_line():
    line = str(
        InputError("a.csv: x: \x1b[0m\ud800\u2028\0 " + "9" * 9000 + ": expected")
    )
    assert contract.refusal_breach(line, ["a.csv"]) is None
    assert line.startswith("a.csv: x: ?[0m?")
    assert line.endswith(": expected")


def test_places_outside_are_seen(tmp_path):
    watch = contract.Watch(tmp_path / "own")
    (tmp_path / "own").mkdir()
    secret = tmp_path / "secret"
    secret.write_text("x")
    with watch:
        (tmp_path / "own" / "fine").write_text("x")
    assert watch.seen == []
    for action, kind in (
        (lambda: secret.read_text(), "read outside"),
        (lambda: secret.write_text("y"), "written outside"),
        (lambda: secret.unlink(), "os.remove"),
    ):
        with watch:
            action()
        assert [breach.kind for breach in watch.seen] == [kind]
    with watch:  # one hides none that comes after it
        for _ in range(2):
            (tmp_path / "other").write_text("x")
            (tmp_path / "other").read_text()
    assert [x.kind for x in watch.seen] == ["written outside", "read outside"]


@pytest.mark.parametrize("form", sorted(codecs.CODECS))
def test_codecs_take_any_bytes(form):
    rng = random.Random(form)
    for data in (b"", b"\0" * 40, b"{}", rng.randbytes(300)):
        assert isinstance(codecs.mutate(data, form, rng), bytes)


@pytest.mark.parametrize("size", [-1, -16, -(2**63)])
def test_a_section_that_ends_before_it_begins_is_no_record(size):
    body = bytes(16 + 2048) + struct.pack("<i4xq", 1, size) + bytes(64)
    with pytest.raises(ValueError, match="a section of"):
        codecs.cyber(body, random.Random(0))


def test_trees_stay_trees():
    rng = random.Random(3)
    for _ in range(300):
        json.dumps(mutate_tree({"a": [1, {"b": "c"}], "d": None}, rng))
    depths = {_depth(deep(0, rng)) for _ in range(40)}
    assert max(depths) == MAX_DEEP


def _depth(value):
    count = 0
    while isinstance(value, list | dict):
        value = value[0] if isinstance(value, list) else value["a"]
        count += 1
    return count


def test_every_reader_has_its_share():
    dealt = shares(list(READERS), 1_000_000)
    assert sum(dealt.values()) >= 1_000_000
    assert min(dealt.values()) >= sum(dealt.values()) // 60


def test_refused_memory_is_a_breach():
    def read():
        with as_input_error("a.csv", "rows"):
            np.empty(2**62, np.uint8)

    breach, line = contract.verdict(read, ["a.csv"])
    assert breach.kind.startswith("MemoryError at ")
    assert line.startswith("a.csv: MemoryError: Unable to allocate 4.00 EiB")


@pytest.mark.slow
@pytest.mark.multiprocess
def test_the_command_is_guided_or_refuses(tmp_path):
    """In an environment with atheris (`make reliability`) and without."""
    flags = ("--readers=tfrecord", "--inputs=50", f"--output={tmp_path}")
    done = fresh("benchmarks.reliability.fuzz", *flags)
    if importlib.util.find_spec("atheris"):
        (row,) = json.loads((tmp_path / "fuzz.json").read_text())["rows"]
        assert (done.returncode, row["mutator"]) == (0, "atheris, by form")
    else:
        assert done.stderr == "error: atheris: not installed: expected, or --unguided\n"
        assert (done.returncode, list(tmp_path.iterdir())) == (2, [])


@pytest.mark.slow
@pytest.mark.multiprocess
def test_the_command_writes_a_row_per_reader(tmp_path):
    done = command(
        "benchmarks.reliability.fuzz",
        *("--readers=stages,tfrecord", "--inputs=400", f"--output={tmp_path}"),
        "--unguided",
    )
    assert done.returncode == 0, done.stdout + done.stderr
    rows = json.loads((tmp_path / "fuzz.json").read_text())["rows"]
    assert [row["reader"] for row in rows] == ["stages", "tfrecord"]
    assert sum(row["inputs"] for row in rows) >= 400
    assert all(row["crashes"] == [] for row in rows)
    assert {row["mutator"] for row in rows} == {"at random, by form"}
