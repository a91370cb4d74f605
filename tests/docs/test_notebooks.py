"""docs/notebooks: what stands in them, and that it comes out again."""

import re

import nbformat
import pytest

import rcirl_jax
from tests.docs.notebooks import NOTEBOOKS, executed
from tests.docs.pages import REPO

NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
by_name = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def cells_of(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def said(cell):
    """What a cell printed, without progress bars."""
    texts = [x.text for x in cell.outputs if x.get("name") == "stdout"]
    return "".join(texts)


@by_name
def test_it_was_run_from_top_to_bottom_and_names_what_there_is(path):
    cells = cells_of(nbformat.read(path, 4))
    assert [cell.execution_count for cell in cells] == [*range(1, len(cells) + 1)]
    assert not [x for cell in cells for x in cell.outputs if x.output_type == "error"]
    assert any(said(cell) for cell in cells)
    text = "\n".join(cell.source for cell in cells)
    used = set(re.findall(r"\brcirl_jax\.(\w+)\(", text))
    assert used
    assert used <= set(rcirl_jax.__all__)


@pytest.mark.slow
@pytest.mark.multiprocess
@by_name
def test_it_comes_out_again(path, monkeypatch):
    """To the word; numbers of a training to a few per cent."""
    monkeypatch.setenv("PYTHONPATH", str(REPO))
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    stored, again = nbformat.read(path, 4), executed(path)
    for before, after in zip(cells_of(stored), cells_of(again), strict=True):
        old, new = said(before), said(after)
        assert NUMBER.sub("N", new).split() == NUMBER.sub("N", old).split()
        numbers = [float(x) for x in NUMBER.findall(old)]
        assert [float(x) for x in NUMBER.findall(new)] == pytest.approx(
            numbers, rel=0.1, abs=0.1
        )
