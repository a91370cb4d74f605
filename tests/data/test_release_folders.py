"""Folders as they are after unpacking a release: logs at any depth, other files."""

import shutil

import pytest

from rcirl_jax.data.cut import digest
from rcirl_jax.data.importers import parts, read_part, read_recordings
from rcirl_jax.data.importing import import_parts
from rcirl_jax.data.parts import parts_of
from rcirl_jax.data.store import open_dataset
from rcirl_jax.errors import InputError
from tests.data import writers as w
from tests.data.formats import (
    commonroad,
    interaction,
    interaction_challenge,
    nuplan,
    openacc,
)
from tests.data.small_logs import CONFIG

CAMPAIGNS = ("AstaZero", "Casale", "Cherasco", "Vicolungo", "ZalaZone")


def names(form, path):
    """Recordings by part, as an import reads them, and from the folder at once."""
    found, spec = parts(form, path)
    made = [one.name for part in found for one in read_part(form, part, spec)]
    assert made == [one.name for one in read_part(form, path, spec)]
    assert len(set(made)) == len(made)
    return made


def drive(path, day):
    path.parent.mkdir(parents=True, exist_ok=True)
    meta = (f"Date,{day:02d},07,2019", *openacc.META[1:])
    return openacc.write_drive(path, openacc.table(openacc.cars()), meta=meta)


def test_openacc_campaigns(tmp_path):
    for day, name in enumerate(CAMPAIGNS, start=1):
        drive(tmp_path / name / f"{name}_platoon1.csv", day)
        (tmp_path / name / "Vehicles_specifications.csv").write_text("Vehicles\n")
    (tmp_path / "readme.csv").write_text("Vehicles\n")
    assert names("openacc", tmp_path) == [f"{name}_platoon1" for name in CAMPAIGNS]


def test_openacc_drives_called_alike(tmp_path):
    for day, name in enumerate(("Casale", "Cherasco/part 2"), start=1):
        drive(tmp_path / name / "part1.csv", day)
    drive(tmp_path / "Cherasco" / "part3.csv", 3)
    expected = ["Casale/part1", "Cherasco/part 2/part1", "part3"]
    assert names("openacc", tmp_path) == expected
    import_parts(parts_of("openacc", tmp_path), tmp_path / "data", CONFIG)
    assert open_dataset(tmp_path / "data").manifest.recordings == expected


def test_nuplan_splits(tmp_path):
    fixture = nuplan.write(tmp_path)
    other = tmp_path / "data" / "cache" / "train_boston" / "deep" / "other.db"
    other.parent.mkdir(parents=True)
    shutil.copy(fixture.files[0], other)
    stem = fixture.files[0].stem
    assert names("nuplan", tmp_path) == ["other", stem]
    copy = other.with_name(f"{stem}.db")
    shutil.copy(other, copy)
    assert names("nuplan", tmp_path) == [
        f"data/cache/train_boston/deep/{stem}",
        "other",
        f"nuplan-v1.1/splits/mini/{stem}",
    ]
    # a copy of a log is in the group of the log
    groups = {one.name: one.group for one in read_recordings("nuplan", tmp_path)}
    drive = "2021.06.14.21.57.33_veh-38"
    assert groups == dict.fromkeys(groups, drive) | {"other": "other"}


def test_commonroad_folders(tmp_path):
    for name in ("recorded/NGSIM/US101/a.xml", "recorded/NGSIM/Lankershim/b.xml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        w.commonroad(tmp_path / name)
    (tmp_path / "independent_groups.csv").write_text("file,group\na.xml,day\n")
    assert names("commonroad", tmp_path) == ["b", "a"]
    assert [one.group for one in read_recordings("commonroad", tmp_path)] == [
        "b",
        "day",
    ]
    w.commonroad(tmp_path / "recorded" / "a.xml")
    assert names("commonroad", tmp_path) == [
        "b",
        "recorded/NGSIM/US101/a",
        "recorded/a",
    ]


def test_rests_of_unpacking_are_passed_over(tmp_path):
    commonroad.write(tmp_path)
    (tmp_path / "__MACOSX").mkdir()
    (tmp_path / "__MACOSX" / "._a.xml").write_bytes(b"\x00\x05\x16\x07")
    assert names("commonroad", tmp_path) == ["USA_Test-1_1_T-1"]


@pytest.mark.parametrize("module", [openacc, nuplan, commonroad])
def test_flat_folders_are_as_the_files_alone(tmp_path, module):
    fixture = module.write(tmp_path)
    form = module.__name__.rpartition(".")[2]
    (log, *_) = [file for file in fixture.files if file.suffix != ".gpkg"]
    whole = [digest(one) for one in read_recordings(form, log.parent)]
    assert whole == [digest(one) for one in read_recordings(form, log)]


@pytest.mark.parametrize("writer", [interaction, interaction_challenge])
def test_other_tables_beside_interaction_logs(tmp_path, writer):
    fixture = writer.write(tmp_path)
    before = [digest(one) for one in read_recordings("interaction", fixture.input)]
    (fixture.input / "readme.csv").write_text("a,a,note\n1,2,see the paper\n")
    (fixture.input / "scenes.csv").write_bytes(b"\xff\xfe\x00")
    after = [digest(one) for one in read_recordings("interaction", fixture.input)]
    assert after == before


def test_a_log_of_interaction_without_its_columns_is_named(tmp_path):
    fixture = interaction.write(tmp_path)
    (fixture.input / "vehicle_tracks_007.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match=r"_007\.csv: column track_id: missing"):
        names("interaction", fixture.input)


def test_interaction_scenes_called_alike(tmp_path):
    users = interaction.road_users()
    for release in ("v1.0", "v1.2"):
        interaction.write_scene(tmp_path / release / "DR_A", users)
    assert names("interaction", tmp_path) == [
        "v1.0/DR_A/DR_A-000",
        "v1.2/DR_A/DR_A-000",
    ]
    groups = {one.group for one in read_recordings("interaction", tmp_path)}
    assert groups == {"DR_A-000"}
