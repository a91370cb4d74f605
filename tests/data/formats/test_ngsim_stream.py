"""Long NGSIM files in pieces: the scenes of the file read at once."""

import numpy as np
import pytest

from rcirl_jax.data.formats import parts, read_part
from rcirl_jax.data.importing import digest, scenes_of
from rcirl_jax.data.readers.tables import streams
from tests.data.formats import writers as w
from tests.data.formats.test_csv_stream import assert_same_scenes, scenes_by_name
from tests.data.small_logs import CONFIG

LANE_FT = 12.0
BEGIN = {"us-101": (1118846979700.0, 1118850579700.0), "i-80": (1113433135300.0,)}


def vehicle(number, first, stamp, count=400):
    """Rows of one vehicle in feet: its speed sways, some change lanes."""
    k = np.arange(count)
    speed = (12.0 + 2.0 * np.sin(0.03 * k + number)) / w.FOOT
    y = 50.0 + np.cumsum(speed) * 0.1
    lane = np.full(count, 1 + number % 3)
    if number % 4 == 0:
        lane[count // 2 :] = 1 + (number + 1) % 3
    x = np.convolve(np.pad(LANE_FT * (lane - 0.5), 20, "edge"), np.full(41, 1 / 41))
    x = x[40 : 40 + count] + 0.01 * (number % 7)
    length = 0.0 if number % 5 == 0 else 15.0
    return [
        [
            *(number, first + i, count, stamp + 100.0 * (first + i)),
            *(round(x[i], 3), round(y[i], 3), 0, 0),
            *(length, 6.0, 2, round(speed[i], 3), 0, int(lane[i]), 0, 0, 0, 0),
        ]
        for i in range(count)
        if not (number == 3 and 150 <= i < 180)  # unseen for three seconds
    ]


def portal(cars=12):
    """Rows and sites: vehicle and frame numbers start anew in each period."""
    rows, sites = [], []
    for site, periods in BEGIN.items():
        for stamp in periods:
            own = [r for n in range(cars) for r in vehicle(n, 60 * n, stamp)]
            rows += own + own[5:8]
            sites += [site] * (len(own) + 3)
    crossing = vehicle(1, 0, 1.2e12, 40)
    return rows + crossing, sites + ["Lankershim"] * len(crossing)


def write(path, shuffled=False):
    path.parent.mkdir(exist_ok=True)
    rows, sites = portal()
    sites[0] = "US-101 "  # names differ in case and blanks
    if shuffled:
        order = np.random.default_rng(2).permutation(len(rows))
        rows, sites = [rows[k] for k in order], [sites[k] for k in order]
    return w.ngsim_csv(path, rows, sites=sites)


def read(path, long_bytes=None, **options):
    _, spec = parts("ngsim", path)
    spec = {**spec, **options}
    if long_bytes is not None:
        spec = {**spec, "long_bytes": long_bytes}
    return list(read_part("ngsim", path, spec))


@pytest.mark.parametrize("shuffled", [False, True], ids=["sorted", "shuffled"])
def test_pieces_hold_the_scenes_of_the_whole(tmp_path, shuffled):
    path = write(tmp_path / "portal.csv", shuffled)
    wholes, pieces = read(path), read(path, 1)
    assert {made.piece_of for made in pieces} == {made.name for made in wholes}
    assert pieces[0].name == "portal-i-80-00000"
    for name in ("portal-i-80", "portal-us-101"):
        (whole,) = [made for made in wholes if made.name == name]
        own = [made for made in pieces if made.piece_of == name]
        assert own[0].notes == whole.notes
        assert not any(made.notes for made in own[1:])
        for made in own:
            for lane, other in zip(made.lanes, whole.lanes, strict=True):
                np.testing.assert_array_equal(lane.centre, other.centre)
                np.testing.assert_array_equal(lane.left_width, other.left_width)
        one, apart = (
            scenes_by_name([scenes_of(made, CONFIG.collect) for made in group])
            for group in ([whole], own)
        )
        assert len(one) > 100
        assert any("#" in vehicle for vehicle, _ in one)
        assert_same_scenes(apart, one)


def test_notes_name_what_is_left_out_and_repeated(tmp_path):
    first = read(write(tmp_path / "portal.csv"), 1)[0]
    assert first.notes == (
        "left out, no freeway: lankershim",
        "3 vehicles without length; default by class",
        "3 rows met twice, used once",
    )


def test_pieces_of_the_native_text_are_those_of_the_csv(tmp_path, monkeypatch):
    monkeypatch.setattr(streams, "READ_CHARS", 10_000)
    rows = [r for n in range(12) for r in vehicle(n, 60 * n, BEGIN["i-80"][0])]
    texts = read(w.ngsim_text(tmp_path / "native.txt", rows), 1)
    tables = read(w.ngsim_csv(tmp_path / "native.csv", rows), 1)
    assert [made.name for made in texts] == [f"native-0000{k}" for k in range(3)]
    assert [digest(made) for made in texts] == [digest(made) for made in tables]
