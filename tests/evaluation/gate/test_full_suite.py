"""The full suite is a fixed one: parts, other families and other files do not ship."""

import shutil

import pytest

from rcirl_jax.evaluation.gate import full_suite
from rcirl_jax.evaluation.gate.full_suite import (
    FAMILIES,
    SHA256,
    families_sha256,
    left_out_of_suite,
)
from rcirl_jax.runtime.specs import spec_root
from rcirl_jax.simulation.suite import suite_refs

FULL = [(ref.family, ref.index) for ref in suite_refs("full", seed=3)]
NEW = [("slow_vehicle", i) for i in range(180)]  # the family of docs/extending.md


def test_the_suite_of_this_version_is_the_full_one():
    """After a change on purpose: enter families, cases and the hash seen here."""
    assert families_sha256(FAMILIES) == SHA256
    assert sorted(FULL) == sorted((n, i) for n in FAMILIES for i in range(FAMILIES[n]))
    assert left_out_of_suite(FULL) == ""


@pytest.mark.parametrize(
    ("cases", "says"),
    [
        (FULL[1:], "4,139 cases, 1 of the full suite's left out"),
        ([("easy", i) for i in range(30)], "30 cases, 4,140 of the full suite's"),
        ([*FULL, ("easy", 0)], "another suite: easy: cases beyond"),
        ([*FULL, ("cut_in", 180)], "another suite: cut_in: cases beyond"),
        ([*FULL, *NEW], "another suite: slow_vehicle: cases beyond"),
    ],
)
def test_other_cases_are_a_part_or_another_suite(cases, says):
    assert left_out_of_suite(cases).startswith(says)


def test_a_family_whose_file_was_made_easier_is_another_suite(tmp_path, monkeypatch):
    folder = tmp_path / "scenarios"
    shutil.copytree(spec_root() / "scenarios", folder)
    monkeypatch.setattr(full_suite, "spec_root", lambda: tmp_path)
    assert left_out_of_suite(FULL) == ""
    path = folder / "cut_in.toml"
    path.write_text("# a comment\n" + path.read_text())
    assert left_out_of_suite(FULL) == ""
    path.write_text(path.read_text().replace("[5.0, 33.0]", "[5.0, 6.0]"))
    assert left_out_of_suite(FULL).startswith("another suite: the families' files")
