"""A bar that says why it stands still."""

import io

from rcirl_jax.runtime.bars import NOTE, CompilesFirst


def test_the_note_goes_with_the_first_update():
    said = io.StringIO()
    with CompilesFirst(total=2, desc="drive", unit="case", file=said) as bar:
        assert said.getvalue().rstrip().endswith(f"{NOTE}]")
        bar.update()
        bar.refresh()
        assert NOTE not in said.getvalue().split("\r")[-1]
        bar.set_postfix_str("loss=1")
        bar.update()
    assert "loss=1" in said.getvalue().split("\r")[-1]


def test_a_bar_not_shown_says_nothing():
    said = io.StringIO()
    with CompilesFirst(total=2, file=said, disable=True) as bar:
        bar.update()
    assert said.getvalue() == ""
