"""SQLite files of others: what is in them is not run, and work is bounded."""

import hashlib
import os
import sqlite3

import pytest

from rcirl_jax.data.readers import sqlite
from rcirl_jax.errors import InputError
from tests.helpers.logs import refused


@pytest.fixture
def file(tmp_path):
    """A table of a thousand numbers, with a trigger; its name is no URI's."""
    path = tmp_path / "a?mode=rwc#%41 b.db"
    database = sqlite3.connect(path)
    database.execute("CREATE TABLE log (x FLOAT, 'the \"shape\"' BLOB)")
    database.executemany(
        "INSERT INTO log VALUES (?, x'00')", [(k,) for k in range(1000)]
    )
    trigger = "BEFORE INSERT ON log BEGIN SELECT load_extension('x'); END"
    database.execute(f"CREATE TRIGGER t {trigger}")
    database.commit()
    database.close()
    return path


def numbers(path, sql="SELECT x FROM log"):
    with sqlite.Database(path) as database:
        return database.numbers(sql, ("x",), 10**12)


def test_a_file_is_left_as_it_is_and_those_beside_it_are_not_read(file):
    """immutable=1: a planted journal changes nothing."""
    before = hashlib.sha256(file.read_bytes()).hexdigest()
    for suffix in ("-wal", "-journal", "-shm"):
        file.with_name(file.name + suffix).write_bytes(os.urandom(4096))
    assert numbers(file).sum() == 499500.0
    assert hashlib.sha256(file.read_bytes()).hexdigest() == before
    assert len(list(file.parent.iterdir())) == 4


def test_work_is_bounded(file, monkeypatch):
    """A join without end stops after steps in proportion to the file."""
    monkeypatch.setattr(sqlite, "MIN_STEPS", 1_000_000)
    monkeypatch.setattr(sqlite, "STEPS_PER_BYTE", 0)
    with pytest.raises(InputError, match="too much work for the file's size"):
        numbers(file, "SELECT a.x FROM log AS a, log AS b, log AS c")


@pytest.mark.parametrize(
    "sql",
    [
        "DELETE FROM log",
        "ATTACH DATABASE ':memory:' AS other",
        "SELECT load_extension('x')",
        "PRAGMA writable_schema = ON",
        "WITH RECURSIVE n(x) AS (SELECT 1 UNION SELECT x FROM n) SELECT x FROM n",
    ],
)
def test_only_select_is_authorised(file, sql):
    assert "database: " in refused(numbers, file, sql)
