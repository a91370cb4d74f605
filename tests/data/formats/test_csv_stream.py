"""Long CSV files in pieces: the scenes of a file read at once, in bounded memory."""

import fcntl

import numpy as np
import pytest

from rcirl_jax.data.formats import parts, read_part
from rcirl_jax.data.importing import import_logs, scenes_of
from rcirl_jax.data.inputs import InputFile
from rcirl_jax.data.readers import long_logs
from rcirl_jax.data.store.dataset import open_dataset
from tests.data.small_logs import CONFIG
from tests.helpers.commands import count_and_peak

LANES = [{"id": "a", "points": [[-50.0, 0.0], [1800.0, 0.0]], "width": 4.0}]


def rows_of(by_car=False, seconds=200.0, cars=24):
    """Cars that enter a straight road one after the other; (t, id, x, y)."""
    t = np.arange(0.0, seconds, 0.1)
    found = []
    for car in range(cars):
        begin = 8.0 * car
        own = t[(t >= begin) & (t < begin + 70.0)]
        phase = np.random.default_rng(car).uniform(0.0, 6.0)
        speed = 11.0 + 2.0 * np.sin(0.35 * own + phase)
        x = np.cumsum(speed) * 0.1
        y = 0.4 * np.sin(x / 25.0)
        part = np.stack([own, np.full(own.shape, car), x, y], axis=1)
        if car % 3 == 0:  # unseen for three seconds, another fragment
            part = part[(own < begin + 40.0) | (own > begin + 43.0)]
        found.append(part)
    rows = np.concatenate(found)
    # by car each minute is met again and again
    return rows if by_car else rows[np.lexsort((rows[:, 1], rows[:, 0]))]


def write(path, rows):
    lines = ["t,id,x,y"] + [f"{t:.1f},c{i:.0f},{x:.3f},{y:.3f}" for t, i, x, y in rows]
    path.write_text("\n".join(lines) + "\n")
    _, spec = parts("csv", path)
    return {**spec, "lanes": LANES}


def cuts(path, spec):
    return [scenes_of(made, CONFIG.collect) for made in read_part("csv", path, spec)]


def scenes_by_name(found):
    scenes = {}
    for made in found:
        for row, name in enumerate(made.vehicles):
            key = (name, int(made.scenes.frame[row]))
            assert key not in scenes, "one scene twice"
            scenes[key] = (made.scenes, row)
    return scenes


def assert_same_scenes(apart, whole, leaves=("s", "v", "a"), atol=2e-2):
    assert set(apart) == set(whole)
    for key, (scenes, row) in apart.items():
        other, at = whole[key]
        for leaf in leaves:
            own, same = getattr(scenes.human, leaf)[row], getattr(other.human, leaf)[at]
            np.testing.assert_allclose(own, same, atol=atol)
        np.testing.assert_array_equal(scenes.decisions[row], other.decisions[at])


@pytest.mark.parametrize("by_car", [False, True], ids=["by time", "by car"])
def test_pieces_hold_the_scenes_of_the_whole(tmp_path, by_car):
    path = tmp_path / "log.csv"
    spec = write(path, rows_of(by_car))
    (one,) = cuts(path, spec)
    pieces = cuts(path, {**spec, "long_bytes": 1})
    assert [made.name for made in pieces] == [f"log-{k:05d}" for k in range(4)]
    whole, apart = scenes_by_name([one]), scenes_by_name(pieces)
    assert len(whole) > 500
    assert_same_scenes(apart, whole)
    assert any("#2" in name for name, _ in whole)
    for count in ("tracks", "states"):
        assert sum(made.quality[count] for made in pieces) == one.quality[count]
    for reason in ("future_too_short", "off_map"):
        found = sum(made.quality["dropped"].get(reason, 0) for made in pieces)
        assert found == one.quality["dropped"].get(reason, 0)
    for key, (scenes, row) in apart.items():
        other, at = whole[key]
        np.testing.assert_allclose(
            scenes.scene.path.l[row], other.scene.path.l[at], atol=1e-3
        )


def test_a_crowded_minute_is_several_pieces(tmp_path, monkeypatch):
    """The scenes held do not grow with the traffic; they are the same.

    The last minute ends early: windows of it are empty, and no pieces.
    """
    path = tmp_path / "log.csv"
    spec = {**write(path, rows_of(seconds=135.0)), "long_bytes": 1}
    minutes = cuts(path, spec)
    monkeypatch.setattr(long_logs, "MAX_ROWS", 500)
    windows = cuts(path, spec)
    names = [made.name for made in windows]
    assert "log-00001.00" in names
    assert "log-00001.02" in names
    assert len(names) == len(set(names)) > 2 * len(minutes)
    whole, apart = scenes_by_name(minutes), scenes_by_name(windows)
    assert_same_scenes(apart, whole, ("s", "l", "v"), 0.05)
    most = max(made.scenes.vehicle.size for made in windows if made.scenes is not None)
    assert most < 0.6 * max(made.scenes.vehicle.size for made in minutes)
    assert [made.progress for made in windows] == sorted(m.progress for m in windows)


