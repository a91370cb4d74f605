"""CommonRoad XML: fixtures of both versions, real files, malformed files."""

import functools
import time

import numpy as np
import pytest
from defusedxml import ElementTree
from hypothesis import given
from hypothesis import strategies as st

from rcirl_jax.types import Kind
from tests.data.formats import writers as w
from tests.data.formats.fixtures import has_note
from tests.helpers import logs
from tests.helpers.logs import refused

read = functools.partial(logs.read, "commonroad")
only = functools.partial(logs.only, "commonroad")


def scenario(folder, *parts, **options):
    """The recording of a file of these parts, by default of a car on a lanelet."""
    return only(w.commonroad(folder / "a.xml", *parts, **options))


def road(extra="", **bounds):
    """The lane of a file with one lanelet and a car."""
    return w.lanelet(extra=extra, **bounds) + w.car()


@pytest.mark.parametrize("version", ["2018b", "2020a"])
def test_both_versions(tmp_path, version):
    """A car moves; standing things last the whole recording."""
    parked = w.car("31", kind="parkedVehicle", version=version, count=2, y=-5)
    parts = (w.lanelet(), w.car(version=version), w.standing(version=version), parked)
    recording = scenario(tmp_path, *parts, version=version)
    track, *standing = recording.tracks
    np.testing.assert_allclose(track.x, 1.5 * np.arange(40))
    np.testing.assert_array_equal(track.speed, 15.0)
    assert recording.group == "a"
    assert has_note(recording, "its own group")
    assert [one.kind for one in standing] == [Kind.STATIC, Kind.STATIC]
    for one in standing:
        np.testing.assert_allclose(one.t, track.t)
        assert np.ptp(one.x) == 0.0
        assert not one.speed.any()


@pytest.mark.parametrize(
    ("kind", "expected"), [("motorcycle", Kind.VEHICLE), ("bicycle", Kind.CYCLIST)]
)
def test_kinds(tmp_path, kind, expected):
    (track,) = scenario(tmp_path, w.lanelet(), w.car(kind=kind)).tracks
    assert track.kind == expected


def test_lane_geometry_from_unequal_bounds(tmp_path):
    (lane,) = scenario(tmp_path).lanes
    np.testing.assert_allclose(lane.centre, [[0, 0], [100, 0], [200, 0]], atol=1e-9)
    np.testing.assert_allclose(lane.left_width + lane.right_width, 3.5)
    # one that tapers to a point keeps a width
    (lane,) = scenario(tmp_path, road(left=[(0, 1.75), (200, -1.75)])).lanes
    assert (lane.left_width > 0.0).all()


def test_speed_limits(tmp_path):
    signs = ("50", 13.4112), ("51", 3.5763)
    recording = scenario(
        tmp_path,
        *[
            w.lanelet(f"{n}", extra=f'<trafficSignRef ref="{sign}"/>')
            for n, (sign, _) in enumerate(signs, 1)
        ],
        *(w.lanelet("3"), w.car(), *[w.sign(n, "R2-1", limit) for n, limit in signs]),
    )
    assert [lane.speed_limit for lane in recording.lanes] == [13.4112, None, None]
    assert recording.default_speed_limit == 13.4112
    assert has_note(recording, "speed limit")
    body = w.lanelet(extra="<speedLimit>20</speedLimit>") + w.car(version="2018b")
    assert scenario(tmp_path, body, version="2018b").lanes[0].speed_limit == 20.0


def of_sign(folder, country, kind, limit=8.33, extra=""):
    """The recording of a lane behind one sign, in a country's file."""
    sign = w.sign("50", kind, limit)
    ref = f'{extra}<trafficSignRef ref="50"/>{extra.replace("<", "</")}'
    path = w.commonroad(folder / "a.xml", road(ref), sign)
    if country:
        logs.edit(path, "<commonRoad ", f'<commonRoad benchmarkID="{country}_A-1_1" ')
    return only(path)


def test_limits_of_countries(tmp_path):
    """By CommonRoad's tables; German ids hold everywhere, any where nobody says."""
    kinds = {
        **{"ARG": "R15", "AUS": "R4-1", "BEL": "C43", "ESP": "r301", "FRA": "B14"},
        **{"GRC": "\N{GREEK CAPITAL LETTER RHO}-32", "HRV": "B31", "PRI": "R2-1"},
        **{"RUS": "3.24", "USA": "R2-1", "DEU": "274-50", "C-DEU": "274.1"},
        **{"CHN": "274", "ITA": "274", "ZAM": "274"},
    }
    for country, kind in kinds.items():
        for name in (country, ""):
            (lane,) = of_sign(tmp_path, name, kind).lanes
            assert lane.speed_limit == 8.33, (name, kind)
    for kind in ("R1-1", "206", "r2", "R27", "B5", "AB4", "2.5", "B02"):
        assert of_sign(tmp_path, "", kind, None, "<stopLine>").lanes[0].stop_sign


