"""The shared small inputs that people reported, each with what is right for it."""

import gzip
import os
from pathlib import Path

import numpy as np
import pytest

from rcirl_jax.data.cut import cut
from rcirl_jax.data.importing import ImportConfig, import_parts
from rcirl_jax.data.parts import parts_of
from rcirl_jax.data.quality import assumed
from rcirl_jax.data.scenes.config import CollectConfig
from tests.conftest import REPO
from tests.data.importers import people
from tests.helpers import logs

# beside the recordings (`data_dir` of conftest.py)
CASES = (
    Path(os.environ.get("RCIRL_DATA", REPO.parent / "shared" / "data")).parent / "cases"
)


@pytest.fixture
def case(request):
    folder = CASES / request.param
    if not folder.is_dir():
        pytest.skip(f"{folder} is not here")
    return folder


def of(name):
    return pytest.mark.parametrize("case", [name], indirect=True)


def scenes(recording):
    return len(cut(recording, CollectConfig()).vehicles)


@pytest.mark.parametrize("case", ["01_sumo_fcd", "02_semicolon"], indirect=True)
def test_sumo(case):
    (found,) = people.read(case, case / "map.toml")
    assert len(found.tracks) == 6
    for track in found.tracks:
        np.testing.assert_allclose(track.heading, 0.0, atol=1e-6)
    assert 140 <= scenes(found) <= 148


@of("03_tgsim")
def test_tgsim(case, tmp_path):
    """Its automation column says no in every row; said yes, nobody is human."""
    text = (case / "map.toml").read_text()
    source = tmp_path / "map.toml"
    source.write_text(
        text.replace('lane = "lane_kf"', 'lane = "lane_kf"\nautomated = "av"')
    )
    (found,) = people.read(case / "run.csv", source)
    assert not any(track.automated for track in found.tracks)
    log = tmp_path / "run.csv"
    log.write_text((case / "run.csv").read_text().replace(",no,", ",yes,"))
    (found,) = people.read(log, source)
    assert all(track.automated for track in found.tracks)


@of("11_compass_heading")
def test_compass(case):
    (found,) = people.read(case, case / "map.toml")
    assert any("cw_from_north" in note for note in found.notes)
    for track in found.tracks:
        np.testing.assert_allclose(track.heading, np.radians(30.0), atol=1e-3)
    obstacles = cut(found, CollectConfig()).scenes.scene.obstacles
    width = (obstacles.l_upper - obstacles.l_lower)[obstacles.valid]
    assert np.median(width) == pytest.approx(1.80, abs=0.02)


@pytest.mark.parametrize("case", ["20_latlon", "21_decimal_comma"], indirect=True)
def test_degrees_and_decimal_commas(case):
    (found,) = people.read(case, case / "map.toml")
    assert len(found.tracks) == 6
    spans = [np.ptp(track.x) for track in found.tracks]
    assert 245.0 < min(spans) <= max(spans) < 400.0
    assert {round(float(np.median(t.y)), 1) for t in found.tracks} == {0.0, -3.5}
    assert scenes(found) > 100


def named(folder, case, pattern):
    source = folder / "map.toml"
    text = (case / "map.toml").read_text()
    source.write_text(text.replace('pattern = "*.csv"', f'pattern = "{pattern}"'))
    return source


def assert_drone(found, other):
    assert len(found.tracks) == 52
    for track, same in zip(found.tracks, other.tracks, strict=True):
        assert (track.id, track.length, track.width) == (
            same.id,
            same.length,
            same.width,
        )
        for field in ("t", "x", "y", "heading", "speed"):
            np.testing.assert_allclose(
                getattr(track, field), getattr(same, field), atol=1e-6
            )


@of("30_drone_recording")
def test_a_drone_recording_in_both_forms(case, tmp_path):
    made = [
        people.only(case, named(tmp_path, case, pattern))
        for pattern in ("*.csv.gz", "*.parquet")
    ]
    assert_drone(*made)
    assert [people.rows_of(one) for one in made] == [(16495, 0, 1, 0)] * 2
    assert scenes(made[0]) == scenes(made[1]) > 500


def lines_of(case):
    return gzip.decompress((case / "flight.csv.gz").read_bytes()).decode().splitlines()


@of("30_drone_recording")
def test_a_drone_recording_with_empty_cells(case, tmp_path):
    """Optional ones are unknown; a row without a place is dropped and counted."""
    head, *rows = lines_of(case)
    columns = head.split(",")
    cells = [row.split(",") for row in rows]
    for k, row in enumerate(cells):
        if k % 50 == 0:
            row[columns.index("Speed_kmh")] = ""
        if k % 70 == 0:
            row[columns.index("Heading_deg")] = "NaN"
        if k % 1000 == 7:
            row[columns.index("UTM_E")] = ""
    log = tmp_path / "flight.csv"
    log.write_text("\n".join([head, *(",".join(row) for row in cells)]))
    found = people.only(log, case / "map.toml")
    assert (found.rows.read, found.rows.unreadable) == (16495, 17)
    assert found.rows.repeated + found.rows.doubled == 1
    other = people.only(case, named(tmp_path, case, "*.parquet"))
    assert abs(scenes(found) - scenes(other)) < 0.05 * scenes(other)
    for track in found.tracks:
        assert np.isfinite(track.speed).all()
        assert np.isfinite(track.heading).all()


@of("13_apollo_empty_desc")
def test_a_channel_without_descriptors(case):
    (found,) = logs.read("apollo", case)
    assert found.tracks
    assert any("/apollo/canbus/chassis: not read" in note for note in found.notes)


@of("16_commonroad_region_position")
def test_positions_that_are_regions(case):
    """Through the rectangles' centres, at the midpoints of the intervals."""
    (found,) = logs.read("commonroad", case)
    for track in found.tracks:
        np.testing.assert_allclose(np.diff(track.x), 1.5)
        np.testing.assert_allclose(track.y, 0.0)
        np.testing.assert_allclose(track.heading, 0.0, atol=1e-12)
        np.testing.assert_allclose(track.speed, 15.0)
    assert any("states in a region" in note for note in found.notes)


@of("18_empty_scenario")
def test_a_file_without_traffic_beside_another(case, tmp_path):
    collect = CollectConfig(require_speed_change=False)
    config = ImportConfig(format="commonroad", collect=collect, test_fraction=0.0)
    made = import_parts(parts_of("commonroad", case), tmp_path / "out", config)
    assert made.count == 10
    assert made.quality["empty"] == 1
    assert "a_no_traffic: no traffic" in made.quality["notes"]


@of("15_argentina_limit")
def test_signs_of_other_countries(case):
    """The lanes' limits are those of the signs, of whatever country."""
    found = logs.read("commonroad", case)
    assert len(found) == 11
    for recording in found:
        assert [lane.speed_limit for lane in recording.lanes] == [11.111]
        assert not any(assumed(recording).values())
