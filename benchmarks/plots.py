"""Draws docs/performance.png from benchmarks/results/training.json.

    python -m benchmarks.plots

Queries (or candidates) per second on one core and on all, of ours the faster way to
use them. Rows of all cores that were taken on a busy machine are not drawn (see
`benchmarks.training`).
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
    "recipe_torch_eager/": ("recipe, PyTorch eager", CANDIDATE),
    "recipe_torch_compile/": ("recipe, torch.compile", CANDIDATE),
    "recipe_cached/": ("recipe, cached features", CHOSEN),
    "recipe_end_to_end/": ("recipe, end to end", CHOSEN),
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


def main(_: list[str]) -> None:
    """The picture of what `benchmarks.training` wrote."""
    made = _bars(json.loads((Path(_RESULTS.value) / "training.json").read_text()))
    print(f"written: {save(made, Path(_OUTPUT.value) / 'performance.png')}")


if __name__ == "__main__":
    app.run(main)
