"""The page of a dataset: complete, self-contained, safe, and true to the manifest."""

import re
from html.parser import HTMLParser

import msgspec
import numpy as np
import pytest

from rcirl_jax.data.importing import import_logs
from rcirl_jax.data.scenes.filters import REASONS
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.errors import InputError
from rcirl_jax.report.data_page import choose_rows, write_data_page
from rcirl_jax.types import Tag
from tests.data.small_logs import CONFIG, write_logs
from tests.helpers.commands import succeeded

FACTS = {"git_commit": "abc", "versions": {"jax": "1"}, "flags": {"scenes": 3}}
HOSTILE = '"><script>alert(1)</script><img src=x onerror=alert(2)>'


class Page(HTMLParser):
    """Tags, and the text of the cells by row."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.rows, self.in_cell = [], [], False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
            self.in_cell = True

    def handle_endtag(self, tag):
        if tag in ("td", "th"):
            self.rows[-1][-1] = " ".join(self.rows[-1][-1].split())
            self.in_cell = False

    def handle_data(self, data):
        if self.in_cell:
            self.rows[-1][-1] += data

    def of(self, tag):
        return [attrs for name, attrs in self.tags if name == tag]


def assert_it_needs_no_other(text):
    """A page loads nothing from elsewhere and has no handler in its markup."""
    found = Page(text)
    assert not found.of("link")
    for tag, attrs in found.tags:
        for name in ("src", "href", "srcset", "action", "data", "poster"):
            value = attrs.get(name) or "#"
            assert value.startswith(("#", "data:image/png;base64,")), (tag, name)
        assert not any(name.startswith("on") for name in attrs)
    loads = r"url\((?!#)|@import|\beval\(|new Function|fetch\(|XMLHttp"
    assert not re.search(loads, text)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    import_logs(write_logs(folder / "logs", 2), folder / "set", CONFIG)
    return open_dataset(folder / "set")


@pytest.fixture(scope="module")
def page(dataset, tmp_path_factory):
    output = tmp_path_factory.mktemp("page") / "index.html"
    return write_data_page(output, dataset, [0, 3, 5], "Dataset a", FACTS).read_text()


def test_it_is_one_file_that_needs_no_other(page):
    assert_it_needs_no_other(page)
    assert not Page(page).of("script")
    assert len(Page(page).of("img")) == 5  # scenes, and the plans of two recordings


def test_counts_and_reasons_are_those_of_the_manifest(page, dataset):
    rows = Page(page).rows
    quality = dataset.manifest.quality
    for name, words in REASONS.items():
        (row,) = [row for row in rows if row and row[-1] == words]
        assert row[1] == f"{quality['dropped'][name]:,}"
    assert ["kept", f"{quality['scenes']:,}", "", ""] in rows
    first = {row[0]: row[1] for row in rows if len(row) == 4}
    for name, count in quality["tags"].items():
        assert first[name.replace("_", " ")] == f"{count:,}"
    for name, count in quality["decisions"].items():
        assert first[name.replace("_", " ")] == f"{count:,}"


def test_names_from_the_logs_are_text(dataset, tmp_path):
    manifest = dataset.manifest
    quality = manifest.quality | {"notes": [HOSTILE], "num_notes": 1}
    hostile = msgspec.structs.replace(
        manifest,
        quality=quality,
        sources=[{"source": HOSTILE, "licence": HOSTILE}],
        recordings=[HOSTILE] * len(manifest.recordings),
        vehicles=[HOSTILE] * len(manifest.vehicles),
    )
    other = open_dataset(dataset._files.folder)
    other.manifest = hostile
    plans = [{**x, "name": HOSTILE, "notes": [HOSTILE]} for x in dataset.plans()]
    other.plans = lambda: plans
    page = Page(
        write_data_page(tmp_path / "a.html", other, [0], HOSTILE, FACTS).read_text()
    )
    assert not page.of("script")
    assert len(page.of("img")) == 3
    assert not any("onerror" in attrs for _, attrs in page.tags)


def test_chosen_rows_cover_the_tags_and_are_the_same_each_time():
    rng = np.random.default_rng(0)
    tags = rng.random((5000, len(Tag))) < 0.3
    tags[:, Tag.STANDING] = False
    tags[4321, Tag.STANDING] = True
    rows = choose_rows(tags, 24)
    assert rows == choose_rows(tags, 24)
    assert rows == sorted(set(rows))
    assert len(rows) == 24
    assert tags[rows].any(axis=0).all()
    assert 4321 in rows
    only = choose_rows(tags, 50, ["turning"])
    assert tags[only, Tag.TURNING].sum() == len(only) == 50
    assert max(only) - min(only) > 2500


def test_what_there_is_not_is_one_line(dataset, tmp_path):
    none = np.zeros((9, len(Tag)), bool)
    for tag, line in (("turnig", "expected stopping, "), ("standing", "no such scene")):
        with pytest.raises(InputError, match=f"{tag}: {line}"):
            choose_rows(none, 5, [tag])
    with pytest.raises(InputError, match=r"rows: 1000000: expected 0 to \d+"):
        write_data_page(tmp_path / "a.html", dataset, [10**6], "a", FACTS)
    assert not list(tmp_path.iterdir())


@pytest.mark.multiprocess
def test_by_command(dataset, tmp_path):
    flags = (f"--data={dataset._files.folder}", f"--output={tmp_path / 'out'}")
    succeeded("rcirl_jax", "inspect", *flags, "--rows=1,2")
    names = sorted(path.name for path in (tmp_path / "out" / "scenes").iterdir())
    assert names == ["scene0000001.png", "scene0000002.png"]
