"""The plan of a site, drawn: lanes, directions, where and how fast cars drove."""

import io
from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

WIDTH_INCHES = 10.0
HEIGHTS_INCHES = (2.6, 9.0)
ARROW_M = 40.0  # m of lane between two arrows of its direction
SLOW_COLOURS = "viridis"
LANE, EDGE, RED = "#E4E4E4", "#AAAAAA", "#CC0000"
FONT_SIZE = 9


class Drawing(str):
    """A picture as the text of an SVG; a notebook shows it."""

    __slots__ = ()

    def _repr_svg_(self) -> str:
        return str(self)


def site_svg(plan: Mapping[str, Any]) -> Drawing:
    """Draws the plan of a recording, its longer side across.

    Args:
      plan: of `data.plans.plan_of`.
    """
    drawn = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": "site"}):  # ids are the same each time
        draw_site(plan).savefig(drawn, format="svg", dpi=110, metadata={"Date": None})
    text = drawn.getvalue()
    return Drawing(text[text.index("<svg") :])


def draw_site(plan: Mapping[str, Any]) -> Figure:
    """Draws the plan: lanes, tracks by their speed, changes of lane, stop lines."""
    tracks = [np.array(x["points"]).reshape(-1, 4) for x in plan["tracks"]]
    lanes = [np.array(x["centre"]) for x in plan["lanes"]]
    every = np.concatenate([*(x[:, :2] for x in tracks), *lanes, np.zeros((0, 2))])
    middle = every.mean(axis=0) if len(every) else np.zeros(2)
    along = np.linalg.svd(every[::7] - middle, full_matrices=False)[2][0]
    along = along if along[0] > 0.0 else -along
    turn = np.array([[along[0], -along[1]], [along[1], along[0]]])

    def placed(points: np.ndarray) -> np.ndarray:
        return (np.reshape(points, (-1, 2)) - middle) @ turn

    across, along_m = np.ptp(placed(every), axis=0)[::-1] if len(every) else (1.0, 1.0)
    stretch = max(1.0, min(6.0, 0.2 * along_m / max(across, 1.0)))
    height = WIDTH_INCHES * stretch * across / max(along_m, 1.0) + 1.4
    size = WIDTH_INCHES, float(np.clip(height, *HEIGHTS_INCHES))
    made = Figure(figsize=size, layout="constrained")
    axis = made.subplots()
    axis.set_aspect(stretch if height <= HEIGHTS_INCHES[1] else "auto")
    _lanes(axis, plan, lanes, placed)
    rows = [x for x in tracks if len(x) > 1]
    pairs = [
        np.stack([p[:-1], p[1:]], axis=1) for p in (placed(x[:, :2]) for x in rows)
    ]
    if pairs:
        speeds = np.concatenate([x[1:, 3] for x in rows])
        driven = LineCollection(
            list(np.concatenate(pairs)), array=speeds, cmap=SLOW_COLOURS, linewidths=0.7
        )
        driven.set_rasterized(True)  # in an SVG, many thousand lines
        driven.set_alpha(0.75)
        axis.add_collection(driven)
        made.colorbar(driven, ax=axis, label="speed, m/s", shrink=0.8, pad=0.01)
    if plan["changes"]:
        places = placed(np.array(plan["changes"]))
        axis.plot(*places.T, "D", ms=3.0, mfc="none", mec=RED)
    for lane in plan["lanes"]:
        if lane["stop_line"]:
            axis.plot(*placed(np.array(lane["stop_line"])).T, color=RED, lw=2.5)
    axis.autoscale_view()
    times = "" if stretch == 1.0 else f", drawn {stretch:.1f} times as wide"
    axis.set_xlabel("m along the site", fontsize=FONT_SIZE)
    axis.set_ylabel(f"m across{times}", fontsize=FONT_SIZE)
    axis.tick_params(labelsize=8)
    axis.spines[["top", "right"]].set_visible(False)
    return made


def _lanes(axis: Any, plan: Mapping, lanes: list[np.ndarray], placed: Any) -> None:  # noqa: ANN401
    """Draws lanes as areas, arrows along them, and limits."""
    areas, arrows = [], []
    for lane, centre in zip(plan["lanes"], lanes, strict=True):
        step = np.gradient(centre, axis=0)
        way = step / np.maximum(np.hypot(*step.T), 1e-9)[:, None]
        normal = np.stack([-way[:, 1], way[:, 0]], axis=1)
        left, right = centre + lane["left"] * normal, centre - lane["right"] * normal
        areas.append(placed(np.concatenate([left, right[::-1]])))
        arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(centre, axis=0).T)))
        for at in np.arange(0.5 * min(ARROW_M, arc[-1]), arc[-1], ARROW_M):
            n = int(np.searchsorted(arc, at))
            arrows.append(
                (placed(centre[n] - 3.0 * way[n]), placed(centre[n] + way[n]))
            )
    kind = {"facecolors": LANE, "edgecolors": EDGE, "linewidths": 0.5}
    axis.add_collection(PolyCollection(areas, **kind))
    for tail, head in arrows:
        ends = {"xytext": tail[0], "textcoords": "data"}
        axis.annotate("", head[0], **ends, arrowprops={"arrowstyle": "->", "lw": 0.7})
