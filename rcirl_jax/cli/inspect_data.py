"""Look at a dataset: a picture per scene, and the data-quality report as a page.

    rcirl inspect --data=DATASET --output=FOLDER

Writes FOLDER/index.html, one file that can be mailed, and FOLDER/scenes/*.png: the
scene from above, its station-time graph and the human's speed, with the labels.
Scenes are chosen over all tags, or by --tags or --rows. Takes half a second each.
Needs the extra [report].
"""

from pathlib import Path

from absl import flags

from rcirl_jax.cli.running import provenance
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.errors import InputError

USUAL = ("data", "output", "scenes", "tags", "rows")
_DATA = flags.DEFINE_string("data", None, "dataset of `rcirl import`", required=True)
_OUTPUT = flags.DEFINE_string("output", None, "folder to write", required=True)
_SCENES = flags.DEFINE_integer("scenes", 24, "scenes to draw, 1 or more", 1)
_TAGS = flags.DEFINE_list(
    "tags", [], "draw only scenes with one of these tags, e.g. lane_change,cut_in"
)
_ROWS = flags.DEFINE_list(
    "rows", [], "draw exactly these scenes, by their numbers from 0"
)


def main() -> None:
    """Flags -> pictures and one page."""
    from rcirl_jax.report.data_page import choose_rows, write_data_page

    dataset = open_dataset(_DATA.value)
    if _ROWS.value and _TAGS.value:
        raise InputError("--rows: given with --tags: expected one of them")
    try:
        rows = sorted({int(row) for row in _ROWS.value})
    except ValueError as error:
        raise InputError(f"--rows: {_ROWS.value}: expected row numbers") from error
    tags = dataset.column("scene.tags")
    rows = rows or choose_rows(tags, _SCENES.value, _TAGS.value)
    name = Path(_DATA.value).name or _DATA.value
    page = write_data_page(
        Path(_OUTPUT.value) / "index.html",
        dataset,
        rows,
        f"Dataset {name}",
        provenance(),
    )
    print(f"{len(rows)} of {dataset.count:,} scenes drawn")
    print(f"page: {page}")
