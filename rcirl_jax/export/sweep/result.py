"""What came of a sweep: its file read again, and as text."""

import math
from collections.abc import Mapping
from pathlib import Path

from rcirl_jax.errors import MALFORMED, InputError
from rcirl_jax.export.sweep.folder import SWEEP
from rcirl_jax.runtime.atomic_files import read_json


def read_sweep(folder: Path) -> dict:
    """The contents of a sweep's sweep.json.

    Raises:
      InputError: missing, or not of a finished sweep.
    """
    path = folder / SWEEP
    report = read_json(path, "the result of `rcirl sweep`")
    try:
        table(report)
        _check_grid(report)
    except MALFORMED as error:
        raise InputError(
            f"{path}: {type(error).__name__}: expected the result of `rcirl sweep`"
        ) from error
    return report


def _check_grid(report: Mapping) -> None:
    """Check what the picture takes for granted: as many seeds in each, a full grid.

    Only a search's configurations are no grid.

    Raises:
      One of `MALFORMED`.
    """
    metric, members = report["choose_by"]["metric"], report["members"]
    report["configurations"][report["chosen"]["configuration"]]
    seen, seeds = set(), set()
    for row in report["configurations"].values():
        values = [members[name]["validation"][metric] for name in row["members"]]
        rates = row["leaky_rate"], row["learning_rate"]
        if not all(0.0 < x < 1.0 for x in rates) or not max(map(abs, values)) < 1e9:
            raise ValueError("expected finite numbers, rates between 0 and 1")
        seen.add((row["hidden"], row["leaky_rate"], row["learning_rate"]))
        seeds.add(len(values))
    axes = [len(set(axis)) for axis in zip(*seen, strict=True)]
    whole = len(seen) == math.prod(axes) or report.get("search") == "optuna"
    if not seen or not whole or len(seeds) != 1 or 0 in seeds:
        raise ValueError("expected every configuration with the same seeds")


def table(report: Mapping) -> str:
    """The configurations as text, best first, then the choice with its test score.

    Args:
      report: of `run_sweep`.
    """
    how, chosen = report["choose_by"], report["chosen"]
    metric = how["metric"]
    sign = -1.0 if how["higher_is_better"] else 1.0
    unit = "" if how["unit"] == "1" else f" {how['unit']}"
    scale = 100.0 if how["unit"] == "%" else 1.0

    def text(estimate: Mapping) -> str:
        value, low, high = (scale * estimate[k] for k in ("value", "low", "high"))
        apart = estimate["seed_sd"]
        seeds = "" if apart is None else f"  seeds ±{scale * apart:.3f}"
        return f"{value:8.3f}{unit}  [{low:.3f}, {high:.3f}]{seeds}"

    rows = sorted(
        report["configurations"].items(),
        key=lambda item: sign * item[1]["validation"][metric]["value"],
    )
    lines = [
        f"{how['title']} on {report['scenes']['validation']} validation scenes, held "
        f"out by {report['validation_by']}; 95 % interval, spread of seeds",
        f"{'hidden':>10s} {'leaky rate':>10s} {'step size':>10s}",
    ]
    for name, row in rows:
        mark = "  <- chosen" if name == chosen["configuration"] else ""
        failed = "" if row["finite"] else "  NaN or infinity"
        values = f"{row['hidden']:>10s} {row['leaky_rate']:>10g} "
        values += f"{row['learning_rate']:>10g} "
        lines.append(values + text(row["validation"][metric]) + failed + mark)
    lines.append(
        f"chosen: {chosen['configuration']}, its test score "
        f"({report['scenes']['test']} scenes, not chosen by): "
        f"{text(chosen['test'][metric]).strip()}"
    )
    for name, facts in report["groups"].items():
        lines.append(
            f"group {name}: {facts['members']} members in {facts['seconds']:.1f} s, "
            f"{facts['compiles']} compile of {facts['compile_seconds']:.1f} s"
        )
    return "\n".join(lines)
