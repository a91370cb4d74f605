"""One look for all pictures: colour-blind safe colours, names, sizes."""

import dataclasses
import io
import re
import sys
from pathlib import Path

import matplotlib as mpl

if "matplotlib.pyplot" not in sys.modules:  # a notebook keeps the backend that it has
    mpl.use("Agg")

import matplotlib.pyplot as plt
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rcirl_jax.runtime.atomic_files import write_whole

# Okabe-Ito colours
HUMAN = "#000000"
CHOSEN = "#D55E00"
CANDIDATE = "#999999"
CLASS_COLOURS = {
    "follow": "#0072B2",
    "overtake": "#009E73",
    "stop": "#CC0000",
    "virtual": "#CC79A7",
    "nudge": "#E69F00",
    "other": "#56B4E9",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Look:
    """The look of one driver or reward everywhere in a page."""

    colour: str
    dash: tuple[int, ...]  # px on, px off; empty: solid


LOOKS = (
    Look(colour=CHOSEN, dash=()),
    Look(colour=CLASS_COLOURS["follow"], dash=(7, 4)),
    Look(colour=CLASS_COLOURS["overtake"], dash=(2, 3)),
    Look(colour=CLASS_COLOURS["virtual"], dash=(9, 3, 2, 3)),
)
HUMAN_LOOK = Look(colour=HUMAN, dash=(2, 2))


def style_of(look: Look) -> dict:
    """Return the look as matplotlib's arguments."""
    return {"color": look.colour, "linestyle": (0, look.dash) if look.dash else "-"}


def figure(rows: int, columns: int, width: float, height: float) -> tuple:
    """Return a figure and its axes (2-D array), with quiet grids."""
    made, axes = plt.subplots(
        rows, columns, figsize=(width, height), squeeze=False, layout="constrained"
    )
    for axis in axes.ravel():
        axis.grid(True, linewidth=0.4, alpha=0.5)
        axis.spines[["top", "right"]].set_visible(False)
    return made, axes


def label(axis: Axes, title: str, x: str, y: str) -> None:
    """Set title and axis labels with units."""
    axis.set_title(title, fontsize=10, loc="left")
    axis.set_xlabel(x, fontsize=9)
    axis.set_ylabel(y, fontsize=9)
    axis.tick_params(labelsize=8)


def save(made: Figure, path: Path) -> Path:
    """Write the PNG, whole (folder made if missing), and free the figure."""
    drawn = io.BytesIO()
    made.savefig(drawn, dpi=130, format="png")
    plt.close(made)
    write_whole(path, drawn.getvalue())
    return path


def svg(made: Figure, name: str) -> Markup:
    """Return the figure as inline SVG, and free it.

    Black takes the colour of the page's text. Ids are those that the drawing refers to,
    with its name before, so that several drawings stand in one page.
    """
    drawn = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        made.savefig(drawn, format="svg", transparent=True, metadata={"Date": None})
    plt.close(made)
    text = drawn.getvalue()
    text = re.sub(
        r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.S
    )
    used = set(re.findall(r"#([\w-]+)[\")]", text))
    keep = lambda found: f' id="{name}-{found[1]}"' if found[1] in used else ""  # noqa: E731
    text = re.sub(r' id="([\w.-]+)"', keep, text)
    text = re.sub(r'(url\(#|href="#)', rf"\1{name}-", text)
    text = re.sub(r"#000000", "currentColor", text)
    return Markup(re.sub(r"\n\s*", "\n", text))
