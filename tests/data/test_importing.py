"""An import of recordings made by hand: interrupted, resumed, refused, split."""

import dataclasses
import re

import pytest

from rcirl_jax.data import importing
from rcirl_jax.data.formats import read_recordings
from rcirl_jax.data.importing import ImportConfig, import_logs
from rcirl_jax.data.quality import format_quality, format_splits
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.data.store.rows import check_finite
from rcirl_jax.errors import InputError, LostWorkError
from rcirl_jax.types import Kind
from tests.data.small_logs import files_of
from tests.helpers.logs import refused
from tests.helpers.roads import NO_FILTER, car, part, recording, speeding_up

CONFIG = ImportConfig(format="test", collect=NO_FILTER, test_fraction=0.4)


def three_recordings():
    for i in range(3):
        made = recording(
            car("ego", speeding_up(20.0 + i)), car("lead", speeding_up(60.0))
        )
        yield validate_recording(dataclasses.replace(made, name=f"r{i}", group=f"g{i}"))


@pytest.fixture(scope="module")
def three():
    return list(three_recordings())


@pytest.fixture
def small_shards(monkeypatch):
    """A shard for each recording."""
    monkeypatch.setattr(importing, "SHARD_SCENES", 1)


def ending(recordings, error):
    """The recordings, then an error."""
    yield from recordings
    raise error


@pytest.mark.usefixtures("small_shards")
@pytest.mark.parametrize("error", [KeyboardInterrupt, LostWorkError("log: killed")])
def test_an_interrupted_import_resumes_to_the_same_bytes(tmp_path, three, error):
    """Names, quality and numbers go on; other settings or recordings are refused."""
    part, out = tmp_path / "part", tmp_path / "whole"
    import_logs(three, out, CONFIG)
    with pytest.raises((KeyboardInterrupt, LostWorkError)):
        import_logs(ending(three[:2], error), part, CONFIG)
    assert "interrupted" in refused(open_dataset, part)
    left = files_of(part)
    kept = {path: path.stat().st_mtime_ns for path in part.rglob("shard.json")}
    assert kept
    wider = dataclasses.replace(NO_FILTER, stride_s=1.0)
    other = dataclasses.replace(CONFIG, collect=wider)
    for recordings, config, words in (
        (three, other, "settings changed"),
        (three[:1], CONFIG, "r1: missing: expected all recordings"),
        (three[::-1], CONFIG, "r2: input or settings changed"),
    ):
        assert words in refused(import_logs, recordings, part, config)
        assert files_of(part) == left
    import_logs(three, part, CONFIG)
    assert files_of(part) == files_of(out)
    assert all(path.stat().st_mtime_ns == when for path, when in kept.items())


@pytest.mark.usefixtures("small_shards")
def test_bad_input_in_the_middle_leaves_nothing(tmp_path, three):
    bad = ending(three[:2], InputError("r2: x: nan: expected a finite number"))
    assert "r2: x: nan" in refused(import_logs, bad, tmp_path / "out", CONFIG)
    assert not (tmp_path / "out").exists()
    lonely = recording(car("ego", speeding_up(20.0), seconds=3.0))
    line = refused(import_logs, [lonely], tmp_path / "out", CONFIG)
    assert "0 scenes kept of 1 tracks: 1 future_too_short: try a lower" in line
    assert not (tmp_path / "out").exists()


def test_a_recording_without_traffic_is_counted_and_skipped(tmp_path, three):
    empty = dataclasses.replace(three[0], name="empty", tracks=())
    import_logs(three, tmp_path / "plain", CONFIG)
    made = import_logs([validate_recording(empty), *three], tmp_path / "out", CONFIG)
    plain = open_dataset(tmp_path / "plain")
    assert made.count == plain.count
    assert (made.quality["recordings"], made.quality["empty"]) == (3, 1)
    assert any(note == "empty: no traffic" for note in made.quality["notes"])
    assert "1 recording without traffic skipped" in format_quality(made.quality)
    line = refused(import_logs, [empty], tmp_path / "none", CONFIG)
    assert "1 recording, none with traffic" in line
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("group", [None, "declared"])
def test_one_recording_is_split_by_when_vehicles_are_first_seen(tmp_path, group):
    one = car("one", speeding_up(0.0, 10.0), seconds=20.0)
    two = car("two", speeding_up(60.0, 10.0), seconds=20.0)
    three = part(car("three", speeding_up(30.0, 10.0), seconds=20.0), 4.0)
    made = dataclasses.replace(recording(one, two, three), group=group)
    import_logs([validate_recording(made)], tmp_path / "data", CONFIG)
    dataset = open_dataset(tmp_path / "data")
    names = dataset.manifest.vehicles
    driven = {
        split: {names[n].rpartition(":")[2] for n in dataset.load(split).vehicle}
        for split in ("train", "test")
    }
    assert driven == {"train": {"one", "two"}, "test": {"three"}}
    told, scenes = format_splits(dataset), dataset.indices("test").size
    assert re.search(r"split by +blocks of 3.75 s", told)
    assert re.search(rf"split test +{scenes} scenes \(.*%\) in 1 group of", told)


def test_an_empty_split_is_refused_and_what_is_finished_stays(tmp_path):
    bike = car("bike", speeding_up(30.0), kind=Kind.CYCLIST)
    alone = recording(car("only", speeding_up(0.0)), bike)
    line = refused(import_logs, [alone], tmp_path / "data", CONFIG)
    assert line.startswith(
        "splits: groups: 1 (hand/minute-0000): expected at least two"
    )
    training = dataclasses.replace(CONFIG, test_fraction=0.0)
    import_logs([alone], tmp_path / "data", training)
    dataset = open_dataset(tmp_path / "data")
    assert dataset.indices("test").size == 0
    empty = dataset.load("test"), dataset.indices("test")
    line = refused(check_finite, "test", *empty)
    assert line.startswith("test: 0 scenes: expected at least one; ")


@pytest.mark.dataset
def test_us101(data_dir, tmp_path):
    manifest = import_logs(
        read_recordings("commonroad", data_dir / "ngsim_us101_commonroad" / "xml"),
        tmp_path / "us101",
        ImportConfig(format="commonroad"),
    )
    quality = manifest.quality
    assert (quality["recordings"], quality["tracks"]) == (36, 996)
    assert quality["scenes"] > 2500
    assert quality["harsh_share_smoothed"] < 0.05 < quality["harsh_share_raw"]
    dataset = open_dataset(tmp_path / "us101")
    train, test = dataset.load("train"), dataset.load("test")
    assert not set(train.vehicle.tolist()) & set(test.vehicle.tolist())
