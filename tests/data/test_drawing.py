"""The plan of a site as `dataset.plot()` draws it."""

import re

import pytest

from rcirl_jax import import_logs
from rcirl_jax.errors import InputError
from tests.data.small_logs import write_logs


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drawn")
    write_logs(folder / "logs", files=2)
    return import_logs(
        folder / "logs", folder / "data", format="csv", stride_s=4.0, test_fraction=0.3
    )


def test_a_notebook_shows_the_plan(dataset):
    drawn = dataset.plot()
    assert drawn._repr_svg_() == drawn
    assert drawn.startswith("<svg")
    assert drawn.rstrip().endswith("</svg>")
    lanes = len(dataset.plans()[0]["lanes"])
    areas = re.search(r'<g id="PolyCollection_1">(.*?)</g>', drawn, re.S)
    assert areas
    assert areas[1].count("<use") + areas[1].count("<path") >= lanes
    assert drawn.count("<image") >= 1  # driven ways, and the bar of their colours
    assert dataset.plot() == drawn
    assert dataset.plot(1).startswith("<svg")


@pytest.mark.parametrize("site", [-1, 2])
def test_a_site_that_has_no_plan(dataset, site):
    with pytest.raises(InputError, match=f"^site: {site}: expected a number below 2"):
        dataset.plot(site)
