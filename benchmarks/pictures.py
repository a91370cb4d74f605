"""Draws docs/pictures and docs/report.png, which the pages show.

    python -m benchmarks.pictures --runs=RUN,RUN --data=US101,URBAN,I80

The first RUN (of `rcirl autotune`) is the one of docs/results.md; the others are set
beside it. DATA are its datasets; example scenes come from the first. Numbers come from
benchmarks/results. Pages are photographed by Chromium, which playwright drives; needs
the extra [test]. Ten minutes. `--only=NAME,NAME` draws some.
"""

import contextlib
import dataclasses
import io
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from absl import app, flags
from PIL import Image

from benchmarks.drawings import driven, ideas, numbers, recorded
from rcirl_jax.cli.running import provenance
from rcirl_jax.data.store.dataset import open_dataset, open_datasets
from rcirl_jax.export.loading import open_reward
from rcirl_jax.report.compare import read_run, write_comparison
from rcirl_jax.report.data_page import write_data_page
from rcirl_jax.report.features import contributions, response_curves

if TYPE_CHECKING:
    from playwright.sync_api import Page

_RUNS = flags.DEFINE_list("runs", None, "folders of `rcirl autotune`", required=True)
_DATA = flags.DEFINE_list("data", None, "datasets of the first run", required=True)
_OUTPUT = flags.DEFINE_string("output", "docs/pictures", "folder of the PNGs")
_ONLY = flags.DEFINE_list("only", [], "names of the pictures to draw; all if empty")

COLOURS = 256  # of a picture
FIRST_EVENT = "document.querySelector('#events button').click()"


@contextlib.contextmanager
def browser_page(file: Path, width: int = 1000) -> Iterator["Page"]:
    """A page of ours in a headless Chromium, light."""
    from playwright.sync_api import sync_playwright

    path = shutil.which("chromium") or shutil.which("google-chrome")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        size = {"width": width, "height": 1400}
        view = browser.new_page(viewport=size, color_scheme="light")
        view.goto(file.resolve().as_uri())
        yield view
        browser.close()


def photograph(view: "Page", path: Path, first: str, last: str, most: int) -> None:
    """From the top of one element to the end of another, `most` pixels at most."""
    boxes = [view.locator(at).first.bounding_box() for at in (first, last)]
    top, end = int(boxes[0]["y"]), int(boxes[1]["y"] + boxes[1]["height"]) + 4
    end = min(end, top + most)
    width = view.viewport_size["width"]
    view.set_viewport_size({"width": width, "height": end})
    shot = Image.open(io.BytesIO(view.screenshot()))
    shot.crop((0, top, width, end)).save(path)


def report_part(
    first: str, last: str, most: int, prepare: str = "", width: int = 1000
) -> Callable:
    """A part of the first run's report.html, after a line of JavaScript."""

    def made(path: Path) -> None:
        with browser_page(Path(_RUNS.value[0]) / "report.html", width) as view:
            if prepare:
                view.evaluate(prepare)
            photograph(view, path, first, last, most)

    return made


def compare(path: Path) -> None:
    """The page of `rcirl compare`."""
    read = [read_run(Path(name)) for name in _RUNS.value]
    runs = [dataclasses.replace(run, name=Path(run.name).name) for run in read]
    with tempfile.TemporaryDirectory() as folder:
        page = write_comparison(Path(folder) / "page.html", runs, provenance())
        with browser_page(page) as view:
            photograph(view, path, "h1", "table.forest >> nth=1", 1200)


def inspect(path: Path) -> None:
    """The data-quality page of the first dataset."""
    data = open_dataset(_DATA.value[0], verify=False)
    with tempfile.TemporaryDirectory() as folder:
        page = write_data_page(Path(folder) / "a.html", data, [0], "Dataset us101", {})
        with browser_page(page) as view:
            photograph(view, path, "h2 >> nth=1", "table >> nth=2", 1200)


def responses(path: Path) -> None:
    """Response curves of the eight features that matter most, as in the report."""
    name, reward = "V", open_reward(weights())
    found = contributions(open_datasets(_DATA.value, verify=False), {name: reward})
    found = dataclasses.replace(found, rows=found.rows[:8])
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "page.html"
        page.write_text(
            f"<body style='margin:8px'>{response_curves({name: reward}, found)}"
        )
        with browser_page(page, 1080) as view:
            photograph(view, path, "svg", "svg", 1000)


def weights() -> str:
    """The weights file of the first run."""
    return str(Path(_RUNS.value[0]) / "weights.msgpack")


# ------------------------------------------------------------------------ all

PICTURES: Mapping[str, Callable[[Path], None]] = {
    "chain": ideas.chain,
    "features": ideas.features,
    "planner": lambda path: driven.planner(path, weights()),
    "families": driven.family_views,
    "labels": lambda path: recorded.labels(path, _DATA.value),
    "guard": lambda path: recorded.guard(path, weights(), _DATA.value),
    "elsewhere": lambda path: driven.elsewhere(path, weights()),
    "differences": numbers.families,
    "closed_loop": numbers.closed_loop,
    "rankings": numbers.rankings,
    "sweep": numbers.sweep,
    "gamma": numbers.gamma,
    "responses": responses,
    "../report": report_part("h1", "#verdict details", 560, width=1280),
    "cases": report_part("#cases-table", "#cases-table tr >> nth=6", 600, width=1150),
    "player": report_part("#player", "#player .legend >> nth=-1", 900, FIRST_EVENT),
    "checks": report_part("#checks", "#checks table >> nth=1", 800),
    "compare": compare,
    "inspect": inspect,
}
flags.register_validator(
    "only",
    lambda names: set(names) <= set(PICTURES),
    f"expected names among {', '.join(PICTURES)}",
)


def shrink(path: Path) -> None:
    """Fewer colours, no metadata."""
    picture = Image.open(path).convert("RGB")
    few = picture.quantize(
        COLOURS, Image.Quantize.MAXCOVERAGE, kmeans=1, dither=Image.Dither.NONE
    )
    few.save(path, optimize=True)


def main(_: Sequence[str]) -> None:
    """Draw and shrink."""
    folder = Path(_OUTPUT.value)
    folder.mkdir(parents=True, exist_ok=True)
    for name in _ONLY.value or PICTURES:
        path = folder / f"{name}.png"
        PICTURES[name](path)
        shrink(path)
        print(f"written: {path}, {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    app.run(main)
