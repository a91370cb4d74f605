"""Files made to harm: pickles, paths that lead out, nesting, sizes that are claimed."""

import io
import pickle
import re
import zipfile

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from benchmarks.reliability.fuzz.forms import archive_of
from benchmarks.reliability.fuzz.readers import suite
from rcirl_jax.data.readers.tables import table
from rcirl_jax.data.readers.tables.rows import RowStats
from rcirl_jax.data.readers.xml import read_xml
from rcirl_jax.evaluation.closed_loop.runs import read_runs
from rcirl_jax.runtime.specs import load_toml
from tests.conftest import REPO
from tests.data.formats import people
from tests.data.formats.test_conformance import Bomb
from tests.helpers.logs import read, refused

DEEP = 100_000  # levels


# ------------------------------------------------------------------- suites, npz


@pytest.fixture
def members(tmp_path):
    """(file of a suite, its members)."""
    (tmp_path / "made").mkdir()
    suite(tmp_path / "made")
    file = tmp_path / "made" / "suite.npz"
    with zipfile.ZipFile(file) as archive:
        return file, {name: archive.read(name) for name in archive.namelist()}


def npy(array, **options):
    out = io.BytesIO()
    np.save(out, array, **options)
    return out.getvalue()


def head(shape, kind="<f8"):
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"
    text = text.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


def test_pickles_in_a_suite_are_not_loaded(members, tmp_path):
    file, content = members
    bomb = Bomb(tmp_path / "executed")
    objects = npy(np.array([bomb], dtype=object), allow_pickle=True)
    with_bomb = archive_of({**content, "ids.npy": objects})
    for data in (with_bomb, objects, pickle.dumps(bomb)):
        file.write_bytes(data)
        assert str(file) in refused(read_runs, file)
    assert not (tmp_path / "executed").exists()


METRICS = "expected the metrics of a suite"
BAD_MEMBERS = [
    ("way", head((2**62,)) + bytes(64), "of float64 in 64 bytes: expected the"),
    # a list of many times nothing would take terabytes
    ("ids", head((2**40, 0, 0)), METRICS),
    ("way", head(2, "(,)f8"), METRICS),
    ("way", npy(np.array(["far", "near"])), METRICS),
    ("row0.start_time", None, METRICS),
]


@pytest.mark.parametrize(("name", "data", "words"), BAD_MEMBERS)
def test_members_of_a_suite_that_are_none(members, name, data, words):
    file, content = members
    content[f"{name}.npy"] = data
    kept = {member: found for member, found in content.items() if found is not None}
    file.write_bytes(archive_of(kept))
    line = refused(read_runs, file)
    assert words in line
    assert data is not None or name in line


# ------------------------------------------------------------------- TOML and XML


def toml(folder, text):
    """The line that refuses a TOML."""
    (folder / "x.toml").write_text(text)
    return refused(load_toml, folder / "x.toml")


LISTS, TABLES = ("[", "", "]"), ("{a=", "1", "}")


@pytest.mark.parametrize(("way", "count"), [(TABLES, 110), (LISTS, DEEP)])
def test_deep_nesting_is_one_line(tmp_path, way, count):
    text = "a = " + way[0] * count + way[1] + way[2] * count
    assert "nested too deeply" in toml(tmp_path, text)


KEYS = ["{key} = 1", "[[{key}]]", "b = {{c = '''\n\" ''', {key} = 1}}"]


@pytest.mark.parametrize("text", KEYS)
@pytest.mark.parametrize(("joined", "part"), [(".", "a"), (" .\t", '"a.b"')])
def test_keys_of_many_parts(tmp_path, text, joined, part):
    """The parser takes minutes for some thousands of them."""
    line = toml(tmp_path, text.format(key=joined.join([part] * 33)))
    assert re.search("x.toml: line [123]: .*32 parts", line)
    file = tmp_path / "x.toml"
    file.write_text(text.format(key=joined.join([part] * 32)))
    assert load_toml(file)


