"""What is wrong with a data set's table is one line: file, row, field and value."""

import pytest

from tests.data.formats.fixtures import format_of, modules
from tests.data.formats.writers import strict
from tests.helpers.logs import read, refused

CAR = "1,1,100,car,"
# fixture -> (end of a file's name, text in it, what stands there instead, the words)
WRONG = {
    "levelx_highd": [
        ("_tracks.csv", "xVelocity", "vx", "column xVelocity: missing"),
        ("_tracks.csv", "frame,id", "frame,frame", "column frame: met twice"),
        ("_tracks.csv", "\n1,1,", "\n1,77,", "track 77: no row in 01_tracksMeta.csv"),
        ("_tracks.csv", "\n1,1,", "\nx,1,", "line 2: frame: 'x': expected a finite"),
        ("_tracks.csv", "\n1,1,", "\n2,1,", "line 3: id 1: met twice in one frame"),
        ("_tracks.csv", "\n1,1,2.58", "\n1,1,nan", "line 2: x: 'nan'"),
        ("_tracks.csv", "\n1,1,2.58", "\n1,1,9e7", "x: 9e+07 m, the median is "),
        ("_tracks.csv", "\n1,1,2.58", "\n1,1", "line 2: 24 cells: expected 25"),
        ("_tracksMeta.csv", "class", "type", "column class: missing"),
        ("_tracksMeta.csv", None, None, "input: missing: expected it beside 01_tracks"),
        ("_recordingMeta.csv", "frameRate", "rate", "column frameRate: missing"),
        ("_recordingMeta.csv", "1,25,", "1,0,", "frameRate: 0: expected 1 to 1000"),
        ("_recordingMeta.csv", "1,25,2", "1,25", "14 cells: expected 15"),
        ("_recordingMeta.csv", ",-1.00,", ",fast,", "speedLimit: 'fast': expected a"),
        ("_recordingMeta.csv", None, None, "input: missing: expected it beside 01_"),
        *[
            ("_recordingMeta.csv", "8.51;12.59;16.43", marks, "upperLaneMarkings: '")
            for marks in ("8.51", "8.51;x", "12.59;8.51", "", "8.51;8.51", "nan;1")
        ],
    ],
    "ngsim": [
        (
            *("0415.txt", "18.0 20.0", "18.0 1e12"),
            "line 1: Local_Y: 1e+12: expected within 1e+08",
        )
    ],
    "levelx": [
        ("_recordingMeta.csv", "xUtmOrigin", "xOrigin", "column xUtmOrigin: missing"),
        ("_tracksMeta.csv", "0,299,300", "1,300,300", "0: initialFrame: 0: expected 1"),
        ("_tracksMeta.csv", "0,299,300", "0,300,300", "0: finalFrame: 299: expected 3"),
        ("_tracksMeta.csv", "0,299,300", "0,299,299", "0: numFrames: 300: expected 29"),
    ],
    "interaction": [
        ("vehicle_tracks_000.csv", "timestamp_ms", "time", "column timestamp_ms: mis"),
        ("vehicle_tracks_000.csv", f"{CAR}1005.000", CAR, "line 2: x: ''"),
        ("vehicle_tracks_000.csv", CAR, "1,1,,car,", "line 2: timestamp_ms: ''"),
        ("vehicle_tracks_000.csv", f"{CAR}1005.000", f"{CAR}west", "line 2: x: 'west'"),
        ("vehicle_tracks_000.csv", CAR, "1,1,200,car,", "line 3: id 1: met twice in"),
        (".osm_xy", "x='", "x='east", "position: ('east1160.0000', '1003.5000'): exp"),
    ],
    "interaction_challenge": [
        ("_train.csv", "\n1.0,", "\n,", "line 2: case_id: '': expected a finite")
    ],
    "ngsim_pairs": [
        ("_00046.csv", "x_leader", "leader", "column x_leader: missing"),
        ("_00046.csv", "\n293.3,", "\n293.2,", "line 3: id 1032: met twice in one"),
        ("_00046.csv", ",14.3,", ",,", "line 2: leader_length: ''"),
        ("_00046.csv", ",55.7", ",75.7", "line 2: spacing: 75.7: expected 55.7, x_l"),
    ],
    "openacc": [
        ("1.csv", "\nTime,", "\nClock,", "column Time: missing"),
        ("1.csv", "Speed1", "Speed2", "column Speed2: met twice"),
        ("1.csv", "\n0.1,", "\nsoon,", "line 8: Time: 'soon'"),
        ("1.csv", "\n0.1,", "\n0.0,", "line 8: id of the row: met twice in one frame"),
        ("1.csv", "\n0.1,14", "\n0.1,fast14", "line 8: Speed1: 'fast14"),
        ("1.csv", "\n0.1,14", "\n0.1,20000", "Speed1: 20001: expected within 10000"),
        (
            *("1.csv", "\nTime", "\nVehicle_length,long\nTime"),
            "vehicle_length: 'long': expected a number of metres",
        ),
    ],
}


@pytest.mark.parametrize(
    ("name", "ending", "old", "new", "words"),
    [(name, *case) for name, cases in WRONG.items() for case in cases],
)
def test_a_wrong_table_is_one_line(tmp_path, name, ending, old, new, words):
    form = format_of(name)
    (tmp_path / "log").mkdir()
    modules()[name].write(tmp_path / "log")
    (path,) = (tmp_path / "log").rglob(f"*{ending}")
    text = path.read_text()
    if old is None:
        path.unlink()
    else:
        assert old in text
        path.write_text(text.replace(old, new, 1))
    source = None if form == "levelx" else strict(tmp_path / "strict.toml", form)
    line = refused(read, form, tmp_path / "log", source)
    assert words in line
    assert path.name in line or "01_tracks.csv: track" in line