def test_stop_lines_signs_and_lights(tmp_path):
    ends = "".join(w.POINT.format(*p) for p in [(190, 1.75), (190, -1.75)])
    sign = "<stopLine><trafficSignRef ref='60'/></stopLine>"
    light = f"<stopLine>{ends}</stopLine><trafficLightRef ref='7'/>"
    parts = (
        *(w.lanelet("1", extra=sign), w.lanelet("2", extra=light), w.car()),
        *(w.sign("60", "R1-1"), w.light("7", [("green", 10), ("red", 20)])),
    )
    first, second = scenario(tmp_path, *parts).lanes
    assert (first.stop_sign, second.stop_sign) == (True, False)
    np.testing.assert_array_equal(first.stop_line, [[200, 1.75], [200, -1.75]])
    np.testing.assert_array_equal(second.stop_line, [[190, 1.75], [190, -1.75]])
    assert second.signal_ids == ("7",)


def lit(folder, phases, **options):
    """The signal of a cycle."""
    (signal,) = scenario(folder, road(), w.light("7", phases, **options)).signals
    return signal


@given(
    durations=st.lists(st.integers(1, 400), min_size=1, max_size=4),
    offset=st.integers(0, 2000),
)
def test_signal_cycle_against_modular_arithmetic(tmp_path_factory, durations, offset):
    colours = ["green", "yellow", "redYellow", "inactive"][: len(durations)]
    shown = {"redYellow": "red", "inactive": "off"}
    phases = list(zip(colours, durations, strict=True))
    signal = lit(tmp_path_factory.mktemp("signal"), phases, offset=offset)
    assert not signal.is_recorded
    assert signal.start[0] <= 0.0
    for step in range(40):
        left = (step - offset) % sum(durations)
        ends = zip(colours, np.cumsum(durations), strict=True)
        expected = next(colour for colour, end in ends if left < end)
        index = np.searchsorted(signal.start, 0.1 * step + 1e-6, side="right") - 1
        assert signal.state[index] == shown.get(expected, expected)


RECTANGLE = (
    "<position><rectangle><length>2</length><width>2</width>"
    "<center><x>25</x><y>1</y></center></rectangle></position>"
)
# an L of two rectangles, 128 m2 about (24, -2) and 64 m2 about (20, 6)
CORNERS = [(16, -6), (32, -6), (32, 2), (24, 2), (24, 10), (16, 10)]
POLYGON = f"<position>{w.bound('polygon', CORNERS)}</position>"
ON_LANELET = '<position><lanelet ref="1"/></position>'


@pytest.mark.parametrize(
    ("goal", "end"),
    [
        *((RECTANGLE, (25.0, 1.0)), (POLYGON, (22.667, 0.667))),
        *((ON_LANELET, (30.0, 0.0)), ("", (30.0, 0.0))),
    ],
)
def test_a_missing_agent_reaches_the_goal(tmp_path, goal, end):
    (agent,) = scenario(tmp_path, road(), w.problem(goal, speed=10.0)).missing_agents
    assert (agent.t0, agent.t1, agent.start) == (0.0, pytest.approx(3.0), (0.0, 0.0))
    np.testing.assert_allclose(agent.end, end, atol=0.6)


def test_groups_beside_and_above_the_folder(tmp_path):
    (tmp_path / "xml").mkdir()
    file = w.commonroad(tmp_path / "xml" / "a.xml")
    table = tmp_path / "independent_groups.csv"
    table.write_text("file,group\na.xml,G1\n")
    assert only(file.parent).group == only(file).group == "G1"
    for text in ("name,number\na.xml,1\n", "file,group\na.xml\n"):
        table.write_text(text)
        assert "csv: row 1: " in refused(read, file)


@pytest.mark.dataset
@pytest.mark.parametrize(
    ("folder", "files", "tracks", "groups"),
    [("ngsim_us101_commonroad", 36, 996, 16), ("ngsim_urban_commonroad", 25, 1136, 6)],
)
def test_recorded_files(data_dir, folder, files, tracks, groups):
    begin = time.process_time()
    found = read(data_dir / folder / "xml")
    assert time.process_time() - begin < 10.0
    assert len(found) == files
    assert sum(len(recording.tracks) for recording in found) == tracks
    assert len({recording.group for recording in found}) == groups
    for recording in found:
        (agent,) = recording.missing_agents
        distance = np.hypot(*np.subtract(agent.end, agent.start))
        assert distance / (agent.t1 - agent.t0) < 25.0  # m/s, no car flies
    if "us101" in folder:  # cars stay on the lanes
        for recording in found[:3]:
            centres = np.concatenate([lane.centre for lane in recording.lanes])
            x = np.concatenate([track.x for track in recording.tracks])
            y = np.concatenate([track.y for track in recording.tracks])
            apart = np.hypot(x[:, None] - centres[:, 0], y[:, None] - centres[:, 1])
            assert np.mean(apart.min(axis=1) < 6.0) > 0.95


@pytest.mark.dataset
def test_recorded_states_are_those_of_the_file(data_dir):
    path = data_dir / "ngsim_urban_commonroad" / "xml" / "USA_Peach-4_4_T-1.xml"
    recording, root = only(path), ElementTree.parse(path).getroot()
    for element, track in zip(
        root.iterfind("dynamicObstacle"), recording.tracks, strict=True
    ):
        x = [float(node.text) for node in element.iter("x")]
        speed = [float(node.text) for node in element.iterfind(".//velocity/exact")]
        np.testing.assert_array_equal(track.x, x)
        np.testing.assert_array_equal(track.speed, speed)
    limits = {lane.speed_limit for lane in recording.lanes}
    assert limits <= {None, 11.176, 13.4112, 15.6464}
