"""Folders as they are after unpacking a release: logs at any depth, other files."""

import pytest

from rcirl_jax.data.formats import parts, read_part
from rcirl_jax.errors import InputError
from tests.data.formats import writers as w
from tests.data.formats.fixtures import (
    format_of,
    modules,
    openacc,
)

# whose recordings are named by their files
BY_FILE = (
    *("commonroad", "interaction", "interaction_challenge", "levelx"),
    *("levelx_highd", "ngsim", "nuplan", "openacc", "ros2"),
)


def names(form, path):
    """Recordings by part, as an import reads them, and from the folder at once."""
    found, spec = parts(form, path)
    made = [one.name for part in found for one in read_part(form, part, spec)]
    assert made == [one.name for one in read_part(form, path, spec)]
    assert len(set(made)) == len(made)
    return made


@pytest.mark.parametrize("name", BY_FILE)
def test_logs_called_alike_are_named_by_their_folders(name, tmp_path):
    """At any depth; one that is called like no other keeps its name."""
    form, inputs = format_of(name), []
    for place in (tmp_path / "a", tmp_path / "b c" / "deep"):
        place.mkdir(parents=True)
        inputs.append(modules()[name].write(place).input)
    own = names(form, inputs[0])
    assert own == names(form, inputs[1])
    found = [one.split("/") for one in names(form, tmp_path)]
    assert len(found) == 2 * len(own)
    assert {(one[0], one[-1]) for one in found} == {
        (folder, one) for folder in ("a", "b c") for one in own
    }


@pytest.mark.parametrize("name", sorted(modules()))
def test_rests_of_unpacking_are_passed_over(tmp_path, name):
    """What a Mac's zip holds besides, in a folder of its own or beside the files."""
    (tmp_path / "release").mkdir()
    fixture, form = modules()[name].write(tmp_path / "release"), format_of(name)
    before = names(form, fixture.input)
    for file in fixture.files:
        shadow = tmp_path / "release" / "__MACOSX" / file.relative_to(tmp_path)
        shadow.parent.mkdir(parents=True, exist_ok=True)
        for place in (shadow.parent, file.parent):
            (place / f"._{file.name}").write_bytes(b"\x00\x05\x16\x07\x00\x02")
    assert names(form, fixture.input) == before


def test_openacc_tables_that_are_no_drives(tmp_path):
    """Lists of settings, and the campaign of one car without positions."""
    openacc.write(tmp_path)
    settings = "Long setting vehs in mixed timegap experiment handling.csv"
    (tmp_path / settings).write_text("filename,Long timegap setting\npart12,BMW_I3\n")
    alone = tmp_path / "One_vehicle_multiple_drivers_on_road_campaign"
    alone.mkdir()
    (alone / "D10_part1.csv").write_text("Time,Speed,Gear\n0.0,0.0,0\n0.1,0.0,0\n")
    assert names("openacc", tmp_path) == ["ASta_040719_platoon1"]
    # asked for alone it is refused
    with pytest.raises(InputError, match=r"D10_part1\.csv: columns: .* Speed1"):
        names("openacc", alone)
    (tmp_path / "part2.csv").write_bytes(b"Date,09,10,2019\nVehicle_order,A\n")
    with pytest.raises(InputError, match=r"part2\.csv: "):
        names("openacc", tmp_path)


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
