"""The generic CSV importer: mapping, units, lanes, malformed tables."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rcirl_jax.data.quality import assumed
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind
from tests.data.formats import people
from tests.data.formats import writers as w
from tests.data.formats.people import only, read
from tests.helpers.logs import lanes_of

COLUMNS = ("t", "id", "x", "y", "speed", "length", "width", "lane")


def cars():
    """Rows of three cars in lanes of their own."""
    return [
        [k / 10, f"car{n}", 10.0 * n + 1.5 * k, -3.5 * n, 15.0, 4.5, 1.8, f"lane{n}"]
        for n in range(3)
        for k in range(40)
    ]


def log(folder, rows=None, header=COLUMNS):
    return w.table(folder / "log.csv", header, cars() if rows is None else rows)


def spec(folder, columns=COLUMNS, **options):
    return people.spec(folder, columns, **options)


def test_a_column_of_lanes_becomes_lanes(tmp_path):
    recording = only(log(tmp_path), spec(tmp_path))
    assert recording.group is None
    lane = lanes_of(recording)["lane1"]
    assert (lane.left, lane.right) == ("lane0", "lane2")
    np.testing.assert_allclose(lane.centre[:, 1], -3.5)


KNOTS = (("mph", 0.44704), ("ft/s", 0.3048), ("kn", 1852 / 3600))
CLOCKS = (
    *(("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9), ("frame", 0.1)),
    *(("min", 60.0), ("h", 3600.0), ("day", 86400.0)),
)


@given(
    length=st.sampled_from([("m", 1.0), ("ft", 0.3048)]),
    speed=st.sampled_from([("m/s", 1.0), ("km/h", 1 / 3.6), *KNOTS]),
    clock=st.sampled_from(CLOCKS),
    angle=st.sampled_from([("rad", 1.0), ("deg", np.pi / 180)]),
    origin=st.sampled_from([0.0, 1.6e9]),
)
def test_units(tmp_path_factory, length, speed, clock, angle, origin):
    """Every unit, and clocks since 1970, give the same recording in SI."""
    folder = tmp_path_factory.mktemp("units")
    rows = []
    for t, name, x, y, v, *box, lane in cars():
        k = round(t / 0.1)
        time = origin + k if clock[0] == "frame" else (origin + 0.1 * k) / clock[1]
        x, y, *box = (value / length[1] for value in (x, y, *box))
        rows.append([time, name, x, y, v / speed[1], *box, lane, 0.02 / angle[1]])
    units = [f'{field} = "{length[0]}"' for field in ("x", "y", "length", "width")]
    units += [f't = "{clock[0]}"', f'speed = "{speed[0]}"', f'heading = "{angle[0]}"']
    columns = (*COLUMNS, "heading")
    source = spec(folder, columns=columns, units="\n".join(units))
    track = only(log(folder, rows, columns), source).tracks[2]
    # a float64 clock since 1970 in ms resolves 0.2 us
    np.testing.assert_allclose(track.t, 0.1 * np.arange(40), atol=1e-6)
    np.testing.assert_allclose(track.x, 20.0 + 1.5 * np.arange(40))
    np.testing.assert_allclose(track.speed, 15.0)
    np.testing.assert_allclose(track.heading, 0.02)
    assert track.length == pytest.approx(4.5)


def test_heading_and_speed_from_positions(tmp_path):
    """A circle driven counter-clockwise: tangent and arc speed, then a stop."""
    t = 0.1 * np.arange(100)
    angle = np.minimum(0.3 * t, 1.5)  # rad; stands from t = 5 s
    x, y = 50.0 * np.cos(angle), 50.0 * np.sin(angle)
    rows = [[*row, "c"] for row in zip(t.round(3), x, y, strict=True)]
    header = ("t", "x", "y", "id")
    source = spec(tmp_path, columns=header)
    (track,) = only(log(tmp_path, rows, header), source).tracks
    np.testing.assert_allclose(track.speed[5:45], 15.0, rtol=0.01)
    np.testing.assert_allclose(track.heading[6:44], angle[6:44] + np.pi / 2, atol=0.01)
    np.testing.assert_allclose(track.heading[60:], 1.5 + np.pi / 2, atol=0.08)
    np.testing.assert_allclose(track.speed[60:], 0.0, atol=1e-9)


@pytest.mark.parametrize(("point", "shift"), [("front", -2.25), ("rear", 2.25)])
def test_reference_point_turned_axis_and_named_kinds(tmp_path, point, shift):
    rows = [[*r[:3], -r[3], "PKW", 4.5] for r in cars()]
    header = ("t", "id", "x", "right", "type", "length")
    columns = {"t": "t", "id": "id", "x": "x", "y": "-right", "kind": "type"}
    more = f'reference_point = "{point}"'
    source = spec(tmp_path, columns, rest='PKW = "vehicle"', more=more)
    track = only(log(tmp_path, rows, header), source).tracks[2]
    np.testing.assert_allclose(track.y, -7.0)
    assert track.x[0] == pytest.approx(20.0 + shift)
    assert track.kind == Kind.VEHICLE


def test_sizes_and_widths_that_no_cell_says_are_counted(tmp_path):
    """No column has them, or a cell here and there."""
    header, rows = people.HEADER, people.rows()
    bare = people.write(tmp_path, [row[:4] for row in rows], header[:4])
    made = only(bare, spec(tmp_path, header[:4]))
    lanes = len(made.lanes)
    assert tuple(assumed(made).values()) == (lanes, lanes, people.CARS)
    table = people.column(rows, "length", lambda _: "")
    table[0][header.index("length")] = 4.5  # of car0, whose width nobody says
    source = spec(tmp_path, header, more="speed_limit = 13.9\n")
    made = only(people.write(tmp_path, table), source)
    assert tuple(assumed(made).values()) == (0, len(made.lanes), people.CARS)
    assert [track.length for track in made.tracks] == [4.5] * people.CARS
    header = (*header, "width")
    table = [[*row, 1.9 if row[1] != "car0" else ""] for row in rows]
    made = only(people.write(tmp_path, table, header), spec(tmp_path, header))
    assert assumed(made)["size"] == 1


def test_oncoming_lanes_run_the_other_way(tmp_path):
    rows = cars()
    for row in rows:
        if row[1] == "car0":
            row[2] = 60.0 - row[2]
    lanes = only(log(tmp_path, rows), spec(tmp_path)).lanes
    first, second, _ = lanes
    assert first.centre[0, 0] > first.centre[-1, 0]
    assert (first.left, first.right, second.left) == (None, None, None)
    # bounds of lanes that are not neighbours lie half a lane out
    assert first.left_width[0] == pytest.approx(1.75)


LANES = """
[[lanes]]
id = "1"
points = [[0.0, 0.0], [90.0, 0.0]]
width = 3.0
speed_limit = 13.9
right = "2"
[[lanes]]
id = "2"
points = [[0.0, -3.5], [90.0, -3.5]]
"""


def test_lanes_of_the_mapping_and_of_a_file(tmp_path):
    source = spec(tmp_path, rest=LANES)
    first, second = only(log(tmp_path), source).lanes
    assert (first.speed_limit, first.right, second.speed_limit) == (13.9, "2", None)
    np.testing.assert_array_equal(first.left_width, [1.5, 1.5])
    header = ("id", "x", "y", "width", "speed_limit", "successor")
    rows = [("a", 0, 0, 3, 10, "b"), ("a", 50, 0, 4, 10, "b"), ("b", 50, 0, 3, 9, "")]
    w.table(tmp_path / "lanes.csv", header, [*rows, ("b", 90, 5, 3, 9, "")])
    source = spec(tmp_path, rest='[lanes]\nfile = "lanes.csv"\n')
    first, second = only(tmp_path, source).lanes
    np.testing.assert_array_equal(first.left_width, [1.5, 2.0])
    assert (first.successors, second.speed_limit) == (("b",), 9.0)


def test_buses_are_no_feet(tmp_path):
    """Two of three are 12 m long, or all of two; three of three would be feet."""
    rows, source = cars(), spec(tmp_path)
    for row in rows:
        row[5] = 4.5 if row[1] == "car0" else 12.0
    found = only(log(tmp_path, rows), source)
    assert [track.length for track in found.tracks] == [4.5, 12.0, 12.0]
    found = only(log(tmp_path, [row for row in rows if row[1] != "car0"]), source)
    assert [track.length for track in found.tracks] == [12.0, 12.0]


SI_COLUMNS = {
    **{"t": "Global_Time", "id": "Vehicle_ID", "x": "Local_Y", "y": "-Local_X"},
    **{"speed": "v_Vel", "length": "v_length", "lane": "Lane_ID"},
    "recording": "Location",
}


@pytest.mark.dataset
def test_recorded_ngsim_subset_in_si(data_dir, tmp_path):
    path = data_dir / "formats" / "ngsim_reference" / "ngsim_us101_subset_SIunits.csv"
    more = 'reference_point = "front"'
    source = spec(tmp_path, SI_COLUMNS, units='t = "ms"', more=more)
    found = {recording.name[-5:]: recording for recording in read(path, source)}
    assert len(found) == 2
    tracks = [track for recording in found.values() for track in recording.tracks]
    assert len({track.id.split("#")[0] for track in tracks}) == 9
    assert sum(track.t.size for track in tracks) == 4366
    for recording in found.values():
        assert {lane.id for lane in recording.lanes} <= {"2", "3"}
        for track in recording.tracks:
            if track.t.size > 20:
                assert np.median(np.abs(track.heading)) < 0.1


def test_vehicles_that_have_no_rows_are_told(tmp_path):
    """In the recording that is named, or in all, less the local origin."""
    rest = "[[missing]]\ntime = [1.0, 9.0]\nx = [10.0, 90.0]\ny = [0.0, 5.0]\n"
    (found,) = only(log(tmp_path), spec(tmp_path, rest=rest)).missing_agents
    assert (found.t0, found.t1, found.start, found.end) == (
        *(1.0, 9.0),
        *((10.0, 0.0), (90.0, 5.0)),
    )
    other = spec(tmp_path, rest=rest + 'recording = "another"\n')
    assert only(log(tmp_path), other).missing_agents == ()
    short = spec(tmp_path, rest="[[missing]]\ntime = [1.0, 9.0]\n")
    with pytest.raises(InputError, match=r"source TOML: missing: .*x: missing"):
        only(log(tmp_path), short)
