"""Every number of docs/results.md comes from a file that a command makes again."""

import json

from benchmarks import remake


def test_all_is_made_in_twelve_hours():
    assert sum(command.minutes for command in remake.COMMANDS) <= 12 * 60


def test_only_what_is_missing_or_old_is_made(tmp_path):
    tiny = remake.Command(
        "tiny",
        1,
        "experiments.paper.background_shift --quick --output={out}",
        {"shift": "background_shift.json"},
    )
    assert remake.left_of([tiny], tmp_path) == {"tiny": ["shift.json missing"]}
    remake.make(tiny, tmp_path / "runs", tmp_path, {})
    assert remake.left_of([tiny], tmp_path) == {}
    body = json.loads((tmp_path / "shift.json").read_text())
    body["made_by"]["code_sha256"] = "0" * 64
    (tmp_path / "shift.json").write_text(json.dumps(body))
    assert remake.left_of([tiny], tmp_path) == {"tiny": ["shift.json of other code"]}


def test_numbers_keep_five_digits():
    body = {"a": [1.2345678, 12, "x"], "b": {"c": 0.000123456}}
    assert remake.rounded(body) == {"a": [1.2346, 12, "x"], "b": {"c": 0.00012346}}
