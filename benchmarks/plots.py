"""Draws docs/performance.png and docs/scaling.png from benchmarks/results.

    python -m benchmarks.plots

performance.png: queries (or candidates) per second on one core and on all, of ours
the faster way to use them. Rows of all cores that were taken on a busy machine are
not drawn (see `benchmarks.training`). scaling.png: what a training step does per
second as one size grows. A picture whose numbers are not there is left out.
"""

import json
from pathlib import Path

import numpy as np
from absl import app, flags
from matplotlib.figure import Figure

from rcirl_jax.report.style import CANDIDATE, CHOSEN, CLASS_COLOURS, figure, label, save

_RESULTS = flags.DEFINE_string("results", "benchmarks/results", "folder of the JSON")
_OUTPUT = flags.DEFINE_string("output", "docs", "folder of the PNGs")

# beginning of the rows' names: what they are, colour
BARS = {
    "torch_eager/plain": ("PyTorch eager, plain", CANDIDATE),
    "torch_eager/tuned": ("PyTorch eager, tuned", CANDIDATE),
    "torch_compile/plain": ("torch.compile, plain", CANDIDATE),
    "torch_compile/tuned": ("torch.compile, tuned", CANDIDATE),
    "ours/": ("ours, cached features", CHOSEN),
    "end_to_end/": ("ours, end to end", CHOSEN),
    "candidates/": ("candidates with features", CLASS_COLOURS["follow"]),
}

# curve of scaling.json: (its axis, what is counted per second, how that is called)
CURVES = {
    "candidates": ("candidates of a scene", "candidates_per_s", "candidates/s"),
    "obstacles": ("obstacle slots of a scene", "candidates_per_s", "candidates/s"),
    "scenes": ("scenes of a batch", "queries_per_s", "queries/s"),
    "devices": ("devices", "queries_per_s", "queries/s"),
}


def _rate(rows: dict[str, dict], bar: str) -> float:
    """Million per second of the fastest row whose name begins so."""
    return max(row["per_s"] for name, row in rows.items() if name.startswith(bar)) / 1e6


def _bars(found: dict) -> Figure:
    """Training beside PyTorch."""
    drawn = [x for name, x in found.items() if name.startswith("cores_")]
    drawn = [measured for measured in drawn if measured["ratios"]]
    made, axes = figure(1, 1, 6.4, 1.6 + 1.6 * len(drawn))
    axis, height = axes[0, 0], 0.8 / len(drawn)
    for number, measured in enumerate(drawn):
        at = np.arange(len(BARS)) + number * height
        rates = [_rate(measured["rows"], bar) for bar in BARS]
        colours = [colour for _, colour in BARS.values()]
        bars = axis.barh(at, rates, 0.9 * height, color=colours)
        cores = measured["cores"]
        text = f"{{:.2f}} ({cores} core{'s' if cores > 1 else ''})"
        axis.bar_label(bars, [text.format(r) for r in rates], padding=3, fontsize=8)
    middle = np.arange(len(BARS)) + 0.5 * height * (len(drawn) - 1)
    axis.set_yticks(middle, [name for name, _ in BARS.values()])
    axis.invert_yaxis()
    axis.set_xlim(0.0, 1.2 * axis.get_xlim()[1])
    label(axis, "training speed", "million queries (candidates) per second", "")
    return made


def _curves(found: dict) -> Figure:
    """A panel per size that grows."""
    made, axes = figure(1, len(CURVES), 3.0 * len(CURVES), 2.6)
    for axis, (name, (size, rate, unit)) in zip(axes[0], CURVES.items(), strict=True):
        at = [point[name] for point in found[name]]
        axis.plot(at, [point[rate] / 1e6 for point in found[name]], "o-", color=CHOSEN)
        axis.set_xscale("log", base=2)
        axis.set_xticks(at, [f"{x:,}" for x in at], minor=False)
        axis.set_ylim(0.0, 1.05 * axis.get_ylim()[1])
        label(axis, size, "", f"million {unit}")
    return made


PICTURES = {"performance": ("training", _bars), "scaling": ("scaling", _curves)}


def main(_: list[str]) -> None:
    """Every picture whose numbers are there."""
    for picture, (name, draw) in PICTURES.items():
        source = Path(_RESULTS.value) / f"{name}.json"
        if not source.exists():
            print(f"left out: {picture}.png: {source}: not there")
            continue
        made = draw(json.loads(source.read_text()))
        print(f"written: {save(made, Path(_OUTPUT.value) / f'{picture}.png')}")


if __name__ == "__main__":
    app.run(main)
