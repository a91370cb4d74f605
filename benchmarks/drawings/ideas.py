"""Ideas as drawings: the chain from logs to a verdict, and what features measure."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch, Polygon

from rcirl_jax.export.own_planner import features as plain
from rcirl_jax.features import feature_map
from rcirl_jax.report.style import (
    CANDIDATE,
    CLASS_COLOURS,
    HUMAN,
    figure,
    label,
    save,
)

OTHER = CLASS_COLOURS["other"]


def bare(axis: Axes) -> None:
    """No ticks, no frame, no grid."""
    axis.grid(False)
    axis.set(xticks=[], yticks=[])
    axis.spines[:].set_visible(False)


def chain(path: Path) -> None:
    """From logs to a verdict, in three rows."""
    rows = (
        ("data", OTHER, (
            ("logs", "13 formats"), ("recordings", "tracks, lanes,\nlights"),
            ("scenes", "8 s of one driver\nand the others"),
            ("candidates", "with 21 features\nat 18 times"),
        )),
        ("learn", CLASS_COLOURS["nudge"], (
            ("training", "the human above\nthe candidates"),
            ("weights.msgpack", "one file, checks\nitself"),
            ("your planner", "Python, C++17"),
        )),
        ("judge", CLASS_COLOURS["overtake"], (
            ("ranking", "held-out scenes"), ("closed loop", "4,140 cases"),
            ("gate", "against the\nincumbent"), ("verdict", "ship or not;\na report"),
        )),
    )  # fmt: skip
    made, axes = figure(1, 1, 6.4, 3.9)
    axis = axes[0, 0]
    bare(axis)
    for line, (name, colour, boxes) in enumerate(rows):
        y = -1.5 * line
        axis.text(-0.35, y, name, fontsize=10, rotation=90, va="center", color=HUMAN)
        for place, (title, words) in enumerate(boxes):
            corner = (1.75 * place, y - 0.5)
            box = FancyBboxPatch(corner, 1.35, 1.0, "round,pad=0.03", ec=colour, lw=1.6)
            box.set_facecolor(colour + "22")
            axis.add_patch(box)
            middle = corner[0] + 0.67
            axis.text(middle, y + 0.22, title, ha="center", va="center", fontsize=9)
            axis.text(
                middle, y - 0.2, words, ha="center", va="center", fontsize=8,
                color="#444444",
            )  # fmt: skip
            if place:
                _arrow(axis, (corner[0] - 0.36, y), (corner[0] - 0.05, y))
    for line, start in ((0, 3), (1, 1)):
        x, y = 1.75 * start + 0.67, -1.5 * line - 0.55
        bend = [(x, y), (x, y - 0.2), (0.67, y - 0.2)]
        axis.plot(*zip(*bend, strict=True), color=HUMAN, lw=1.2)
        _arrow(axis, (0.67, y - 0.2), (0.67, y - 0.42))
    axis.set(xlim=(-0.5, 6.75), ylim=(-3.6, 0.6))
    save(made, path)


def _arrow(axis: Axes, start: tuple, end: tuple, style: str = "-|>") -> None:
    how = {"arrowstyle": style, "color": HUMAN, "lw": 1.2, "shrinkA": 0, "shrinkB": 0}
    axis.annotate("", end, start, arrowprops=how)


def features(path: Path) -> None:
    """One moment from above and on the station-time graph, with its features."""
    length, width, speed, times = 4.6, 1.9, 20.0, plain.TIMES_S
    # rear end, right side, speed of the others
    others = {
        "follow": (27.3, -0.95, 18.0), "overtake": (-24.3, -0.95, 22.0),
        "nudge": (-1.0, 2.55, 21.0), "sidepass_front": (14.0, -4.45, 17.0),
        "sidepass_rear": (-16.0, -4.45, 20.5),
    }  # fmt: skip
    boxes = [
        plain.Obstacle(
            kind=plain.Kind.VEHICLE,
            s_lower=s + v * times,
            s_upper=s + length + v * times,
            l_lower=np.full(18, l),
            l_upper=np.full(18, l + width),
            speed=np.full(18, v),
            valid=np.ones(18, bool),
        )
        for s, l, v in others.values()
    ]
    flat = np.zeros(plain.NUM_STATIONS)
    scene = plain.Scene(
        ego=plain.Ego(v=speed, length=length, width=width),
        path=plain.Path(kappa=flat, l=flat, speed_limit=flat + 30.0),
        obstacles=boxes,
    )
    specs = {x.name: x for p in ("paper21", "apollo21") for x in feature_map(p).specs}
    columns = plain.FeatureMap(list(specs), [x.unit for x in specs.values()])
    at = dict(zip(specs, columns(scene, speed * times[None])[0].T, strict=True))
    made, axes = figure(2, 1, 7.6, 6.0)
    _features_above(axes[0, 0], others, (length, width), at)
    _features_graph(axes[1, 0], boxes, at, speed)
    save(made, path)


def _features_above(axis: Axes, others: dict, size: tuple, at: dict) -> None:
    length, width = size
    for y in (-5.4, 5.4):
        axis.axhline(y, color=HUMAN, lw=1.2)
    for y in (-1.8, 1.8):
        axis.axhline(y, color=CANDIDATE, lw=1.0, ls=(0, (6, 5)))
    for name, (s, l, _) in {**others, "ego": (-0.5 * length, -0.5 * width, 0)}.items():
        colour = CLASS_COLOURS.get(name, OTHER) if name != "ego" else HUMAN
        axis.add_patch(Polygon(rectangle(s, l, length, width), color=colour))
    said = lambda name, unit: f"{name} {at[name][0]:+.1f} {unit}".replace("-", "−")  # noqa: E731
    gap = lambda name: f"{name}_distance {at[f'{name}_distance'][0]:.0f} m"  # noqa: E731
    front, rear = 0.5 * length, -0.5 * length
    # feature, ends of its arrow, place of its words
    for name, start, end, words in (
        ("follow", (front, 0.4), (27.3, 0.4), (14.8, 0.8)),
        ("overtake", (rear, 0.4), (-19.7, 0.4), (-11.0, 0.8)),
        ("sidepass_front", (front, -3.5), (14.0, -3.5), (9.5, -5.1)),
        ("sidepass_rear", (rear, -3.5), (-11.4, -3.5), (-10.0, -5.1)),
    ):
        _arrow(axis, start, end, "<|-|>")
        axis.text(*words, gap(name), fontsize=8, ha="center", va="bottom")
        low = words[1] - (1.75 if words[1] > 0 else 0.0)
        if words[1] > 0:
            axis.text(
                words[0],
                low,
                said(f"{name}_speed", "m/s"),
                fontsize=8,
                ha="center",
                va="bottom",
            )
    _arrow(axis, (0.6, 0.95), (0.6, 2.55), "<|-|>")
    axis.text(4.6, 3.2, f"nudge_lateral {at['nudge_lateral'][0]:.1f} m", fontsize=8)
    axis.text(0.0, -0.2, "ego", color="white", fontsize=8, ha="center", va="center")
    axis.set(xlim=(-27, 35), ylim=(-5.6, 5.6))
    label(axis, "t = 0 from above, 20 m/s, driving to the right", "station, m", "l, m")


def _features_graph(axis: Axes, boxes: Sequence, at: dict, speed: float) -> None:
    times = plain.TIMES_S
    for box, colour in zip(boxes[:2], ("follow", "overtake"), strict=True):
        axis.fill_between(
            times,
            box.s_lower,
            box.s_upper,
            color=CLASS_COLOURS[colour],
            alpha=0.5,
            lw=0,
        )
    s = speed * times
    axis.fill_between(times, s - 2.3, s + 2.3, color=HUMAN, alpha=0.15, lw=0)
    axis.plot(times, s, "o-", color=HUMAN, ms=3, lw=1.6)
    for i in (2, 6):
        for name, side in (("follow", 1), ("overtake", -1)):
            distance = at[f"{name}_distance"][i]
            start = s[i] + side * 2.3
            end = start + side * distance
            _arrow(axis, (times[i], start), (times[i], end), "<|-|>")
            words = f"{name}_distance {distance:.0f} m"
            y = end + side * (14.0 if side > 0 else 13.0)
            axis.text(times[i], y, words, fontsize=8, va="center", ha="center")
    words = "the trajectory at its first times; its slope is the velocity"
    axis.text(2.0, 8.0, words, fontsize=8)
    axis.set(xlim=(0, 4), ylim=(-35, 112))
    label(axis, "the same on the station-time graph, first half", "t, s", "station, m")


def rectangle(s: float, l: float, length: float, width: float) -> np.ndarray:
    """Corners of a box from its rear right one."""
    return np.array([(s, l), (s + length, l), (s + length, l + width), (s, l + width)])
