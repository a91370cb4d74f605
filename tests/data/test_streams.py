"""Files cut from one stream: a vehicle that drives on is one, in one split."""

import dataclasses
import functools
import re

import numpy as np
import pytest
from scipy.spatial import KDTree

from rcirl_jax import import_logs, open_dataset, read_logs
from rcirl_jax.data.importing import ImportConfig
from rcirl_jax.data.importing import import_logs as import_recordings
from rcirl_jax.data.scenes.config import CollectConfig
from tests.helpers.driven_roads import crossing, dense, motorway


@functools.cache
def stream(shift=0.0):
    """Rows t, id, x, y of cars that start every 1.4 s and drive for 40 s."""
    rows = []
    for car in range(60):
        for k in range(400):
            t = 1.4 * car + 0.1 * k
            s = 14.0 * 0.1 * k + 6.0 * np.sin(0.3 * 0.1 * k + car)
            rows.append((t, car, s + shift, 3.5 * (car % 2)))
    return rows


def written(folder, name, rows, clock=lambda t: f"{7000.0 + t:.1f}"):
    lines = ["t,id,x,y"]
    lines += [f"{clock(t)},{i},{x:.2f},{y:.2f}" for t, i, x, y in rows]
    (folder / name).write_text("\n".join(lines) + "\n")


def cut(folder, names, edges, **options):
    """The stream in a file for each name, in the order of time."""
    folder.mkdir()
    rows = stream()
    ends = zip([0.0, *edges], [*edges, 1e9], strict=True)
    for name, (low, high) in zip(names, ends, strict=True):
        own = [row for row in rows if low <= row[0] < high]
        written(folder, f"{name}.csv", own, **options)
    return folder


def sides(dataset):
    """The log's ids of the vehicles of each split."""
    names = dataset.manifest.vehicles
    splits = ("train", "test")
    numbers = [np.unique(dataset.load(split).vehicle).tolist() for split in splits]
    return [{names[n].rpartition(":")[2] for n in side} for side in numbers]


def before_midnight(t):
    """A time of day, 60 s after the stream began at midnight."""
    seconds = (t - 60.0) % 86400.0
    return f"{seconds // 3600:02.0f}:{seconds // 60 % 60:02.0f}:{seconds % 60:04.1f}"


TOML = """
long_bytes = {long_bytes}
[columns]
t = "t"
id = "id"
x = "x"
y = "y"
"""


PIECES, WHOLE = 1, 10**9


@pytest.mark.parametrize(
    ("names", "edges", "options", "long_bytes"),
    [
        # not in the order of their names; the last meets a vehicle with two names
        ("acb", [45.0, 85.0], {}, PIECES),
        ("ab", [60.0], {"clock": before_midnight}, WHOLE),
    ],
)
def test_a_stream_cut_into_files(tmp_path, names, edges, options, long_bytes):
    logs, source = cut(tmp_path / "logs", names, edges, **options), tmp_path / "s.toml"
    source.write_text(TOML.format(long_bytes=long_bytes))
    dataset = import_logs(
        logs,
        tmp_path / "data",
        format="csv",
        source=source,
        test_fraction=0.5,
        stride_s=4.0,
    )
    train, test = sides(dataset)
    assert train
    assert test
    assert not train & test
    rows = stream()
    of_file = [{row[1] for row in rows if row[0] < edge} for edge in edges]
    after = [{row[1] for row in rows if row[0] >= edge} for edge in edges]
    both = sum(len(a & b) for a, b in zip(of_file, after, strict=True))
    said = dataset.manifest.import_flags["split_by"]
    found = re.search(r"(\d+) vehicles met again in the next recording", said)
    assert found
    assert both - len(edges) * 2 <= int(found[1]) <= both


@pytest.mark.parametrize("has_clock", [True, False])
def test_recordings_of_any_format(tmp_path, has_clock):
    """Groups that a log declares, a place and a time of its own for each recording."""
    logs = cut(tmp_path / "logs", "ab", [60.0])

    def recordings():
        for number, made in enumerate(read_logs(logs, format="csv")):
            move = 100.0 * number
            tracks = [dataclasses.replace(x, x=x.x - move) for x in made.tracks]
            lanes = [
                dataclasses.replace(x, centre=x.centre - np.array([move, 0.0]))
                for x in made.lanes
            ]
            yield dataclasses.replace(
                made,
                tracks=tuple(tracks),
                lanes=tuple(lanes),
                origin=(made.origin[0] + move, made.origin[1]),
                group=made.name if has_clock else None,
                start_s=made.start_s if has_clock else None,
            )

    collect = CollectConfig(stride_s=4.0)
    config = ImportConfig(format="any", test_fraction=0.5, collect=collect)
    import_recordings(recordings(), tmp_path / "data", config)
    dataset = open_dataset(tmp_path / "data")
    train, test = sides(dataset)
    said = dataset.manifest.import_flags["split_by"]
    unknown = "the logs say no time of day: files of one stream cannot be told"
    assert (not train & test) == has_clock
    assert ("met again" in said) == has_clock
    assert (unknown in said) == (not has_clock)


