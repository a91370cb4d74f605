"""The background-shifting figure: one draw of the paper's example as it is computed.

What each frame alone asks for, what pooling both finds, and what comparing within a
frame finds.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from rcirl_jax.evaluation.insight.background import TRUTH, Frames, Learned
from rcirl_jax.report.style import (
    CANDIDATE,
    CHOSEN,
    CLASS_COLOURS,
    HUMAN,
    figure,
    label,
    save,
)

FRAME_COLOURS = (CLASS_COLOURS["other"], CLASS_COLOURS["nudge"])
FRAME_MARKS = ("o", "s")
DIRECTION_COLOURS = {
    "one frame": HUMAN,
    "pooled": CHOSEN,
    "conditional, logistic": CLASS_COLOURS["follow"],
    "conditional, rank": CLASS_COLOURS["overtake"],
}
ARROW = 2.2  # length of the arrows in feature units


def _points(axis: Axes, frames: Frames) -> None:
    """Samples and human of both frames."""
    for number, (colour, mark) in enumerate(
        zip(FRAME_COLOURS, FRAME_MARKS, strict=True)
    ):
        samples = np.asarray(frames.candidates[number])
        human = np.asarray(frames.human[number])
        axis.plot(*samples.T, mark, color=colour, ms=3, alpha=0.7, mew=0)
        axis.plot(*human, "*", color=colour, ms=15, mec=HUMAN, mew=1.0)


def _arrow(axis: Axes, start: np.ndarray, direction: ArrayLike, colour: str) -> None:
    end = start + ARROW * np.asarray(direction)
    axis.annotate(
        "",
        xy=(float(end[0]), float(end[1])),
        xytext=(float(start[0]), float(start[1])),
        arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 2.2},
    )


def _legend(axis: Axes, names: Sequence[str], angles: Mapping[str, float]) -> None:
    """Names with their angle to the truth in this draw."""
    for name in names:
        text = f"{name}: {angles[name]:.1f}° off"
        axis.plot([], [], color=DIRECTION_COLOURS[name], lw=2.2, label=text)
    axis.plot([], [], ":", color=CANDIDATE, lw=1.6, label="truth")
    axis.legend(fontsize=8, frameon=False, loc="upper left")


def _truth(axis: Axes, start: np.ndarray) -> None:
    ends = np.stack([start, start + 1.5 * ARROW * np.asarray(TRUTH)])
    axis.plot(*ends.T, ":", color=CANDIDATE, lw=1.6)


def _frames_panel(axis: Axes, frames: Frames, found: Mapping[str, Learned]) -> None:
    _points(axis, frames)
    for number, side in enumerate((-1.0, 1.0)):
        centre = np.median(np.asarray(frames.candidates[number]), axis=0)
        _truth(axis, centre)
        _arrow(axis, centre, found["one frame"].direction, HUMAN)
        place = (centre[0] + 1.7 * side, centre[1] - 1.6)
        axis.annotate(f"frame {number + 1}", place, fontsize=9, ha="center")
    label(axis, "each frame alone: widest margin", "feature 1", "feature 2")


def _pooled_panel(axis: Axes, frames: Frames, found: Mapping[str, Learned]) -> None:
    _points(axis, frames)
    pooled = found["pooled"]
    direction = np.asarray(pooled.direction)
    centre = np.mean(np.asarray(frames.candidates), axis=(0, 1))
    foot = centre + (float(pooled.threshold) - centre @ direction) * direction
    along = np.array([direction[1], -direction[0]])
    ends = np.stack([foot - 4.5 * along, foot + 4.5 * along])
    axis.plot(*ends.T, color=CHOSEN, lw=1.0)
    _truth(axis, foot)
    _arrow(axis, foot, direction, CHOSEN)
    axis.annotate(
        "discriminator's\nboundary",
        (float(ends[0, 0]), float(ends[0, 1])),
        (2, -2),
        textcoords="offset points",
        fontsize=8,
        color=CHOSEN,
        va="top",
    )
    label(axis, "pooled: all humans against all samples", "feature 1", "feature 2")


def _difference_panel(axis: Axes, frames: Frames, found: Mapping[str, Learned]) -> None:
    sizes = (6, 3)
    for number, (colour, mark) in enumerate(
        zip(FRAME_COLOURS, FRAME_MARKS, strict=True)
    ):
        apart = np.asarray(frames.human[number] - frames.candidates[number])
        axis.plot(*apart.T, mark, color=colour, ms=sizes[number], alpha=0.7, mew=0)
    axis.plot(0.0, 0.0, "+", color=HUMAN, ms=9, mew=1.5)
    _truth(axis, np.zeros(2))
    for name in ("conditional, logistic", "conditional, rank"):
        _arrow(axis, np.zeros(2), found[name].direction, DIRECTION_COLOURS[name])
    label(
        axis,
        "conditional: human − sample within each frame",
        "difference of feature 1",
        "difference of feature 2",
    )


def background_figure(path: Path, frames: Frames, found: Mapping[str, Learned]) -> Path:
    """PNG of the example.

    Args:
      path: PNG to write.
      frames: one draw of the two frames, human [2, 2], candidates [2, K, 2].
      found: its directions by name.
    """
    made, axes = figure(1, 3, 13.5, 4.8)
    truth = np.asarray(TRUTH)
    angles = {
        name: float(np.degrees(np.arccos(np.clip(x.direction @ truth, -1.0, 1.0))))
        for name, x in found.items()
    }
    panels = (_frames_panel, _pooled_panel, _difference_panel)
    names = (["one frame"], ["pooled"], ["conditional, logistic", "conditional, rank"])
    for axis, draw, shown in zip(axes[0], panels, names, strict=True):
        draw(axis, frames, found)
        _legend(axis, shown, angles)
        axis.set_aspect("equal")
    for axis in axes[0, :2]:
        axis.set_xlim(-4.0, 6.5)
        axis.set_ylim(-3.5, 9.5)
    return save(made, path)
