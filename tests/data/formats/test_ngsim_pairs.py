"""NGSIM pairs: groups of pairs that share a car, options, real files."""

import functools
import time

import pytest

from rcirl_jax.data.importing import ImportConfig, import_logs
from rcirl_jax.data.scenes.config import CollectConfig
from tests.data.formats.fixtures import ngsim_pairs as fixture
from tests.helpers import logs

read = functools.partial(logs.read, "ngsim_pairs")


@pytest.fixture
def pair(tmp_path):
    return fixture.write_pair(tmp_path, "1032", "1025", "00046")


def test_pairs_that_share_a_car_are_one_group(tmp_path):
    """Not with those of another run, whose numbers are other cars."""
    for pair in (*fixture.PAIRS, ("1032", "1025", "00099")):
        path = fixture.write_pair(tmp_path, *pair)
    other = tmp_path / path.name.replace("0400pm", "0515pm")
    other.write_bytes(path.read_bytes())
    (tmp_path / "f1_lead").mkdir()
    mine = path.rename(tmp_path / "f1_lead" / "mine.csv")
    groups = {recording.name: recording.group for recording in read(tmp_path)}
    assert len(groups) == 3
    assert len({group for name, group in groups.items() if name != other.stem}) == 1
    assert len(set(groups.values())) == 2
    (recording,) = read(mine)  # of a name that says nothing
    assert [track.id for track in recording.tracks] == ["follower", "leader"]
    assert recording.group == "mine"


def test_options(pair, tmp_path):
    source = tmp_path / "s.toml"
    source.write_text("follower_length_m = 5.0\nwidth_m = 2.0\nspeed_limit = 30.0\n")
    (recording,) = read(pair, source)
    assert recording.tracks[0].length == pytest.approx(5.0)
    assert recording.tracks[0].width == 2.0
    assert recording.lanes[0].speed_limit == 30.0
    source.write_text('unit = "yard"\n')
    line = logs.refused(read, pair, source)
    assert "source TOML: unit: yard: expected one of ft, m" in line


def test_only_the_follower_is_an_expert(pair, tmp_path):
    """Whom the leader follows is not in the file: its scenes are dropped."""
    config = ImportConfig(
        format="ngsim_pairs", collect=CollectConfig(), test_fraction=0.0
    )
    manifest = import_logs(read(pair), tmp_path / "out", config)
    assert [name.rpartition(":")[2] for name in manifest.vehicles] == ["1032"]
    assert manifest.quality["dropped"]["follows_missing_car"] > 0


@pytest.mark.dataset
def test_recorded_pairs(data_dir):
    begin = time.process_time()
    found = read(data_dir / "ngsim_i80_pairs")
    seconds = time.process_time() - begin
    assert len(found) == 123
    assert len({recording.name for recording in found}) == 123
    assert len({recording.group for recording in found}) == 96
    states = sum(track.t.size for recording in found for track in recording.tracks)
    assert states == 150756
    assert states / seconds > 5e4
    for recording in found:
        follower, leader = recording.tracks
        gap = leader.x - follower.x - 0.5 * (leader.length + follower.length)
        assert gap.min() > 0.3
        assert gap.max() < 100.0
        assert 3.0 < leader.length < 22.0
