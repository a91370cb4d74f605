"""The shared small inputs that people reported, each with what is right for it."""

import os
from pathlib import Path

import numpy as np
import pytest

from rcirl_jax.data.importing import ImportConfig, import_logs, scenes_of
from rcirl_jax.data.inputs import input_files
from rcirl_jax.data.quality import assumed
from rcirl_jax.data.scenes.config import CollectConfig
from tests.conftest import REPO
from tests.helpers import logs

# beside the recordings (`data_dir` of conftest.py)
CASES = (
    Path(os.environ.get("RCIRL_DATA", REPO.parent / "shared" / "data")).parent / "cases"
)


def recordings(name, form="csv"):
    """What a case is read as, by its own TOML if it has one."""
    case = CASES / name
    if not case.is_dir():
        pytest.skip(f"{case} is not here")
    source = case / "map.toml"
    return logs.read(form, case, source if source.is_file() else None)


def scenes(recording):
    return len(scenes_of(recording, CollectConfig()).vehicles)


# case -> tracks, heading [rad] of all of them, fewest and most scenes
TABLES = {
    "01_sumo_fcd": (6, 0.0, (140, 148)),
    "02_semicolon": (6, 0.0, (140, 148)),
    "11_compass_heading": (None, np.radians(30.0), (1, 10**6)),
    "20_latlon": (6, None, (100, 10**6)),
    "21_decimal_comma": (6, None, (100, 10**6)),
}


@pytest.mark.parametrize("name", TABLES)
def test_tables(name):
    (found,) = recordings(name)
    tracks, heading, (fewest, most) = TABLES[name]
    assert tracks in (None, len(found.tracks))
    if heading is not None:
        for track in found.tracks:
            np.testing.assert_allclose(track.heading, heading, atol=1e-3)
    assert fewest <= scenes(found) <= most


def test_an_automation_column_that_says_no_or_yes(tmp_path):
    recordings("03_tgsim")
    case = CASES / "03_tgsim"
    source, log = tmp_path / "map.toml", tmp_path / "run.csv"
    lane = 'lane = "lane_kf"'
    text = (case / "map.toml").read_text()
    source.write_text(text.replace(lane, f'{lane}\nautomated = "av"'))
    log.write_text((case / "run.csv").read_text().replace(",no,", ",yes,"))
    for path, expected in ((case / "run.csv", False), (log, True)):
        (found,) = logs.read("csv", path, source)
        assert {bool(track.automated) for track in found.tracks} == {expected}


@pytest.mark.parametrize("pattern", ["*.csv.gz", "*.parquet"])
def test_a_drone_recording_in_both_forms(pattern, tmp_path):
    case, source = CASES / "30_drone_recording", tmp_path / "map.toml"
    if not case.is_dir():
        pytest.skip(f"{case} is not here")
    text = (case / "map.toml").read_text()
    source.write_text(text.replace('pattern = "*.csv"', f'pattern = "{pattern}"'))
    (found,) = logs.read("csv", case, source)
    assert tuple(vars(found.rows).values()) == (16495, 0, 1, 0)
    assert len(found.tracks) == 52
    assert scenes(found) > 500


def test_logs_of_other_formats():
    """A channel without descriptors; regions for places; signs of other countries."""
    (found,) = recordings("13_apollo_empty_desc", "apollo")
    assert found.tracks
    assert not any("chassis" in note for note in found.notes)  # its fields are known
    (found,) = recordings("16_commonroad_region_position", "commonroad")
    for track in found.tracks:
        np.testing.assert_allclose(np.diff(track.x), 1.5)
        np.testing.assert_allclose(track.speed, 15.0)
    found = recordings("15_argentina_limit", "commonroad")
    assert len(found) == 11
    for recording in found:
        assert [lane.speed_limit for lane in recording.lanes] == [11.111]
        assert not any(assumed(recording).values())


def test_a_file_without_traffic_beside_another(tmp_path):
    recordings("18_empty_scenario", "commonroad")
    collect = CollectConfig(require_speed_change=False)
    config = ImportConfig(format="commonroad", collect=collect, test_fraction=0.0)
    found = input_files("commonroad", CASES / "18_empty_scenario")
    made = import_logs(found, tmp_path / "out", config)
    assert (made.count, made.quality["empty"]) == (10, 1)
