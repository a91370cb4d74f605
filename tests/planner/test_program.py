"""A planner that is a program: as the built-in one, and what may go wrong with it."""

import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.suite import SuiteConfig, run_suite
from rcirl_jax.evaluation.closed_loop.summary import format_suite
from rcirl_jax.evaluation.gate.types import GateConfig, Pair
from rcirl_jax.evaluation.gate.verdict import judge, repeats
from rcirl_jax.export.closed_loop import checked_program, gate_job, table_rows
from rcirl_jax.planner.program import (
    check_program,
    name_cases,
    processes_of,
    program,
)
from rcirl_jax.simulation.metrics import not_driven
from rcirl_jax.simulation.rollout import first_scenes
from rcirl_jax.simulation.rows import program_row, rule_row
from rcirl_jax.simulation.suite import (
    build,
    catalogue_set,
    drive_row,
    drive_with_logs,
    rollout_config,
    suite_refs,
)
from tests.onboard.programs import compiled

EXAMPLE = Path(__file__).parents[2] / "onboard" / "example"
FAULTY = Path(__file__).parent / "programs" / "faulty.py"
CASE = "cut_in/002@0"
SECONDS = 4.0


def python(*words):
    return " ".join([sys.executable, *(f"'{word}'" for word in words)])


def refs():
    return suite_refs("cut_in,traffic", 5)


def driven(row):
    """Metrics of ten short cases."""
    cases = catalogue_set(refs(), SECONDS)
    config = rollout_config(row, SECONDS, 1)
    return drive_row(row, cases.build, len(cases.ids), config, chunk=30)


def faulty(*words):
    return program_row(program(python(FAULTY, *words)))


@pytest.fixture(scope="module")
def in_cpp(tmp_path_factory):
    file = tmp_path_factory.mktemp("planner") / "planner_program"
    return compiled(EXAMPLE / "planner_program.cpp", file)


@pytest.mark.parametrize("which", ["Python", "C++"])
def test_the_examples_drive_as_the_built_in_idm(which, request):
    if which == "Python":
        command = python(EXAMPLE / "planner_program.py")
    else:
        command = request.getfixturevalue("in_cpp")
    one = program(f"planner:{command}")
    assert one.name == f"IDM in {which}"
    theirs, ours = driven(program_row(one)), driven(rule_row("IDM", "IDM"))
    assert not not_driven(theirs).any()
    for name in ("progress", "rms_a", "min_a", "mean_speed", "min_clearance"):
        found, expected = getattr(theirs, name), getattr(ours, name)
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)
    assert np.ptp(ours.progress) > 5.0
    # ten cases, and not the twenty that fill the lanes
    assert processes_of(one).times()["answers"] == 10 * round(10 * SECONDS)


FAULTS = {
    "cut_in/000@0": "dies", "cut_in/004@0": "says error",
    "traffic/001@0": "dies later", "traffic/003@0": "hangs",
}  # fmt: skip


@pytest.fixture(scope="module")
def constant():
    """Metrics of constant speed."""
    return driven(rule_row("constant speed", "constant speed"))


def test_cases_without_a_plan_are_not_driven_and_the_others_are(constant, capfd):
    """Stations alone are a plan."""
    found = driven(faulty(*(f"{case}={kind}" for case, kind in FAULTS.items())))
    lost = np.array([ref.id in FAULTS for ref in refs()])
    assert sum(lost) == 4
    assert not_driven(found).tolist() == lost.tolist()
    np.testing.assert_allclose(
        found.progress[~lost], constant.progress[~lost], rtol=1e-3
    )
    assert all(np.isfinite(found.progress))
    assert not found.holds[lost].any()
    line = capfd.readouterr().err
    assert line.startswith("not driven: ")
    assert ", step 0: " in line
    assert line.count("\n") == 1


def test_a_program_that_died_is_started_anew(tmp_path, constant):
    found = driven(faulty(f"{CASE}=dies once:{tmp_path / 'died'}"))
    assert (tmp_path / "died").exists()
    assert not not_driven(found).any()
    np.testing.assert_allclose(found.progress, constant.progress, rtol=1e-3)


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("dies", "its process ended with status 9: expected"),
        ("hangs", r"no answer in 0.5 s: expected \{\"s\".*\"answer_s\" of at most 600"),
        ("babbles on", "'planned in 3 ms.*' without being asked"),
        ("endless line", "a line longer than 1,048,576 bytes"),
        ("short", "s: 17 numbers: expected 18"),
        ("nan", r"s\[1\]: nan: expected a finite number"),
        ("back", r"s\[5\]: .* m after .* m: expected no way back"),
        ("elsewhere", r"s\[0\]: 3 m: expected 0: stations are from the ego's centre"),
    ],
)
def test_what_is_no_plan_is_one_line(kind, line):
    one, some = program(python(FAULTY, kind)), refs()[:4]
    cases = catalogue_set(some, 1.0).build(0, 4)
    scenes = jax.tree.map(np.asarray, first_scenes(cases))
    with pytest.raises(InputError, match=line) as found:
        check_program(one, scenes, cases.seed)
    assert f"{FAULTY.name}' '{kind}'" in str(found.value)
    assert ": case cut_in/00" in str(found.value)
    assert ", step 0: " in str(found.value)


