"""Charts of numbers in benchmarks/results, with their intervals."""

import json
from pathlib import Path

import numpy as np

from rcirl_jax.report.charts import (
    BASELINE,
    LEARNED,
    curves_panel,
    interval_chart,
)
from rcirl_jax.report.style import CANDIDATE, CHOSEN, figure, label, save

RESULTS = Path(__file__).parents[1] / "results"
ROWS = {  # of the closed-loop table: row of the files -> its name in the pages
    "candidate": "learned, on hand-set",
    **{name: name for name in ("hand-set", "+velocity", "constant V")},
    **{name: name for name in ("random weights", "IDM", "IDM, tuned")},
}
SITES = {"US-101": "us101", "urban": "urban", "I-80": "i80"}  # of docs/rankings.md
LEARNERS = (
    *("MaxEnt 32-16", "MaxEnt monotone 32-16", "logistic non-negative"),
    *("RC-IRL logistic", "RC-IRL rank", "GAN", "IDM", "constant speed", "hand-set"),
)


def results(name: str) -> dict:
    """A file of benchmarks/results."""
    return json.loads((RESULTS / f"{name}.json").read_text())


def families(path: Path) -> None:
    """Learned minus hand-set in each family: progress, and clean drives."""
    checks = [c for c in results("chain_verdict")["checks"] if c["kind"] == "families"]
    made, axes = figure(1, 2, 8.0, 5.4)
    kinds = {"progress": "progress", "clean drives": "clean drives, % of cases"}
    of = lambda kind: [c for c in checks if c["name"].endswith(f", {kind}")]  # noqa: E731
    order = np.argsort([c["difference"] for c in of("progress")])
    for axis, (kind, title) in zip(axes[0], kinds.items(), strict=True):
        rows = [of(kind)[i] for i in order]
        for place, row in enumerate(rows):
            value, low, high = (100.0 * row[x] for x in ("difference", "low", "high"))
            colour = BASELINE if low < 0.0 < high else LEARNED if low > 0.0 else CHOSEN
            axis.plot([low, high], [place, place], color=colour, lw=2)
            axis.plot([value], [place], "o", color=colour, ms=4.5)
        margin = 100.0 * rows[0]["margin"]
        axis.axvline(0.0, color="#000000", lw=0.8)
        axis.axvline(-margin, color=CHOSEN, lw=1.2, ls=(0, (4, 3)))
        axis.text(-margin + 0.3, len(rows) - 0.6, "margin", fontsize=8, color=CHOSEN)
        names = [row["name"].split(",")[0].replace("_", " ") for row in rows]
        axis.set_yticks(range(len(rows)), names)
        axis.set_ylim(-0.7, len(rows))
        unit = "% of hand-set's" if kind == "progress" else "points"
        label(axis, title, f"learned minus hand-set, {unit}", "")
    axes[0, 1].set_yticklabels([])
    save(made, path)


def closed_loop(path: Path) -> None:
    """Rows of the closed-loop table, all of 100."""
    rows = results("chain_suite")["report"]["rows"]
    found = {}
    for name, shown in ROWS.items():
        row = rows[name]
        of = {m: row["per_case"][m] for m in ("a_station", "j_station")}
        found[shown] = {
            m: tuple(100.0 * x[k] for k in ("rate", "low", "high"))
            for m, x in of.items()
        }
        ends = ("nuplan", "nuplan_low", "nuplan_high")
        found[shown]["nuplan"] = tuple(100.0 * row[k] for k in ends)
    panels = {
        "a_station": ("|a| < 4 m/s²", "% of cases"),
        "j_station": ("raw |j| < 6 m/s³", "% of cases"),
        "nuplan": ("nuPlan score", "of 100"),
    }
    interval_chart(path, panels, found, 2.7)


def rankings(path: Path) -> None:
    """Top-1 distance of some learners and baselines on three sites."""
    rows: dict[str, dict[str, tuple]] = {name: {} for name in LEARNERS}
    for site, file in SITES.items():
        table = results(f"human_likeness_{file}")["rows"]
        for name in LEARNERS:
            found = table[name]["top1_fde"]
            rows[name][site] = tuple(found[k] for k in ("value", "low", "high"))
    interval_chart(path, {s: (s, "top-1, m") for s in SITES}, rows, 2.7)


def sweep(path: Path) -> None:
    """Top-1 over the leaky rate, a line for each width; 95 % intervals."""
    rows = results("leaky_rate_and_hidden_size")["ranking"]["rows"]
    made, axes = figure(1, 1, 5.6, 3.4)
    rates = (0.01, 0.05, 0.2, 0.5)
    looks = (("5", BASELINE, ":"), ("15", LEARNED, "-"), ("45", CHOSEN, "--"))
    for shift, (size, colour, dash) in zip((0.94, 1.0, 1.06), looks, strict=True):
        of = [rows[f"a {rate:g}, {size} hidden"]["top1_fde"] for rate in rates]
        value, low, high = (
            np.array([x[k] for x in of]) for k in ("value", "low", "high")
        )
        at = shift * np.array(rates)
        axes[0, 0].errorbar(
            at, value, (value - low, high - value), color=colour, ls=dash, marker="o",
            ms=4, lw=1.6, capsize=2, label=f"{size} hidden units",
        )  # fmt: skip
    idm = rows["IDM"]["top1_fde"]["value"]
    axes[0, 0].axhline(idm, color=CANDIDATE, lw=1.0)
    axes[0, 0].text(0.3, idm + 0.15, "IDM", fontsize=8, color=BASELINE)
    axes[0, 0].set_xscale("log")
    axes[0, 0].set_xticks(rates, [f"{rate:g}" for rate in rates])
    axes[0, 0].minorticks_off()
    axes[0, 0].set_ylim(bottom=0.0)
    axes[0, 0].legend(fontsize=8, frameon=False, loc="upper left")
    label(axes[0, 0], "US-101, rank loss", "leaky rate a", "top-1, m, less is better")
    save(made, path)


def gamma(path: Path) -> None:
    """Time weights of three losses, each over its mean."""
    found = results("discount_factors")
    made, axes = figure(1, 1, 5.6, 3.2)
    curves = {}
    for name, row in found["rows"].items():
        runs = np.array(row["gamma"])
        curves[name] = runs / runs.mean(axis=1, keepdims=True)
    curves_panel(axes[0, 0], found["times_s"], curves)
    axes[0, 0].axhline(1.0, color="#000000", lw=0.8)
    label(axes[0, 0], "learned time weights", "t, s", "gamma over its mean")
    save(made, path)
