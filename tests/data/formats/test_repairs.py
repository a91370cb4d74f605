"""What can be repaired is, and noted: rows, states and ids that are met twice, regions
for places, files without rows. What is wrong throughout stays an error."""

import numpy as np
import pytest

from rcirl_jax.data.formats import read_recordings
from rcirl_jax.data.formats.tracks import of_one_name, once_each
from tests.data.formats import writers as w
from tests.data.formats.fixtures import waymo
from tests.data.formats.test_conformance import format_of, write
from tests.helpers import logs


def has_note(recording, words):
    return any(words in note for note in recording.notes)


# -------------------------------------------------------------------------- met twice


def test_rows_of_one_time_count_once():
    ids, t = np.array([1, 2, 1, 1, *[3] * 200]), np.array([0.0, 0, 0, 1, *range(200)])
    kept, (note,) = once_each(ids, t)
    np.testing.assert_array_equal(kept, [0, 1, *range(3, 204)])
    assert note.startswith("1 states of a road user met twice")
    for ids in (np.zeros(204, int), np.arange(204)):  # many of them, and none
        kept, notes = once_each(ids, np.repeat(t[:102], 2))
        assert (kept.size, notes) == (204, [])


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

CIRCLE = "<circle><radius>1</radius><center><x>3</x><y>1</y></center></circle>"
POLYGON = "<polygon>{}</polygon>".format(
    "".join(w.POINT.format(*p) for p in [(2, 0), (4, 0), (4, 2), (2, 2)])
)


@pytest.mark.parametrize("shapes", [CIRCLE, POLYGON, CIRCLE + POLYGON])
def test_a_region_is_its_middle(tmp_path, shapes):
    place = w.POINT.format(3, 1)
    states = [w.state(1, 1.5, 0.5), w.state(2, 3, 1).replace(place, shapes)]
    path = w.commonroad(tmp_path / "a.xml", w.lanelet(), w.car(states=states))
    made = logs.only("commonroad", path)
    np.testing.assert_allclose([made.tracks[0].x[2], made.tracks[0].y[2]], [3.0, 1.0])
    assert has_note(made, "1 states in a region")


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