@pytest.mark.parametrize(
    ("command", "line"),
    [
        ("./nowhere", r"./nowhere: No such file or directory: expected a program"),
        ("", "planner: '': expected a command"),
        ("true", r'true: on start: its process ended with status 0: expected \{"prot'),
        ("sh -c 'read x; echo hello'", "on start: 'hello': expected"),
        (
            python(FAULTY, "another protocol"),
            r"protocol: 2: expected \{\"protocol\": 1",
        ),
    ],
)
def test_what_does_not_speak_the_protocol_is_one_line(command, line):
    with pytest.raises(InputError, match=line):
        program(f"planner:{command}")


def test_the_table_says_how_many_cases_were_not_driven_and_nothing_ships():
    rows = [
        faulty(f"{CASE}=says error"),
        rule_row("constant V", "constant speed"),
        rule_row("+velocity", "constant speed"),
        rule_row("IDM", "IDM"),
    ]
    some = suite_refs("cut_in,traffic", 15)
    result = run_suite(rows, catalogue_set(some, SECONDS), SuiteConfig())
    assert "faulty: 1 of 30 cases not driven: " in format_suite(result.report)
    assert result.report.rows["faulty"].not_driven == 1
    repeats(rows[0], result, SuiteConfig())
    for mine, theirs, who in (
        ("faulty", "IDM", "the candidate"),
        ("IDM", "faulty", "faulty"),
    ):
        verdict = judge(Pair(runs=result, mine=mine, name=theirs), GateConfig())
        assert verdict.decision != "ship"
        (check,) = [x for x in verdict.checks if x.title.startswith("all cases driven")]
        assert check.outcome == "open"
        assert who.removeprefix("the ") in check.note
        assert "did not drive 1 of 30 cases" in check.note


def test_pictures_of_a_case_that_was_not_driven_have_numbers(capfd):
    row, cases = faulty("dies later"), build(refs()[:1], SECONDS)
    name_cases({int(cases.seed[0]): refs()[0].id})
    logs = drive_with_logs(row, cases, rollout_config(row, SECONDS, 1))
    assert "case cut_in/000@0, step 20: " in capfd.readouterr().err
    assert not_driven(logs[0]).all()
    for leaf in jax.tree.leaves(logs[1:]):
        assert not np.isnan(leaf).any()


def test_rows_of_a_table_without_weights(in_cpp):
    rows = table_rows([], ["hand-set", "IDM"], planners=[("", in_cpp)])
    assert [row.name for row in rows] == ["IDM in C++", "hand-set", "IDM"]
    with pytest.raises(InputError, match="it is called IDM in C\\+\\+: expected"):
        table_rows([], ["IDM"], planners=[("", in_cpp), ("", f"{in_cpp} ")])
    with pytest.raises(InputError, match="expected at least one file or planner"):
        table_rows([], ["IDM"])


def test_a_gate_of_two_programs(in_cpp):
    settings = {
        "suite": "smoke", "cases": None, "duration_s": None, "catalogue_seed": 0,
        "plan_every": 1,
    }  # fmt: skip
    place = f"planner:{in_cpp}"
    job, incumbent = gate_job(place, place, **settings)
    names = [row.name for row in job.rows()]
    assert (names, incumbent) == (["candidate", "incumbent", "IDM"], "incumbent")
    job, incumbent = gate_job(place, "hand-set", **settings)
    assert [row.name for row in job.rows()] == ["candidate", "hand-set", "IDM"]
    job, _ = gate_job("not_made_yet.msgpack", place, **settings)  # as autotune asks
    assert (job.weights, job.names) == (("not_made_yet.msgpack",), ("candidate",))
    assert checked_program(place).name == "IDM in C++"
    assert list(job.planner_facts()) == [in_cpp]
    with pytest.raises(InputError, match="No such file or directory"):
        gate_job("planner:./nowhere", "hand-set", **settings)
