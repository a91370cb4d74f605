"""Load and soak: growth is seen, and both programs as small as they go."""

import json

import pytest

from tests.helpers.commands import fresh as command


@pytest.mark.slow
@pytest.mark.multiprocess
@pytest.mark.parametrize(
    ("what", "flags"),
    [
        ("suite", ("--cases=300", "--chunk=30", "--duration=1", "--rows=IDM")),
        ("import", ("--scenes=60000", "--cars=20")),
    ],
)
def test_a_short_load_is_bounded(what, flags, tmp_path):
    places = (f"--folder={tmp_path}", f"--output={tmp_path / 'out'}", "--every=0.05")
    done = command("benchmarks.reliability.load", f"--what={what}", *flags, *places)
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    made = json.loads((tmp_path / "out" / f"load_{what}.json").read_text())
    for row in made.get("rows", {"all": made.get("memory")}).values():
        assert 0.0 < row["early_mb"] <= row["at_most_mb"]
    assert [x.name for x in tmp_path.iterdir()] == ["out"]


@pytest.mark.slow
def test_a_soak_repeats_to_the_bit_and_finds_a_leak(tmp_path):
    flags = ("--seconds=1", "--leak=60", f"--output={tmp_path}")  # the least rounds
    done = command("benchmarks.reliability.soak", *flags)
    assert done.returncode == 1, done.stderr[-2000:]
    made = json.loads((tmp_path / "soak.json").read_text())
    assert any(x.startswith("in_use_mb grew by ") for x in made["problems"])
    assert made["outputs_compared"] > 10
    assert not [x for x in made["problems"] if "different" in x]
