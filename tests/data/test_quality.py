"""The data-quality report: notes of several recordings, and what they say."""

from rcirl_jax.data.quality import merged_notes, oddities

LANES = "no lanes given; 4 estimated from all tracks of 4 files"


def test_equal_notes_of_several_recordings_are_one_line():
    """What stands first in a recording comes first; the order of recordings is kept."""
    notes = [
        *[("a", LANES), ("a", "heading read as x"), ("a", "5 rows met twice")],
        *[("b", LANES), ("b", "heading read as x"), ("b", "7 rows met twice")],
        *[("c", LANES), ("c", "heading read as x")],
    ]
    assert merged_notes(notes) == [
        f"a and 2 more: {LANES}",
        "a and 2 more: heading read as x",
        "a: 5 rows met twice",
        "b: 7 rows met twice",
    ]
    twice = [[name, note] for name, note in notes] + [["a", LANES]]  # as JSON has them
    assert merged_notes(twice) == merged_notes(notes)
    assert merged_notes([]) == []


def test_what_is_assumed_says_of_what():
    report = {"recordings": 4, "notes": ["x"], "num_notes": 1}
    counts = {"width": 60, "lanes": 68, "size": 3, "road users": 900}
    assert oddities({**report, "assumed": counts}) == [
        "assumed, as the log does not say: width of 60 of 68 pieces of lanes, size of "
        "3 of 900 road users, counted in each of 4 recordings",
        "note: x",
    ]
