"""One table in every layout: delimiters, decimals, encodings, packing, Parquet."""

import bz2
import datetime
import decimal
import gzip

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet as pq
import pytest

from tests.data.importers import people
from tests.data.importers.people import LONG, refused


def quoted_commas():
    """Decimal commas inside of quotes, between commas."""
    return people.text(people.rows(), decimal=",", quote='"')


def preamble(lines):
    return "\n".join([*lines, people.text(people.rows(), between=";")])


def ends(mark):
    """Every row ends in a delimiter, the header's does not."""
    head, *rows = people.text(people.rows(), between=mark).splitlines()
    return "\n".join([head, *(row + mark for row in rows)]) + "\n"


def row_names():
    """As R writes them: a name before each row, none above."""
    head, *rows = people.text(people.rows(), between=" ").splitlines()
    return "\n".join([head, *(f'"{k}" {row}' for k, row in enumerate(rows, 1))]) + "\n"


def index_column():
    """As pandas writes it: an unnamed number in front."""
    head, *rows = people.text(people.rows()).splitlines()
    return "\n".join([f",{head}", *(f"{k},{row}" for k, row in enumerate(rows))]) + "\n"


def aligned():
    """Columns padded with blanks to one width, as printf does."""
    lines = people.text(people.rows()).splitlines()
    return "\n".join(
        " ".join(f"{c:>12}" for c in line.split(",")) for line in lines
    )  # fmt: skip


def remarks():
    """A column of remarks over several lines, with delimiters inside."""
    table = [[*row, f'"a, b\n{k}"'] for k, row in enumerate(people.rows())]
    return people.text(table, (*people.HEADER, "remark"))


def blank_lines():
    lines = people.text(people.rows()).splitlines()
    return "\n".join([*lines[:40], "", "   ", *lines[40:], "", ""])


def units(*texts):
    """A line below the header says the units."""
    head, *rows = people.text(people.rows()).splitlines()
    return "\n".join([head, ",".join(texts), *rows]) + "\n"


LAYOUTS = {
    "units below": units("s", "", "m", "m", "rad", "m/s", "m", ""),
    "units below, in brackets": units("[s]", "[-]", *["[m]"] * 2, *["[1]"] * 4),
    "types below": units("double", "string", *["double"] * 5, "string"),
    "commas": people.text(people.rows()),
    "semicolons": people.text(people.rows(), between=";"),
    "tabs": people.text(people.rows(), between="\t"),
    "pipes": people.text(people.rows(), between="|"),
    "blanks": people.text(people.rows(), between=" "),
    "aligned": aligned(),
    "a blank behind": people.text(people.rows(), between=", "),
    "a blank behind, quoted": people.text(people.rows(), between=", ", quote='"'),
    "decimal commas": people.text(people.rows(), between=";", decimal=","),
    "decimal commas, tabs": people.text(people.rows(), between="\t", decimal=","),
    "decimal commas, quoted": quoted_commas(),
    "quoted": people.text(people.rows(), quote='"'),
    "single quotes": people.text(people.rows(), between=";", quote="'"),
    "Windows' line ends": people.text(people.rows(), end="\r\n"),
    "old Mac's line ends": people.text(people.rows(), end="\r"),
    "a line sep=": "sep=;\n" + people.text(people.rows(), between=";"),
    "comments above": preamble(["# exported 2024-05-20", "# by us; from a drone"]),
    "comments as wide as the table": preamble(
        ["# site; A40; 1; 2; 3; north; south; 7", "# t; x; in; SI; units; by; us; all"]
    ),
    "a title above": preamble(["Flight 42", "", "site; A40"]),
    "a hash before the header": "# " + people.text(people.rows(), between=" "),
    "delimiters at the ends": ends(";"),
    "row names": row_names(),
    "empty lines": blank_lines(),
    "index column": index_column(),
    "remarks of several lines": remarks(),
    "no newline at the end": people.text(people.rows()).rstrip("\n"),
}


@LONG
@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_are_recognised(tmp_path, layout, long_bytes):
    path = tmp_path / "log.csv"
    path.write_text(LAYOUTS[layout], newline="")
    source = people.spec(tmp_path, more=f"long_bytes = {long_bytes}")
    found = people.only(path, source)
    people.assert_same(found)
    assert people.rows_of(found) == (720, 0, 0, 0)


