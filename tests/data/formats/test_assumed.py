"""What no log says is counted: limits, widths of lanes, sizes of road users."""

from rcirl_jax.data.formats import read_recordings
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
