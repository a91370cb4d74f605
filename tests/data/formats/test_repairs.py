"""What can be repaired is, and noted: rows, states and ids that are met twice, regions
for places, files without rows. What is wrong throughout stays an error."""

import pytest

from rcirl_jax.data.formats import read_recordings
from rcirl_jax.data.formats.tracks import of_one_name
from tests.data.formats import writers as w
from tests.data.formats.fixtures import waymo
from tests.data.formats.test_conformance import format_of, write
from tests.helpers import logs


def has_note(recording, words):
    return any(words in note for note in recording.notes)


# -------------------------------------------------------------------------- met twice


def test_tracks_of_one_id(tmp_path):
    """Waymo's and CommonRoad's: the longest counts."""
    fixture = waymo.write(tmp_path)
    waymo.cars(count=2)(fixture)
    made = logs.only("waymo", fixture.input)
    assert [track.id for track in made.tracks] == ["1"]
    assert has_note(made, "1 tracks with the id of another left out")
    parts = (w.lanelet(), w.car(count=20), w.car(count=40))
    made = logs.only("commonroad", w.commonroad(tmp_path / "a.xml", *parts))
    assert [track.t.size for track in made.tracks] == [40]
    assert has_note(made, "1 tracks with the id of another left out")
    kept, notes = of_one_name([*made.tracks] * 3)
    assert (len(kept), notes) == (3, [])


# ---------------------------------------------------------------------------- regions


# ------------------------------------------------------------------------ without rows

TABLES = ("csv", "interaction", "levelx", "ngsim_pairs", "openacc")


@pytest.mark.parametrize("name", TABLES)
def test_a_table_without_rows_is_empty(name, tmp_path):
    """It is a recording without traffic, which an import counts and skips."""
    fixture = write(name, tmp_path)
    log = fixture.files[0]
    lines = log.read_text().splitlines(keepends=True)
    head = next(k for k, line in enumerate(lines) if line[:1].isdigit())
    log.write_text("".join(lines[:head]))
    (made, *_) = read_recordings(format_of(name), log)
    assert made.tracks == ()
    assert has_note(made, "rows: none")
