"""Files cut from one stream: a vehicle that drives on is one, in one split."""

import numpy as np
import pytest

from rcirl_jax import import_logs, read_logs
from tests.helpers.driven_roads import crossing, highway


def stream(shift=0.0):
    """Rows t, id, x, y of cars that start every 1.4 s and drive for 40 s."""
    rows = []
    for car in range(60):
        for k in range(400):
            t = 1.4 * car + 0.1 * k
            s = 14.0 * 0.1 * k + 6.0 * np.sin(0.3 * 0.1 * k + car)
            rows.append((t, car, s + shift, 3.5 * (car % 2)))
    return rows


def written(folder, name, rows):
    lines = ["t,id,x,y"]
    lines += [f"{7000.0 + t:.1f},{i},{x:.2f},{y:.2f}" for t, i, x, y in rows]
    (folder / name).write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("order", ["ab", "ba"])
def test_a_stream_cut_into_two_files(tmp_path, order):
    """The second file may be named before the first."""
    names = dict(zip("ab", (f"{letter}.csv" for letter in order), strict=True))
    logs = tmp_path / "logs"
    logs.mkdir()
    rows = stream()
    written(logs, names["a"], [row for row in rows if row[0] < 60.0])
    written(logs, names["b"], [row for row in rows if row[0] >= 60.0])
    cut = {row[1] for row in rows if row[0] < 60.0}
    cut &= {row[1] for row in rows if row[0] >= 60.0}
    dataset = import_logs(logs, tmp_path / "data", format="csv", test_fraction=0.5)
    every, vehicles = dataset.load(None), dataset.manifest.vehicles
    where = {}
    for vehicle, recording in zip(every.vehicle, every.recording, strict=True):
        where.setdefault(int(vehicle), set()).add(int(recording))
    both = {
        vehicles[v].rpartition(":")[2] for v, seen in where.items() if len(seen) > 1
    }
    assert len(both) > 10
    assert both <= {str(car) for car in cut}
    sides = [set(dataset.load(split).vehicle.tolist()) for split in ("train", "test")]
    assert all(sides)
    assert not sides[0] & sides[1]
    # nobody who drives on is two vehicles
    bare = [vehicles[v].rpartition(":")[2] for v in where]
    assert sorted(set(bare)) == sorted(bare)
    said = dataset.manifest.import_flags["split_by"]
    assert f"{len(cut)} vehicles drive on from one recording to the next" in said


def test_ids_that_another_file_uses_again_are_others(tmp_path):
    """Cars of one id that are elsewhere then."""
    logs = tmp_path / "logs"
    logs.mkdir()
    written(logs, "a.csv", [row for row in stream() if row[0] < 60.0])
    written(logs, "b.csv", [row for row in stream(900.0) if row[0] >= 60.0])
    dataset = import_logs(logs, tmp_path / "data", format="csv", test_fraction=0.5)
    assert "drive on" not in dataset.manifest.import_flags["split_by"]


def test_files_of_one_place_have_its_roads_and_those_of_another_their_own(tmp_path):
    """Two seconds have the lanes of the six minutes; the crossing keeps its own."""
    logs, road = tmp_path / "logs", highway(minutes=4.0)
    logs.mkdir()

    def rows_of(tracks, low, high):
        for track in tracks:
            first, last = max(track.t[0], low), min(track.t[-1], high)
            for t in np.arange(np.ceil(10.0 * first), 10.0 * last) / 10.0:
                x, y = (np.interp(t, track.t, one) for one in (track.x, track.y))
                yield t, track.id, x, y

    written(logs, "a.csv", rows_of(road.tracks, 0.0, 238.0))
    written(logs, "b.csv", rows_of(road.tracks, 238.0, 240.0))
    written(logs, "c.csv", rows_of(crossing(minutes=3.0).tracks, 0.0, 180.0))
    found = {one.name: one for one in read_logs(logs, format="csv")}
    assert "of 2 files" in found["a"].notes[-1]
    assert "of 2 files" in found["b"].notes[-1]
    assert "files" not in found["c"].notes[-1]
    names = [[lane.id for lane in found[name].lanes] for name in "abc"]
    assert names[0] == names[1]
    assert len(names[2]) > 12
    for lane, other in zip(found["a"].lanes, found["b"].lanes, strict=True):
        np.testing.assert_allclose(lane.centre, other.centre)