def test_long_numbers_and_files_in_a_toml(tmp_path, monkeypatch):
    assert "x.toml: " in toml(tmp_path, "a = " + "9" * 5000)
    for number in ("0x" + "f" * 4000, "9" * 4000, "-9223372036854775809"):
        line = toml(tmp_path, f"[b]\na = [{{c = {number}}}]")
        assert re.search(r"b.a.c: a number of \d+ bits: expected at most 63", line)
    text = "a = [-9223372036854775808, 0x7fffffffffffffff]"
    (tmp_path / "x.toml").write_text(text)
    assert load_toml(tmp_path / "x.toml")["a"] == [-(2**63), 2**63 - 1]
    monkeypatch.setattr("rcirl_jax.runtime.specs.MAX_BYTES", 10)
    assert "size: expected at most" in toml(tmp_path, text)


REPEATED = '<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">'
OUTSIDE = 'SYSTEM "file:///etc/hostname"'


@pytest.mark.parametrize("dtd", [f"[{REPEATED}]", f"[<!ENTITY x {OUTSIDE}>]", OUTSIDE])
def test_xml_of_entities_or_references_is_refused(tmp_path, dtd):
    file = tmp_path / "x.xml"
    file.write_text(f"<!DOCTYPE b {dtd}><osm/>")
    line = refused(read_xml, file, "osm", 10_000)
    assert line.endswith("expected no DTD, entities or external references")
    assert "size: " in refused(read_xml, file, "osm", 3)


# ----------------------------------------------------------------------- options


BAD = ("../*.csv", "/etc/*", "", "**/**/x.csv")
BAD_OPTIONS = [
    *[(f'pattern = "{bad}"', f"pattern: {bad}: expected file names") for bad in BAD],
    ("max_bad_rows = 1.0", "max_bad_rows: 1: expected a share from 0 to below 1"),
    ("rate_hz = 5" + "0" * 18, "expected at most 1e+18"),
    ("lanes = [3]", "lanes: [3]: expected tables"),
    (f'lanes = {{file = "{"a/" * 3000}x"}}', "a path of 6001 bytes: expected"),
]


@pytest.mark.parametrize(("text", "words"), BAD_OPTIONS)
def test_options_that_lead_out_or_are_of_another_type(text, words, tmp_path):
    people.write(tmp_path, people.rows())
    source = people.spec(tmp_path, more=text)
    assert words in refused(read, "csv", tmp_path, source)


# ------------------------------------------------------------------------ readers


@pytest.mark.parametrize(
    ("name", "words"), [("MAX_GROUP_BYTES", "row group: "), ("MAX_ROWS", "rows: 100")]
)
def test_row_groups_that_claim_too_much(tmp_path, monkeypatch, name, words):
    file = tmp_path / "x.parquet"
    pq.write_table(pa.table({"a": list(range(100))}), file)

    def numbers():
        opened = table.open_table(file)
        fields = table.fields_of(opened, {"a": "number"})
        return table.read(opened, fields, RowStats(path=file))

    np.testing.assert_array_equal(numbers()["a"], np.arange(100.0))
    monkeypatch.setattr(f"rcirl_jax.data.readers.tables.columnar.{name}", 10)
    assert f"x.parquet: {words}" in refused(numbers)


# ------------------------------------------------------------------- no programs

FORBIDDEN = re.compile(
    r"os\.system|os\.popen|shell\s*=\s*True|\bimport pickle|from pickle|\bmarshal\b"
    r"|(?<![\w.])eval\(|(?<![\w.])exec\(|yaml\.(?:unsafe_)?load\b|allow_pickle\s*=\s*True"
)
# arithmetic of scenario families, its syntax tree checked node by node before
CHECKED = {"rcirl_jax/simulation/families.py": "eval("}


def test_no_module_runs_what_a_file_says():
    for folder in ("rcirl_jax", "experiments"):
        for file in sorted((REPO / folder).rglob("*.py")):
            name = file.relative_to(REPO).as_posix()
            found = set(FORBIDDEN.findall(file.read_text()))
            assert found <= {CHECKED.get(name)}, f"{name}: {found}"


def test_members_that_name_places_outside_are_not_unpacked(members, tmp_path):
    file, content = members
    for name in ("../odd.npy", f"{tmp_path}/odd.npy"):
        file.write_bytes(archive_of({**content, name: content["way.npy"]}))
        assert read_runs(file).ids == ("a", "b")
    assert not list(tmp_path.rglob("odd.npy"))
