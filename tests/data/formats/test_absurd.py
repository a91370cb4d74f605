"""Numbers in range for a parser and absurd for a road; faults no check foresaw."""

import pytest

from rcirl_jax.data.formats.csv import reader
from rcirl_jax.data.readers.tables import streams
from tests.data.formats.fixtures import csv, format_of, modules
from tests.helpers.logs import read, refused


def first_file(name, folder):
    """The first file of a sound log."""
    folder.mkdir()
    return modules()[name].write(folder).files[0]


# with and without a reader of its own
@pytest.mark.parametrize("name", ["levelx_highd", "openacc"])
def test_a_log_that_is_held_whole_has_a_size(name, tmp_path):
    file = first_file(name, tmp_path / "in")
    with file.open("r+b") as opened:
        opened.truncate(2**40)  # its rows, and a terabyte of nothing
    line = refused(read, format_of(name), tmp_path / "in")
    assert f"{file.name}: size: {2**20} MiB: expected 1024 at most" in line


@pytest.mark.parametrize("where", ["header", "rows", "cell"])
@pytest.mark.parametrize("name", ["openacc", "csv"])
def test_a_line_without_an_end_is_not_held(name, where, tmp_path, monkeypatch):
    """All of it on one line; a sound head, then a line of cells, or of a wide one."""
    monkeypatch.setattr(streams, "MAX_LINE", 2**14)
    monkeypatch.setattr(streams, "READ_CHARS", 2**12)
    monkeypatch.setattr(streams, "HEAD_BYTES", 2**12)
    file = first_file(name, tmp_path / "in")
    rows = file.read_text().splitlines(keepends=True)
    end = rows[-1].rstrip("\n").replace(" ", ",")
    text = "" if where == "header" else "".join(rows)
    text += (end + ",") * (2**16 // len(end))
    if where == "cell":
        text = "".join(rows[:-1]) + 2**16 * " " + rows[-1]
    file.write_text(text)
    line = refused(read, format_of(name), tmp_path / "in")
    assert file.name in line
    assert "a line of more than 16384 characters: expected one a row" in line


def test_a_fault_of_ours_is_not_the_users(tmp_path, monkeypatch):
    """Errors of bad data become one line; a bug passes, with a note on the file."""
    fixture = csv.write(tmp_path)

    def broken(path, spec):
        yield from ()
        raise fault

    monkeypatch.setattr(reader, "recordings", broken)
    fault = ValueError("cannot convert")
    line = refused(read, "csv", fixture.input)
    assert "ValueError: cannot convert: expected a sound log of format csv" in line
    fault = KeyError("stations")
    with pytest.raises(KeyError) as caught:
        read("csv", fixture.input)
    (note,) = caught.value.__notes__
    assert note.startswith(f"while reading {fixture.input}")