@pytest.mark.parametrize(
    "encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp1252"]
)
def test_encodings_are_recognised(tmp_path, encoding):
    header = ["Zeit", *people.HEADER[1:6], "Länge", "kind"]
    columns = {**{c: c for c in people.HEADER}, "t": "Zeit", "length": "Länge"}
    path = tmp_path / "log.csv"
    path.write_bytes(people.text(people.rows(), header, between=";").encode(encoding))
    people.assert_same(people.only(path, people.spec(tmp_path, columns)))


@pytest.mark.parametrize(
    ("written", "table"),
    [
        ({"between": "^"}, 'delimiter = "^"'),
        ({"between": ";"}, 'delimiter = "semicolon"'),
        ({"between": "\t", "decimal": ","}, 'delimiter = "tab"\ndecimal = ","'),
        ({"quote": '"'}, "quote = '\"'"),
        ({"above": "a,a,a,a,a,a,a,b\n" * 3}, "skip = 3"),
    ],
)
def test_what_the_toml_says_wins(tmp_path, written, table):
    path = tmp_path / "log.csv"
    above = written.pop("above", "")
    path.write_text(above + people.text(people.rows(), **written))
    source = people.spec(tmp_path, rest=f"[table]\n{table}")
    people.assert_same(people.only(path, source))


def test_a_table_without_a_header(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(people.text(people.rows()).partition("\n")[2])
    line = refused(path, people.spec(tmp_path))
    assert "column t: missing" in line
    assert "no header? name the columns by names in [table]" in line
    names = f"names = {list(people.HEADER)}".replace("'", '"')
    source = people.spec(tmp_path, rest=f"[table]\n{names}")
    people.assert_same(people.only(path, source))


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (
            'separator = ";"',
            "table.separator: unknown: expected some of delimiter",
        ),
        ('delimiter = "ab"', "table.delimiter: ab: expected one of tab, space"),
        ("delimiter = 3", "table.delimiter: 3: expected a text"),
        ('decimal = ";"', "table.decimal: ;: expected one of . ,"),
        ('encoding = "klingon"', "table.encoding: klingon: expected one that Python"),
        ("skip = -1", "table.skip: -1: expected a number of lines"),
        ('names = "t"', "table.names: t: expected a list of names"),
        ('decimal = ","\nthousands = ","', "table.thousands: expected another"),
        ("repeating = 9", "table.repeating: 9: expected up to 8"),
    ],
)
def test_wrong_options_of_the_layout(tmp_path, table, words):
    path = tmp_path / "log.csv"
    path.write_text(people.text(people.rows()))
    assert words in refused(path, people.spec(tmp_path, rest=f"[table]\n{table}"))


