"""The closed-loop suite: cases side by side against one case at a time.

    python -m benchmarks.suite            # one group of cases a core, 10 s each
    python -m benchmarks.suite --full     # all 4,140 cases of 120 s, on accelerators

Every case is simulated and planned at 10 Hz; a plan is sampling, features, safety
filter, scores and choice of 64 candidates (IDM: one acceleration). In turn: all
cases as the suite drives them (on a CPU groups of `LANES`, one a core; elsewhere one
program), and a few of them by a program of one case. Medians over rounds, compiling
apart. Without --full the time of the full suite is extrapolated from the plans per
second, and the result says so.
"""

import functools
import os
from collections.abc import Callable

import jax
import numpy as np
from absl import app, flags

from benchmarks.common import in_turn, untrained, write
from rcirl_jax.planner.rank import RankConfig
from rcirl_jax.simulation.cases import STEP_S
from rcirl_jax.simulation.metrics import MetricsConfig, case_metrics
from rcirl_jax.simulation.rollout import LANES, drive_cases
from rcirl_jax.simulation.rows import Row, baseline_row
from rcirl_jax.simulation.suite import (
    FULL_S,
    CaseRef,
    build,
    rollout_config,
    suite_refs,
)

ROWS = ("random weights", "hand-set", "IDM")  # a learned reward costs as a drawn one

_FULL = flags.DEFINE_bool("full", False, "the whole suite instead of a part")
_DURATION = flags.DEFINE_float("duration", 10.0, "s of a case, without --full")
_SINGLE = flags.DEFINE_integer("single", 3, "cases driven one at a time in a round")
_ROUNDS = flags.DEFINE_integer("rounds", 5, "rounds")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")


def _part(refs: tuple[CaseRef, ...]) -> tuple[CaseRef, ...]:
    """As many cases as fill every core's group, families in turn."""
    count = LANES * len(os.sched_getaffinity(0))
    spread = np.linspace(0, len(refs), count, endpoint=False).astype(int)
    return tuple(refs[place] for place in spread)


def _ways(
    row: Row, refs: tuple[CaseRef, ...], duration_s: float
) -> dict[str, Callable[[], object]]:
    """Both ways to drive the row; cases are built before the clock starts."""
    config = rollout_config(row, duration_s, plan_every=1)
    cases = build(refs, duration_s)
    drive = functools.partial(
        drive_cases,
        row.policy,
        row.params,
        config=config,
        reduce=functools.partial(case_metrics, config=MetricsConfig()),
    )
    alone = [
        jax.tree.map(lambda leaf, n=n: leaf[n : n + 1], cases)
        for n in range(_SINGLE.value)
    ]
    return {
        "together": lambda: drive(cases),
        "one at a time": lambda: [jax.block_until_ready(drive(case)) for case in alone],
    }


def main(_: list[str]) -> None:
    """Rows in turn, ways alternated."""
    every = suite_refs("full")
    refs = every if _FULL.value else _part(every)
    duration_s = FULL_S if _FULL.value else _DURATION.value
    steps = round(duration_s / STEP_S)
    weights = untrained()
    result: dict = {"cases": len(refs), "duration_s": duration_s, "rows": {}}
    for name in ROWS:
        row = baseline_row(name, "paper21", weights, RankConfig())
        ways = _ways(row, refs, duration_s)
        taken = in_turn(ways, _ROUNDS.value + 1)
        first = {way: round(seconds[0], 2) for way, seconds in taken.items()}
        median = {way: float(np.median(x[1:])) for way, x in taken.items()}
        plans = {"together": len(refs) * steps, "one at a time": _SINGLE.value * steps}
        rate = {way: plans[way] / median[way] for way in ways}
        full_s = len(every) * FULL_S / STEP_S / rate["together"]
        result["rows"][name] = {
            "seconds": {way: round(x, 3) for way, x in median.items()},
            "seconds_with_compiling": first,
            "plans_per_s": {way: round(x) for way, x in rate.items()},
            "ratio": round(rate["together"] / rate["one at a time"], 2),
            "full_suite_s": round(full_s, 1),
            "full_suite_is": "measured" if _FULL.value else "extrapolated",
        }
        print(f"{name}: {result['rows'][name]}", flush=True)
    write("suite", result, _OUTPUT.value)


if __name__ == "__main__":
    app.run(main)
