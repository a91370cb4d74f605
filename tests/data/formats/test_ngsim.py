"""NGSIM: native text and portal CSV, with and without lateral positions."""

import functools
import time

import numpy as np
import pytest

from rcirl_jax.data.importing import digest
from tests.data.formats import writers as w
from tests.data.formats.fixtures import has_note
from tests.helpers import logs

read = functools.partial(logs.read, "ngsim")
only = functools.partial(logs.only, "ngsim")

LANE_M = 3.6576  # m, 12 ft


def lanes_at(folder, places):
    """Lanes of one car on each, at its Local_X [ft]."""
    rows = [
        row
        for lane, x in places.items()
        for row in w.ngsim_rows(vehicle=lane, lane=lane, local_x=x)
    ]
    return only(w.ngsim_text(folder / "a.txt", rows)).lanes


def test_lanes_are_numbered_from_the_left(tmp_path):
    first, second, third = lanes_at(tmp_path, {1: 6.0, 2: 18.0, 3: 30.0})
    assert (first.left, first.right, first.id) == (None, "2", "1")
    assert (second.left, second.right) == ("1", "3")
    assert (third.left, third.right) == ("2", None)
    np.testing.assert_allclose(second.centre[:, 1], -1.5 * LANE_M)
    np.testing.assert_allclose(second.left_width, 0.5 * LANE_M)
    fronts = np.array([row[5] for row in w.ngsim_rows()]) * w.FOOT
    assert second.centre[0, 0] == pytest.approx(fronts.min() - 50.0)
    assert second.centre[-1, 0] == pytest.approx(fronts.max() + 50.0)
    assert second.speed_limit == 29.06
    # bounds lie midway between unequal lanes; ramps at one place are no neighbours
    _, middle, last = lanes_at(tmp_path, {1: 6.0, 2: 18.0, 3: 31.0})
    np.testing.assert_allclose(middle.left_width, 6.0 * w.FOOT)
    np.testing.assert_allclose(middle.right_width, 6.5 * w.FOOT)
    np.testing.assert_allclose(last.left_width, 6.5 * w.FOOT)
    np.testing.assert_allclose(last.right_width, 0.5 * LANE_M)
    lanes = lanes_at(tmp_path, {1: 6.0, 7: 78.0, 8: 79.0})
    assert all(lane.left is None and lane.right is None for lane in lanes)


def test_lateral_position_from_the_lane_number(tmp_path):
    lane = np.where(np.arange(120) < 60, 2, 3)
    rows = w.ngsim_rows(count=120, lane=lane, local_x=0, length=0)
    recording = only(w.ngsim_text(tmp_path / "a.txt", rows))
    (track,) = recording.tracks
    assert (track.length, track.width) == (4.5, 6 * w.FOOT)
    u = np.clip((np.arange(120) - 59.5) / 40.0 + 0.5, 0.0, 1.0)
    expected = -LANE_M * (1.5 + 3.0 * u**2 - 2.0 * u**3)
    np.testing.assert_allclose(track.y, expected, atol=1e-9)
    assert has_note(recording, "lateral")
    assert has_note(recording, "length")
    # half a lane at the switch, which takes four seconds
    assert np.mean(track.y[59:61]) == pytest.approx(-2.0 * LANE_M)
    np.testing.assert_allclose(track.y[:40], -1.5 * LANE_M)
    np.testing.assert_allclose(track.y[80:], -2.5 * LANE_M)


def test_csv_is_the_same_as_text(tmp_path):
    """Its columns in any order and case; also numbers as spreadsheets write them."""
    rows = w.ngsim_rows() + w.ngsim_rows(vehicle=2, local_x=30.0, lane=3)
    text = digest(only(w.ngsim_text(tmp_path / "a.txt", rows)))
    order = np.random.default_rng(0).permutation(len(w.NGSIM_COLUMNS))
    columns = [w.NGSIM_COLUMNS[i].upper() for i in order]
    shuffled = [[row[i] for i in order] for row in rows]
    table = w.ngsim_csv(tmp_path / "a.csv", shuffled, columns=columns)
    assert digest(only(table)) == text
    # the interface of the portal gives what was asked for; 0 is the class of nobody
    kept = (0, 1, 5, 11, 13)
    columns = [w.NGSIM_COLUMNS[i] for i in kept]
    rows = [[row[i] for i in kept] for row in w.ngsim_rows()]
    (track,) = only(w.ngsim_csv(tmp_path / "a.csv", rows, columns=columns)).tracks
    assert (track.length, track.width) == (4.5, 1.8)