def test_a_table_without_a_cell_is_one_line(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text('"')
    assert "header: empty: expected column names" in refused(
        path, people.spec(tmp_path)
    )


@pytest.mark.parametrize(
    ("mark", "point", "between"),
    [
        (",", ".", ";"),
        (".", ",", ";"),
        (" ", ",", ";"),
        ("'", ".", ","),
        ("\u202f", ",", ";"),
    ],
)
def test_marks_between_thousands(tmp_path, mark, point, between):
    """UTM coordinates as a spreadsheet shows them: 5.702.001,760."""

    def grouped(value):
        return f"{value:,.3f}".translate({ord(","): mark, ord("."): point})

    table = people.column(people.rows(), "x", lambda x: grouped(x + 588_000.0))
    table = people.column(table, "y", lambda y: grouped(y + 5_702_000.0))
    path = tmp_path / "log.csv"
    path.write_text(people.text(table, between=between, decimal=point))
    people.assert_same(people.only(path, people.spec(tmp_path)))


def arrow_table(**changed):
    columns = zip(*people.rows(), strict=True)
    table = {name: list(c) for name, c in zip(people.HEADER, columns, strict=True)}
    return pa.table({**table, **changed})


STAMPS = [
    datetime.datetime(2024, 5, 20, 10, tzinfo=datetime.UTC)
    + datetime.timedelta(milliseconds=round(1000 * row[0]))
    for row in people.rows()
]
TYPES = {
    "as they are": {},
    "texts as categories": {
        name: pa.array([row[people.HEADER.index(name)] for row in people.rows()])
        .dictionary_encode()
        for name in ("id", "kind")
    },
    "single precision": {
        name: pa.array(
            [row[people.HEADER.index(name)] for row in people.rows()], pa.float32()
        )
        for name in ("x", "y", "heading", "speed")
    },
    "time stamps": {"t": pa.array(STAMPS, pa.timestamp("us", "UTC"))},
    "time stamps without a zone": {
        "t": pa.array([s.replace(tzinfo=None) for s in STAMPS], pa.timestamp("ms"))
    },
    "spans of time": {
        "t": pa.array([round(1e9 * row[0]) for row in people.rows()], pa.duration("ns"))
    },
    "numbers as text": {"x": [f"{row[2]:.4f}" for row in people.rows()]},
    "decimals": {
        "x": pa.array([decimal.Decimal(f"{row[2]:.3f}") for row in people.rows()])
    },
    "with an index": {"__index_level_0__": list(range(720))},
    "with lists": {"cov": [[1.0, 2.0]] * 720},
}  # fmt: skip


@pytest.mark.parametrize("write", [pq.write_table, pyarrow.feather.write_feather])
@pytest.mark.parametrize("kind", TYPES)
def test_parquet_and_feather(tmp_path, kind, write):
    path = tmp_path / "log.any"
    write(arrow_table(**TYPES[kind]), path)
    place = 0.02 if kind == "single precision" else 0.002
    people.assert_same(people.only(path, people.spec(tmp_path)), place=place)


def test_whole_numbers_are_ids_without_a_point(tmp_path):
    """A column with holes is one of floating point to pandas."""
    ids = [float(row[1][3:]) for row in people.rows()]
    path = tmp_path / "log.parquet"
    pq.write_table(arrow_table(id=ids), path)
    found = people.only(path, people.spec(tmp_path))
    assert [track.id for track in found.tracks] == ["0", "1", "2", "3", "4", "5"]
    (tmp_path / "log.csv").write_text(
        people.text(people.column(people.rows(), "id", lambda name: f"{name[3:]}.0"))
    )
    found = people.only(tmp_path / "log.csv", people.spec(tmp_path))
    assert [track.id for track in found.tracks] == ["0", "1", "2", "3", "4", "5"]


def test_a_nested_column_is_no_number(tmp_path):
    path = tmp_path / "log.parquet"
    pq.write_table(arrow_table(x=[[1.0]] * 720), path)
    assert "column x: type list<" in refused(path, people.spec(tmp_path))


@LONG
@pytest.mark.parametrize("packed", ["gzip", "zstd", "bz2", "gzip by its bytes"])
def test_packed_texts(tmp_path, packed, long_bytes):
    data = people.text(people.rows(), between=";").encode()
    if packed == "bz2":
        data = bz2.compress(data)
    elif packed == "zstd":
        data = pa.compress(data, "zstd", asbytes=True)
    else:
        data = gzip.compress(data)
    path = tmp_path / ("log.csv" if "bytes" in packed else "log.csv.gz")
    path.write_bytes(data)
    source = people.spec(tmp_path, more=f"long_bytes = {long_bytes}")
    found = people.only(path, source)
    people.assert_same(found)
    assert found.name == ("log" if long_bytes > 1 else "log-00000")


def test_damaged_packing_is_one_line(tmp_path):
    path = tmp_path / "log.csv.gz"
    whole = gzip.compress(people.text(people.rows()).encode())
    for data in (whole[:-20], whole[: len(whole) // 2], whole[:50] + b"x" * 200):
        path.write_bytes(data)
        assert "gzip: " in refused(path, people.spec(tmp_path))


def test_packed_bytes_without_an_end_are_not_held(tmp_path):
    path = tmp_path / "log.csv.gz"
    path.write_bytes(gzip.compress(b"t,id,x,y\n" + bytes(2**26)))
    assert "a line of more than 16777216 characters" in refused(
        path, people.spec(tmp_path)
    )


@pytest.mark.parametrize(
    ("head", "words"),
    [
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:1\n", "git lfs pull"),
        (b"PK\x03\x04" + bytes(60), "a spreadsheet or a zip archive: expected a table"),
        (b"\xd0\xcf\x11\xe0" + bytes(60), "an old spreadsheet: expected a table"),
        (b"SQLite format 3\0", "a database: expected a table"),
        (b"FEA1" + bytes(60), "Feather version 1: expected version 2"),
        (b"PAR1" + bytes(60), "expected Parquet"),
        (b"ARROW1" + bytes(60), "expected Feather"),
        (b"\x1f\x8b" + bytes(60), "gzip: "),
        (
            ",".join(f"c{k}" for k in range(10_001)).encode(),
            "10001 columns",
        ),
        (b"", "rows: none"),
        (b"\n \n\n", "rows: none"),
        (b'\0"', "header: empty"),
        (b"\xff\xfe" + bytes(range(1, 255)) * 3, "header: hardly any ASCII as utf-16"),
    ],
)
def test_files_that_are_no_tables(tmp_path, head, words):
    path = tmp_path / "log.csv"
    path.write_bytes(head)
    assert words in refused(path, people.spec(tmp_path))


def test_a_log_that_lies_twice_in_a_folder_is_read_once(tmp_path):
    (tmp_path / "log.csv").write_text(people.text(people.rows()))
    pq.write_table(arrow_table(), tmp_path / "log.parquet")
    pq.write_table(arrow_table(), tmp_path / "other.parquet")
    more = 'pattern = ["*.csv", "*.parquet"]'
    found = people.read(tmp_path, people.spec(tmp_path, more=more))
    assert [made.name for made in found] == ["log", "other"]
    np.testing.assert_allclose(found[0].tracks[0].x, found[1].tracks[0].x, atol=1e-3)


@pytest.mark.parametrize("form", ["text", "Parquet"])
def test_names_of_columns_in_another_case(tmp_path, form):
    header = ["T", "Id", "X", "Y", "Heading", "SPEED", "Length", "kind"]
    path = people.write(tmp_path, people.rows(), header)
    if form == "Parquet":
        columns = zip(*people.rows(), strict=True)
        pq.write_table(pa.table(dict(zip(header, columns, strict=True))), path)
    people.assert_same(people.only(path, people.spec(tmp_path)))


def test_a_name_in_its_own_case_wins(tmp_path):
    table = [[*row, 1e3 - row[2]] for row in people.rows()]
    path = people.write(tmp_path, table, (*people.HEADER, "X"))
    people.assert_same(people.only(path, people.spec(tmp_path)))


def test_a_row_of_numbers_is_no_line_of_units(tmp_path):
    """Nor is one in which the first cells are unknown."""
    table = people.rows()
    table[0][2:7] = ["NaN"] * 5
    found = people.only(people.write(tmp_path, table), people.spec(tmp_path))
    assert people.rows_of(found)[0] >= 719
    assert [track.t.size for track in found.tracks] == [119, *[120] * 5]


@LONG
@pytest.mark.parametrize("mark", [".", ","])
def test_numbers_as_text_in_parquet(tmp_path, mark, long_bytes):
    columns = zip(*people.rows(), strict=True)
    cells = [[people.cell(value, mark) for value in column] for column in columns]
    path = tmp_path / "log.parquet"
    pq.write_table(pa.table(dict(zip(people.HEADER, cells, strict=True))), path)
    source = people.spec(tmp_path, more=f"long_bytes = {long_bytes}")
    people.assert_same(people.only(path, source))


def test_a_table_beside_the_logs_that_is_none(tmp_path):
    people.write(tmp_path, people.rows())
    (tmp_path / "README.csv").write_text("file,what\nlog.csv,the flight of monday\n")
    line = refused(tmp_path, people.spec(tmp_path))
    assert "README.csv: header: ['file', 'what']: none of the columns t, id, x" in line
    assert "`pattern` of the TOML leaves out" in line
    people.assert_same(
        people.only(tmp_path, people.spec(tmp_path, more='pattern = "log*.csv"'))
    )