def test_a_vehicle_is_in_one_group_whatever_the_piece(tmp_path):
    path = tmp_path / "log.csv"
    spec = {**write(path, rows_of()), "long_bytes": 1}
    part = InputFile(format="csv", input=path, spec=spec)
    import_logs([part], tmp_path / "data", CONFIG)
    dataset = open_dataset(tmp_path / "data")
    train, test = dataset.load("train"), dataset.load("test")
    assert not set(train.vehicle.tolist()) & set(test.vehicle.tolist())
    names = dataset.manifest.vehicles
    assert len({name.split(":")[1] for name in names}) == len(names)
    whole = InputFile(format="csv", input=path, spec={**spec, "long_bytes": 10**9})
    import_logs([whole], tmp_path / "whole", CONFIG)
    assert set(open_dataset(tmp_path / "whole").manifest.vehicles) == set(names)


def test_recordings_of_one_file_stay_apart(tmp_path):
    path = tmp_path / "log.csv"
    rows = rows_of(seconds=90.0, cars=6)
    text = ["t,id,x,y,drive"]
    for drive, t0 in (("b", 5e8), ("a", 0.0)):
        text += [f"{t + t0:.1f},c{i:.0f},{x:.3f},0,{drive}" for t, i, x, _ in rows]
    path.write_text("\n".join(text) + "\n")
    _, spec = parts("csv", path)
    columns = {**spec["columns"], "recording": "drive"}
    spec = {**spec, "columns": columns, "lanes": LANES, "long_bytes": 1}
    found = list(read_part("csv", path, spec))
    assert [made.name for made in found] == [
        f"log-{drive}-{k:05d}" for drive in "ba" for k in range(2)
    ]
    for made in found:
        assert made.piece_of == made.name[:5]
        assert made.scenes_within == pytest.approx(
            (60.0 * int(made.name[-1]), 60.0 * int(made.name[-1]) + 60.0), abs=30.0
        )


MEMORY = """
import resource, sys
from pathlib import Path
from rcirl_jax.data.inputs import InputFile
from rcirl_jax.data.formats import parts
from rcirl_jax.data.readers import long_logs
from rcirl_jax.data.readers.tables import streams
from rcirl_jax.data.readers.tables.rows import RowStats
from rcirl_jax.data.readers.tables.table import fields_of, open_table
# what is held is reached in the shorter log already
streams.READ_CHARS, long_logs.BUFFER_BYTES = 2**18, 2**20
path = Path(sys.argv[1])
table, stats = open_table(path), RowStats(path=path)
fields = fields_of(table, {"t": "time", "id": "text", "x": "place", "y": "place"})
with long_logs.rows_of(table, fields, stats, is_long=True) as spill:
    rows = sum(len(piece.values["t"]) for piece in spill.slices(None, 0.55))
print(rows, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def test_scratch_files_of_killed_imports_are_removed(tmp_path, monkeypatch):
    monkeypatch.setattr(long_logs.tempfile, "tempdir", str(tmp_path))
    left, used = (tmp_path / f"{long_logs.SCRATCH}{name}" for name in "ab")
    for folder in (left, used):
        folder.mkdir()
        (folder / long_logs.LOCK).touch()
        (folder / "0_0").write_bytes(b"rows")
    with (used / long_logs.LOCK).open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # by an import that still runs
        with long_logs.scratch() as own:
            assert own.parent == tmp_path
            assert not left.exists()
            assert (used / "0_0").exists()
    assert not own.exists()


@pytest.mark.slow
def test_memory_does_not_grow_with_the_file(tmp_path):
    """Ten times the minutes, nearly the same peak."""
    peaks = []
    for minutes in (10, 100):
        path = tmp_path / f"{minutes}.csv"
        with path.open("w") as file:
            file.write("t,id,x,y\n")
            for frame in range(minutes * 600):
                file.writelines(
                    f"{frame * 0.1:.1f},c{frame // 600}-{car},{frame * 0.5},{car}\n"
                    for car in range(80)
                )
        rows, peak = count_and_peak(MEMORY, path)
        assert rows >= minutes * 600 * 80
        peaks.append(peak)
    assert peaks[1] < 1.3 * peaks[0]


def test_a_recording_is_on_one_side_where_there_are_several(tmp_path):
    """Minutes of it are groups of their own, and share traffic at their borders."""
    found = []
    for name in ("one", "two", "three"):
        path = tmp_path / f"{name}.csv"
        spec = write(path, rows_of(seconds=140.0, cars=12))
        found.append(InputFile(format="csv", input=path, spec=spec))
    import_logs(found, tmp_path / "data", CONFIG)
    dataset = open_dataset(tmp_path / "data")
    assert len(dataset.manifest.groups) > 3
    train, test = (set(dataset.load(x).recording.tolist()) for x in ("train", "test"))
    assert len(train) == 2
    assert len(test) == 1
    assert not train & test
