"""Optimality gap and robustness of the plan, the paper's two further criteria.

    python -m experiments.paper.robustness --weights=FILE --output=DIR [--quick]

Planning frames are taken from the planner's own drives through every family.
In each: how much value is left on the table against a lattice of half the step, and
how far perception errors spread the plan. Rows: ranking, dynamic programming and the
hand-set cost (steadiness only: it has another value). Writes robustness.json,
optimality.png and robustness.png. Expected: ten minutes on a quiet core; the lattice
leaves less of the value of not braking than ranking 64 candidates. `--quick`: a few
frames on coarse lattices, two minutes.
"""

import dataclasses
from pathlib import Path

import numpy as np
from absl import flags

from experiments.paper.plans import (
    Disturbance,
    Table,
    frames,
    gaps,
    steadiness,
    summary,
)
from rcirl_jax.cli.running import provenance, run
from rcirl_jax.errors import InputError
from rcirl_jax.export.loading import open_reward, reward_params
from rcirl_jax.features import feature_map
from rcirl_jax.planner.dp import FINE, DpConfig, dp_policy
from rcirl_jax.planner.rank import (
    RankConfig,
    hand_score,
    rank_policy,
    ranking,
    ranking_policy,
)
from rcirl_jax.report.charts import interval_chart
from rcirl_jax.runtime.atomic_files import write_json
from rcirl_jax.simulation.suite import build, suite_refs

_WEIGHTS = flags.DEFINE_string("weights", None, "weights file", required=True)
_OUTPUT = flags.DEFINE_string("output", "out/robustness", "folder to write")
_FRAMES = flags.DEFINE_integer("frames", 69, "planning frames", lower_bound=2)
_QUICK = flags.DEFINE_bool("quick", False, "a few frames, coarse lattices")

CATALOGUE_SEED = 500  # no suite and no training has these cases
EVERY_S = 4.0  # s between two frames of a drive
OPTIMALITY = {
    "admissible": ("plan passes the filter", "share of frames"),
    "normalised": ("value left", "1: as bad as braking for nothing"),
}
SPREADS = {
    "acceleration_std": ("spread of the next acceleration", "m/s^2"),
    "end_station_std": ("spread of the plan's end", "m"),
}


def _shown(
    folder: Path, name: str, panels: dict[str, tuple[str, str]], table: Table
) -> None:
    """One line per row and metric on the terminal, and a picture."""
    triples = {
        row: {key: (x[key]["mean"], x[key]["low"], x[key]["high"]) for key in panels}
        for row, x in table.items()
    }
    for row, found in triples.items():
        for key, (mean, low, high) in found.items():
            title, unit = panels[key]
            n = table[row][key]["frames"]
            print(
                f"{row:<12} {title:<32} {mean:8.3f} [{low:.3f}, {high:.3f}] {unit}"
                f" ({n:.0f} frames)"
            )
    interval_chart(folder / f"{name}.png", panels, triples, 3.2)


def main() -> None:
    """Frames, gaps, steadiness; table on the terminal, numbers as JSON, pictures."""
    quick, folder = _QUICK.value, Path(_OUTPUT.value)
    reward = open_reward(_WEIGHTS.value)
    if reward.prior_cost is not None:
        raise InputError(
            f"--weights: {reward.file}: expected a reward without a prior cost: the "
            "gap is one of V alone"
        )
    params, config = ranking(reward_params(reward)), RankConfig()
    features, activation = feature_map(str(reward.preset)), reward.activation
    rank = ranking_policy(features, activation, config)
    coarse = DpConfig(step=4.0 if quick else 2.0)
    few, duration = ("free_cruise,stopped_lead", 20.0) if quick else ("full", 60.0)
    cases = build(suite_refs(few, 1, CATALOGUE_SEED), duration)
    count = 6 if quick else _FRAMES.value
    met, case = frames(rank, params, cases, duration, EVERY_S, count)
    dp = dp_policy(features, activation, config, coarse)
    finer = DpConfig(step=2.0) if quick else FINE
    planners = {"rank": (rank, params), "DP": (dp, (params, np.asarray(True)))}
    optimality = gaps(
        planners, reward_params(reward), met, case, features, activation, finer
    )
    _shown(folder, "optimality", OPTIMALITY, optimality)
    noise = Disturbance(samples=8 if quick else 16)
    rows = {**planners, "hand-set": (rank_policy(hand_score, config), None)}
    robustness: Table = {}
    for name, (policy, weights) in rows.items():
        found = steadiness(policy, weights, met, noise)
        robustness[name] = {key: summary(x, case) for key, x in found.items()}
    _shown(folder, "robustness", SPREADS, robustness)
    body = {"optimality": optimality, "robustness": robustness, "frames": case.size}
    body |= {"disturbance": dataclasses.asdict(noise), "quick": quick}
    body["made_by"] = provenance([_WEIGHTS.value])
    write_json(folder / "robustness.json", body)
    print(f"written: {folder}/robustness.json, optimality.png, robustness.png")


if __name__ == "__main__":
    run(main)
