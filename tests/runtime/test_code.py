"""A stage is kept unless code that it uses has changed."""

import pytest

from rcirl_jax.runtime import code
from rcirl_jax.runtime.code import code_of, used_by

FILES = {
    "__init__": "",
    "a": '"""What a does."""\nfrom pack.b import value\n',
    "b": "def value():\n    from pack import c\n    return c.NUMBER\n",
    "c": "NUMBER = 1\n",
    "alone": "import math\n",
}


@pytest.fixture
def package(tmp_path):
    folder = tmp_path / "pack"
    folder.mkdir()
    for name, text in FILES.items():
        (folder / f"{name}.py").write_text(text)
    return folder


def changed(package, name, text):
    code._parsed.cache_clear()
    before = code_of(["pack.a"], package)
    (package / f"{name}.py").write_text(text)
    code._parsed.cache_clear()
    return code_of(["pack.a"], package) != before


def test_what_is_imported_anywhere_is_used(package):
    assert list(used_by(["pack.a"], package)) == ["pack", "pack.a", "pack.b", "pack.c"]


@pytest.mark.parametrize(
    ("name", "text", "counts"),
    [
        ("c", "NUMBER = 2\n", True),
        ("b", "def value():\n    return 1\n", True),
        ("__init__", "import os\n", True),
        ("a", '"""Said otherwise."""\n\n# why\nfrom pack.b import value\n', False),
        ("alone", "import os\n", False),
        ("c", "NUMBER = (1)  # one\n", False),
        ("c", "NUMBER = 1\nif TYPE_CHECKING:\n    from pack import alone\n", False),
    ],
)
def test_code_that_is_used_counts_and_words_do_not(package, name, text, counts):
    assert changed(package, name, text) == counts


def test_the_report_decides_no_training_and_an_importer_no_suite():
    """What each group of stages uses of this package."""
    stages = {
        name: set(used_by([f"rcirl_jax.tune.{name}"]))
        for name in ("demonstrations", "rewards", "evidence", "report")
    }
    pages = "rcirl_jax.report.pages"
    assert [pages in used for used in stages.values()] == [False, False, False, True]
    reader = "rcirl_jax.data.formats.ngsim.reader"
    assert reader in stages["demonstrations"]
    assert reader not in stages["rewards"] | stages["evidence"]
    assert "rcirl_jax.simulation.rollout" in stages["evidence"]
    assert "rcirl_jax.reward.losses" in stages["rewards"]
