"""What no log says is counted: limits, widths of lanes, sizes of road users."""

import dataclasses
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats import read_recordings
from rcirl_jax.data.formats.perception import Boxes, on_clock, tracks_of
from rcirl_jax.types import Kind
from tests.data.formats import people
from tests.data.formats.test_conformance import counts, write


def test_what_the_users_own_toml_states_is_no_guess(tmp_path):
    """Its limit is that of fitted lanes, its [ego] the size of the recording car."""
    fixture = write("apollo", tmp_path)
    source = tmp_path / "drives.toml"
    source.write_text("rate_hz = 10.0\n")
    found = read_recordings("apollo", fixture.input, source)
    assert counts(found) == fixture.assumed
    source.write_text("speed_limit = 13.9\n[ego]\nlength = 4.4\nwidth = 1.9\n")
    (made,) = read_recordings("apollo", fixture.input, source)
    assert counts([made]) == (0, 4, 0)
    assert {lane.speed_limit for lane in made.lanes} == {made.default_speed_limit}
    assert made.default_speed_limit == 13.9


def test_a_table_of_ones_own(tmp_path):
    """Without sizes, without widths; cells may be empty here and there."""
    bare = people.write(tmp_path, [row[:4] for row in people.rows()], people.HEADER[:4])
    source = people.spec(tmp_path, people.HEADER[:4])
    made = people.only(bare, source)
    assert counts([made]) == (len(made.lanes), len(made.lanes), people.CARS)
    table = people.column(people.rows(), "length", lambda _: "")
    table[0][people.HEADER.index("length")] = 4.5  # of car0, whose width nobody says
    source = people.spec(tmp_path, more="speed_limit = 13.9\n")
    made = people.only(people.write(tmp_path, table), source)
    assert counts([made]) == (0, len(made.lanes), people.CARS)
    assert [track.length for track in made.tracks] == [4.5] * people.CARS
    header = (*people.HEADER, "width")
    table = [[*row, 1.9 if row[1] != "car0" else ""] for row in people.rows()]
    made = people.only(
        people.write(tmp_path, table, header), people.spec(tmp_path, header)
    )
    assert counts([made])[2] == 1


def test_sizes_that_are_measured_here_and_there():
    """The median of those that are; one that never is goes by the class."""
    t = np.arange(21) * 0.1
    boxes = Boxes(
        ids=np.zeros(21, int),
        names=("7",),
        t=t,
        x=8.0 * t,
        y=0.0 * t,
        heading=0.0 * t,
        speed=np.full(21, 8.0),
        length=np.where(np.arange(21) % 2, np.nan, 5.0),
        width=np.full(21, np.nan),
        kind=np.full(21, int(Kind.CYCLIST)),
    )
    ((track,), notes) = tracks_of(Path("a.log"), on_clock(boxes, 10.0, 0.5), 0.5)
    assert (track.length, track.width, track.size_assumed) == (5.0, 0.6, True)
    known = dataclasses.replace(boxes, width=np.full(21, 0.7))
    ((track,), notes) = tracks_of(Path("a.log"), on_clock(known, 10.0, 0.5), 0.5)
    assert (track.length, track.width, track.size_assumed) == (5.0, 0.7, False)
    assert notes == []