def test_ids_that_another_file_uses_again_are_others(tmp_path):
    """Cars of one id that are elsewhere then."""
    logs = tmp_path / "logs"
    logs.mkdir()
    written(logs, "a.csv", [row for row in stream() if row[0] < 60.0])
    written(logs, "b.csv", [row for row in stream(900.0) if row[0] >= 60.0])
    dataset = import_logs(
        logs, tmp_path / "data", format="csv", test_fraction=0.5, stride_s=4.0
    )
    assert "met again" not in dataset.manifest.import_flags["split_by"]


def rows_of(tracks, low, high):
    """Rows t, id, x, y of the tracks between two times."""
    for number, track in enumerate(tracks):
        first, last = max(track.t[0], low), min(track.t[-1], high)
        for t in np.arange(np.ceil(10.0 * first), 10.0 * last) / 10.0:
            x, y = (np.interp(t, track.t, one) for one in (track.x, track.y))
            yield t, number, x, y


def test_files_of_one_place_have_its_roads_and_those_of_another_their_own(tmp_path):
    """Four seconds have the lanes of the four minutes; the crossing keeps its own."""
    logs, road = tmp_path / "logs", motorway(minutes=4.0)
    logs.mkdir()
    apart = crossing(minutes=3.0).tracks
    files = (
        (road.tracks, 0.0, 236.0),
        (road.tracks, 236.0, 240.0),
        (apart, 0.0, 180.0),
    )
    for name, content in zip("abc", files, strict=True):
        written(logs, f"{name}.csv", rows_of(*content), clock=lambda t: f"{t:.1f}")
    found = list(read_logs(logs, format="csv"))
    notes = [[n for n in one.notes if "estimated from all" in n] for one in found]
    assert ["of 2 files" in note for (note,) in notes] == [True, True, False]
    assert "files" not in notes[2][0]
    names = [[lane.id for lane in one.lanes] for one in found]
    assert names[0] == names[1]
    assert len(names[2]) > 12
    for lane, other in zip(found[0].lanes, found[1].lanes, strict=True):
        np.testing.assert_allclose(lane.centre, other.centre)


@pytest.mark.parametrize("others", [("41234", "41234"), ("23142", "     ")])
def test_files_of_one_place_with_numbers_of_lanes_have_its_roads(tmp_path, others):
    """One lane is at a place, also where files number it differently or not at all."""
    road, lines = motorway(minutes=3.0), ("slip", "0", "1", "2", "exit")
    trees = [KDTree(road.lanes[name]) for name in lines]
    for number, names in enumerate(("41234", *others)):
        rows = np.array([*rows_of(road.tracks, 60.0 * number, 60.0 * number + 60.0)])
        lane = np.argmin([tree.query(rows[:, 2:])[0] for tree in trees], axis=0)
        text = [f"{t:.1f},{i:.0f},{x:.2f},{y:.2f}" for t, i, x, y in rows]
        text = [f"{row},{names[n].strip()}" for row, n in zip(text, lane, strict=True)]
        (tmp_path / f"{number}.csv").write_text("\n".join(["t,id,x,y,lane", *text]))
    found = [*read_logs(tmp_path, format="csv")]
    (note,) = (note for note in found[0].notes if "estimated" in note)
    assert note.startswith("only numbers of lanes given; 5 estimated from all tracks")
    assert "and their numbers of 3 files" in note
    for one in found[1:]:
        assert [x.id for x in one.lanes] == [x.id for x in found[0].lanes]
        for lane, other in zip(found[0].lanes, one.lanes, strict=True):
            np.testing.assert_allclose(lane.centre, other.centre)
    lanes = [lane.centre for lane in found[0].lanes]
    assert sum(map(len, lanes)) < 3000  # points a metre apart, of 2760 m
    tree = KDTree(np.concatenate([dense(lane) for lane in lanes]))
    for name in ("slip", "0", "1", "exit"):
        apart = tree.query(road.lanes[name][5:-5])[0]
        assert np.percentile(apart, 95) < 0.4, name
        assert np.max(apart) < 0.7, name
