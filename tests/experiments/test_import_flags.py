"""Flags that every command with an import has."""

import pytest

from rcirl_jax.cli.flags.importing import left_out
from rcirl_jax.errors import InputError


@pytest.mark.parametrize(
    ("text", "found"), [("0", (0, 0.0)), ("3", (3, 0.0)), ("5%", (0, 0.05))]
)
def test_a_count_or_a_share_is_left_out(text, found):
    assert left_out(text) == found


@pytest.mark.parametrize("text", ["-1", "0.5", "100%", "-3%", "few", "nan%", ""])
def test_other_words_are_refused(text):
    with pytest.raises(InputError, match=r"--leave_out: .*expected a count"):
        left_out(text)
