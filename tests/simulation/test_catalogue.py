"""Expressions, family files and cases: safe, exact, the same everywhere."""

import jax
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.simulation.cases import LineKind
from rcirl_jax.simulation.catalogue import (
    build_case,
    build_cases,
    case_id,
    family_names,
    load_family,
    parameters_of,
    parse_case_id,
)
from rcirl_jax.simulation.families import Expression
from rcirl_jax.simulation.suite import SMOKE_S, CaseRef, build, case_ref, suite_refs

SMALL = """
family = "small"
title = "one of each"
source = "test"
cases = 4
[parameters]
speed = { uniform = [10.0, 10.0], per = "case", unit = "m/s", meaning = "speed" }
gap = { choice = [20.0], unit = "m", meaning = "gap" }
[derived]
twice = "2 * speed"
[road]
speed_limit = "twice"
ego_speed = "speed"
lanes_left = "1"
first = "100"
spacing = "200"
events = "2"
[[curve]]
at = "start"
length = "100"
kappa = "0.01"
ramp = "20"
[[limit]]
at = "start"
speed = "15"
[[shift]]
at = "start + 20"
length = "50"
l = "lane_width * (1 - event)"
[[line]]
kind = "stop_sign"
at = "start + 60"
[[agent]]
kind = "pedestrian"
model = "crossing"
count = "2"
s = "start + gap + i"
l = "-6"
heading = "pi / 2"
v = "1.2"
arrival_s = "3"
phases = [["1", "0", "2"]]
"""


def write(tmp_path, text=SMALL):
    path = tmp_path / "small.toml"
    path.write_text(text)
    return str(path)


def test_a_small_family_by_hand(tmp_path):
    case = build_case(load_family(write(tmp_path)), 0)
    assert float(case.ego_v) == 10.0
    road, agents = case.road, case.agents
    assert float(road.speed_limit[0]) == 20.0
    assert float(road.speed_limit[50]) == 15.0  # station 100
    assert float(road.kappa[49]) == 0.0
    assert float(road.kappa[55]) == pytest.approx(0.005)  # half-way up the ramp
    assert float(road.kappa[75]) == pytest.approx(0.01)
    assert float(road.path_l[60]) == pytest.approx(0.0)
    assert float(road.path_l[90]) == pytest.approx(3.5)
    assert float(road.path_l[-1]) == pytest.approx(0.0)  # the second event's shift
    assert np.abs(np.diff(road.path_l)).max() < 0.35
    assert list(case.lines.kind[:3]) == [LineKind.STOP_SIGN, LineKind.STOP_SIGN, 0]
    np.testing.assert_allclose(case.lines.s[:2], [160.0, 360.0])
    np.testing.assert_allclose(agents.s[:4], [120.0, 121.0, 320.0, 321.0])
    assert agents.kind[4] == 0
    assert float(agents.heading[0]) == pytest.approx(np.pi / 2)
    assert float(agents.script.start[0, 0]) == 1.0
    assert np.isinf(agents.script.start[0, 1])


def test_the_route_leaves_free_what_the_path_and_the_file_say(tmp_path):
    """One lane to the left; the path goes there from station 130 on and comes back."""

    def bounds(text, folder=tmp_path):
        road = build_case(load_family(write(folder, text)), 0).road
        return road.route_right, road.route_left

    right, left = bounds(SMALL)
    edge = 1.5 * 3.5 + 0.5  # the outermost lane comes with its shoulder
    assert (right[20], left[20]) == pytest.approx((-1.75 - 0.5, 1.75))
    assert (right[75], left[75]) == pytest.approx((-1.75 - 0.5, edge))  # on its way
    assert (right[90], left[90]) == pytest.approx((1.75, edge))
    opened = """
[[route]]
at = "20"
length = "30"
low = "0"
high = "7"
"""
    other = tmp_path / "other"  # a file is read once
    other.mkdir()
    _, left = bounds(SMALL + opened, other)
    assert left[[9, 10, 25, 26]] == pytest.approx([1.75, edge, edge, 1.75])


@pytest.mark.parametrize(
    ("change", "names"),
    [
        (("kappa =", "kapa ="), "kapa"),
        (('"100"', '"2 * sped"'), "sped"),
        (('"2 * speed"', '"speed.real"'), "Attribute"),
        (('"2 * speed"', "\"__import__('os')\""), "call of __import__"),
        (('"2 * speed"', '"9 ** 9 ** 9"'), "exponent"),
        (('"2 * speed"', '"1 / 0"'), "division"),
        (('count = "2"', 'count = "9"'), "agents: 18"),
        (('unit = "m", ', ""), "unit"),
        (('model = "crossing"', 'model = "flying"'), "flying"),
        (('["1", "0", "2"]', '["1", "0", "0"]'), "rate"),
    ],
)
def test_bad_files_are_one_line_with_file_and_field(tmp_path, change, names):
    text = SMALL.replace(*change)
    assert text != SMALL
    with pytest.raises(InputError, match=r"small\.toml") as found:
        build_case(load_family(write(tmp_path, text)), 0)
    assert names in str(found.value)
    assert "\n" not in str(found.value)


def test_expressions_compute():
    variables = {"x": 3.0}
    for text, value in [
        ("x ** 2 - 1", 8.0),
        ("where(x > 2, min(x, 1), 5)", 1.0),
        ("clip(x, 0, 2) + x % 2", 3.0),
        ("-inf", -np.inf),
        ("x > 1 and x < 2", 0.0),
    ]:
        assert Expression(text, "here")(variables) == value


def test_a_case_depends_on_its_name_only():
    family = load_family("cut_in")
    alone, among = build_case(family, 7), build_cases(family, [1, 7, 30])
    for a, b in zip(*map(jax.tree.leaves, (alone, among)), strict=True):
        np.testing.assert_array_equal(a, b[1])
    other = build_case(family, 7, seed=1)
    assert not np.array_equal(alone.agents.s, other.agents.s)


def test_parameters_spread_over_their_ranges():
    family = load_family("lead_brakes")
    speeds = np.array([parameters_of(family, i)["ego_speed"] for i in range(64)])
    low, high = next(p for p in family.parameters if p.name == "ego_speed").arguments
    share = np.sort((speeds - low) / (high - low))
    # evenly spread: the discrepancy of 64 random draws would be about 0.17
    assert np.abs(share - (np.arange(64) + 0.5) / 64).max() < 0.06


def test_suites_and_ids():
    full = suite_refs("full")
    assert len({ref.id for ref in full}) == len(full)
    assert len(suite_refs("smoke")) == len(family_names())
    assert parse_case_id(case_id("cut_in", 17, 0)) == ("cut_in", 17, 0)
    assert case_ref("cut_in/017@0") == CaseRef(family="cut_in", index=17)
    for bad in ("cut_in", "cut_in/x@0", "nothing/001@0", "../x/001@0"):
        with pytest.raises(InputError):
            case_ref(bad)
    with pytest.raises(InputError, match="nothing"):
        suite_refs("nothing")
    mixed = build([CaseRef(family="cut_in", index=1), full[0]], SMOKE_S)
    assert mixed.steps.tolist() == [200, 200]
