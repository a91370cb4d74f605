"""Inputs whose format nobody says."""

import pytest

from rcirl_jax.data.formats.recognise import recognised_format
from tests.data.formats import people
from tests.data.formats import writers as w
from tests.data.formats.fixtures import modules
from tests.helpers.logs import read, refused


def test_a_table_of_ones_own_needs_a_source_or_the_usual_names(tmp_path):
    path = w.ngsim_csv(tmp_path / "log.csv", w.ngsim_rows())
    assert recognised_format(path) == "ngsim"
    path.write_text(people.text(people.rows()))
    assert recognised_format(path) == "csv"
    header = ["Zeit", *people.HEADER[1:]]
    path.write_text(people.text(people.rows(), header, between=";"))
    for place in (path, tmp_path):
        line = refused(recognised_format, place)
        assert line.startswith(f"{path}: format: not given: a table of no known")
        assert f"--suggest={path}" in line
    source = people.spec(tmp_path)
    assert recognised_format(path, source) == "csv"
    # a source TOML beside the log is no synthetic traffic
    line = refused(recognised_format, tmp_path)
    assert line.startswith(f"{path}: format: not given: a table of no known")
    assert f"perhaps {source}, which is there" in line
    path.write_text(POINTER)
    assert refused(recognised_format, tmp_path).startswith(f"{path}: Git LFS pointer")


def test_what_is_nothing_or_several_is_one_line(tmp_path):
    assert "input: missing" in refused(recognised_format, tmp_path / "nowhere")
    line = refused(recognised_format, tmp_path)
    assert "no files of a known format: expected one of" in line
    w.commonroad(tmp_path / "a.xml")
    w.ngsim_text(tmp_path / "a.txt", w.ngsim_rows())
    line = refused(recognised_format, tmp_path)
    assert "a.xml of commonroad, a.txt of ngsim" in line


POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:f30\nsize 129\n"


@pytest.mark.parametrize("name", ["argoverse2", "commonroad", "levelx", "ros2"])
def test_git_lfs_pointers_are_called_by_their_name(name, tmp_path):
    """In place of any of the files, whatever the format."""
    fixture = modules()[name].write(tmp_path)
    for file in fixture.files:
        content = file.read_bytes()
        if file.suffix == ".json":
            continue  # maps of Argoverse 2
        file.write_text(POINTER)
        line = refused(read, name, fixture.input)
        assert line.startswith(f"{file}: Git LFS pointer: expected the data")
        assert "git lfs pull" in line
        file.write_bytes(content)