def stamped(rows, begin=8e11):
    """Rows with Global_Time: 100 ms a frame."""
    return [[*row[:3], begin + 100 * row[1], *row[4:]] for row in rows]


def test_portal_sites_and_periods(tmp_path):
    """Vehicle and frame numbers start anew in each period and at each site."""
    begins = (9e11, 8e11, 7e11, 6e11)
    rows = [row for begin in begins for row in stamped(w.ngsim_rows(), begin)]
    sites = ["us-101"] * 80 + ["i-80"] * 40 + ["lankershim"] * 40
    found = read(w.ngsim_csv(tmp_path / "all.csv", rows, sites=sites))
    assert [recording.name for recording in found] == ["all-i-80", "all-us-101"]
    assert [len(recording.tracks) for recording in found] == [1, 2]
    assert all("lankershim" in recording.notes[0] for recording in found)


def periods():
    """Two periods an hour apart with the same vehicle and frame numbers."""
    rows = []
    for begin in (8e11, 8e11 + 3.6e6):
        for vehicle in (1, 2, 3):
            own = w.ngsim_rows(vehicle=vehicle, local_x=12.0 * vehicle)
            rows += stamped(own[:20] + own[23:], begin)
    return rows


def test_release_with_every_log_twice(tmp_path):
    """Text and CSV of one name are one log; other tables are none."""
    for site, period in (("us-101", "0750am-0805am"), ("i-80", "0400-0415")):
        folder = tmp_path / site / "vehicle-trajectory-data" / period
        folder.mkdir(parents=True)
        w.ngsim_text(folder / f"trajectories-{period}.txt", w.ngsim_rows())
        w.ngsim_csv(folder / f"trajectories-{period}.csv", w.ngsim_rows())
        detectors = tmp_path / site / "detector-data"
        detectors.mkdir()
        (detectors / "detectors.csv").write_text("station,flow\n1,2\n")
        (detectors / "readme.txt").write_text("see the report\n")
    found = [recording.name for recording in read(tmp_path)]
    assert found == ["trajectories-0400-0415", "trajectories-0750am-0805am"]


@pytest.mark.parametrize("writer", [w.ngsim_text, w.ngsim_csv])
def test_arterials_without_a_location(tmp_path, writer):
    """Lankershim's and Peachtree's own files: 24 columns, no straight lanes."""
    rows = [[*row[:14], *(102, 205, 2, 3, 2, 1), *row[14:]] for row in w.ngsim_rows()]
    zones = ("O_Zone", "D_Zone", "Int_ID", "Section_ID", "Direction", "Movement")
    columns = (*w.NGSIM_COLUMNS[:14], *zones, *w.NGSIM_COLUMNS[14:])
    options = {"columns": columns} if writer is w.ngsim_csv else {}
    path = writer(tmp_path / "trajectories.dat", rows, **options)
    assert "arterials have no straight lanes" in logs.refused(read, path)


@pytest.mark.parametrize("writer", [w.ngsim_text, w.ngsim_csv])
def test_stamped_rows_may_come_in_any_order(tmp_path, writer):
    rows = periods()
    rows += rows[7:9]  # repeated rows lie anywhere too
    (tmp_path / "shuffled").mkdir()
    order = np.random.default_rng(1).permutation(len(rows))
    whole = only(writer(tmp_path / "a.csv", rows))
    shuffled = only(writer(tmp_path / "shuffled" / "a.csv", [rows[k] for k in order]))
    assert digest(shuffled) == digest(whole)
    names = [f"{car}{piece}" for car in "123" for piece in ("", "#2", "#3", "#4")]
    assert [track.id for track in whole.tracks] == names
    assert whole.tracks[2].t[0] == 3600.0
    assert whole.start_s == pytest.approx(1e-3 * min(row[3] for row in rows))


@pytest.mark.dataset
def test_recorded_i80(data_dir):
    path = data_dir / "ngsim_i80_native" / "trajectories-0400-0410.txt"
    begin = time.process_time()
    recording = only(path)
    assert time.process_time() - begin < 4.0
    raw = np.loadtxt(path)
    assert len(recording.tracks) == 1382
    assert sum(track.t.size for track in recording.tracks) == len(raw) == 121396
    track = recording.tracks[0]
    rows = raw[raw[:, 0] == float(track.id)]
    np.testing.assert_allclose(track.x, rows[:, 5] * w.FOOT - 2.25)
    np.testing.assert_allclose(track.speed, rows[:, 11] * w.FOOT)
    assert [lane.id for lane in recording.lanes] == ["1", "2", "3", "4", "5", "6", "9"]
    assert has_note(recording, "lateral")
