"""Folders as they are after unpacking a release: logs at any depth, other files."""

import shutil

import pytest

from rcirl_jax.data.cut import digest
from rcirl_jax.data.importers import parts, read_part, read_recordings
from rcirl_jax.data.importing import import_parts
from rcirl_jax.data.parts import parts_of
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.errors import InputError
from tests.data.importers import writers as w
from tests.data.importers.formats import (
    argoverse2,
    commonroad,
    interaction,
    interaction_challenge,
    levelx,
    levelx_highd,
    ngsim,
    nuplan,
    openacc,
    waymo,
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


def test_openacc_tables_that_are_no_drives(tmp_path):
    """Lists of settings, and the campaign of one car without positions."""
    drive(tmp_path / "ZalaZone" / "handling_part12.csv", 9)
    settings = "Long setting vehs in mixed timegap experiment handling.csv"
    (tmp_path / "ZalaZone" / settings).write_text(
        "filename,Long timegap setting\nhandling_part12,BMW_I3/MERCEDES_GLE450\n"
    )
    alone = tmp_path / "One_vehicle_multiple_drivers_on_road_campaign"
    alone.mkdir()
    (alone / "D10_part1.csv").write_text(
        "Time,Speed,Engine Speed,Gear\n0.0,0.0,0.0,0\n0.1,0.0,0.0,0\n"
    )
    assert names("openacc", tmp_path) == ["handling_part12"]
    # asked for alone it is refused
    with pytest.raises(
        InputError, match=r"D10_part1\.csv: columns: .* expected Speed1"
    ):
        names("openacc", alone)


@pytest.mark.parametrize(
    "damaged", [b"", b"Date,09,10,2019\nVehicle_order,A\n", b"\xff\xfe\x00Time,Speed1"]
)
def test_damaged_openacc_drives_are_named(tmp_path, damaged):
    drive(tmp_path / "part1.csv", 1)
    (tmp_path / "part2.csv").write_bytes(damaged)
    with pytest.raises(InputError, match=r"part2\.csv: (column Time|header|rows)"):
        names("openacc", tmp_path)


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


def test_the_invented_scenario_of_interactions_scripts(tmp_path):
    """The data set unpacked into a clone of the repository of its tools."""
    users = interaction.road_users()
    for name in (".TestScenarioForScripts", "DR_A"):
        interaction.write_scene(tmp_path / "recorded_trackfiles" / name, users)
    assert names("interaction", tmp_path) == ["DR_A-000"]
    alone = tmp_path / "recorded_trackfiles" / ".TestScenarioForScripts"
    assert names("interaction", alone) == [".TestScenarioForScripts-000"]


def test_sumo_beside_commonroad(tmp_path):
    """An interactive scenario's folder, with SUMO's header of generated files."""
    w.commonroad(tmp_path / "DEU_A9-1_1_I-1.cr.xml")
    made = "<?xml version='1.0'?>\n<!-- made by SUMO\n<commonRoad x='1'/>\n-->\n\n"
    (tmp_path / "DEU_A9-1_1_I-1.net.xml").write_text(f"{made}<net version='1.6'/>")
    (tmp_path / "DEU_A9-1_1_I-1.rou.xml").write_text(f"{made}<routes/>")
    (tmp_path / "solution.xml").write_text('<CommonRoadSolution date="2024"/>')
    assert names("commonroad", tmp_path) == ["DEU_A9-1_1_I-1.cr"]
    (tmp_path / "broken.xml").write_text("<scenario/>")
    with pytest.raises(InputError, match=r"broken\.xml: root: 'scenario': expected"):
        names("commonroad", tmp_path)


RESTS = [
    *(argoverse2, commonroad, interaction, interaction_challenge),
    *(levelx, ngsim, openacc, waymo),
]


@pytest.mark.parametrize("module", RESTS)
def test_rests_of_unpacking_are_passed_over(tmp_path, module):
    """What a Mac's zip holds besides, in a folder of its own or beside the files."""
    (tmp_path / "release").mkdir()
    fixture = module.write(tmp_path / "release")
    form = getattr(module, "FORMAT", module.__name__.rpartition(".")[2])
    before = names(form, tmp_path / "release")
    for file in fixture.files:
        shadow = tmp_path / "release" / "__MACOSX" / file.relative_to(tmp_path)
        shadow.parent.mkdir(parents=True, exist_ok=True)
        for place in (shadow.parent, file.parent):
            (place / f"._{file.name}").write_bytes(b"\x00\x05\x16\x07\x00\x02")
    assert names(form, tmp_path / "release") == before


def test_levelx_releases_side_by_side(tmp_path):
    levelx.write(tmp_path / "inD-dataset-v1.1")
    assert names("levelx", tmp_path) == ["07"]
    highd = tmp_path / "highd-dataset-v1.0" / "data"
    highd.mkdir(parents=True)
    levelx_highd.write(highd)
    assert names("levelx", tmp_path) == ["01", "07"]
    for file in sorted(highd.iterdir()):
        file.rename(file.with_name(file.name.replace("01_", "07_")))
    assert names("levelx", tmp_path) == [
        "highd-dataset-v1.0/data/07",
        "inD-dataset-v1.1/data/07",
    ]
    (map_of_place,) = read_recordings("levelx", tmp_path / "inD-dataset-v1.1")
    assert len(map_of_place.lanes) == 7


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
