"""Compile seconds of the programs, part by part.

    python -m benchmarks.compiling                        # all rows
    python -m benchmarks.compiling --rows=sampler,F --before=OTHER.json

Every row is traced and compiled once without any cache, for `LANES` scenes of the
catalogue, then run until its median holds. CPU seconds of this process, best pinned to
one core (`taskset -c 0`): on a busy machine clock times say little. Columns: seconds to
trace and lower, to compile, instructions of the program before XLA's passes,
milliseconds of a run; with --before the columns of an earlier result beside them.
"""

import json
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from absl import app, flags

from benchmarks.common import untrained, write
from rcirl_jax.features import feature_map
from rcirl_jax.planner.baselines import rule, rule_policy
from rcirl_jax.planner.plan import no_plan
from rcirl_jax.planner.prediction import with_predicted_futures
from rcirl_jax.planner.rank import (
    ONLINE,
    RankConfig,
    hand_score,
    ranking,
    ranking_policy,
)
from rcirl_jax.planner.safety import check
from rcirl_jax.sampling import sample
from rcirl_jax.simulation import rollout
from rcirl_jax.simulation.rollout import LANES, RolloutConfig
from rcirl_jax.simulation.suite import build, suite_refs
from rcirl_jax.simulation.world import Vehicle, observe, road_limit, start, step

STEPS = 200  # of a closed-loop program

_ROWS = flags.DEFINE_list("rows", [], "rows; default: all")
_BEFORE = flags.DEFINE_string("before", None, "an earlier result to print beside")
_REPEATS = flags.DEFINE_integer("repeats", 0, "runs; 0: as many as fill two seconds")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")

Row = tuple[Callable, tuple]  # what is compiled, its arguments


def _rows() -> dict[str, Row]:
    """Every row by its name."""
    refs = suite_refs("full", 4)
    spread = np.linspace(0, len(refs), LANES, endpoint=False).astype(int)
    cases = build([refs[place] for place in spread], STEPS * 0.1)
    cases = jax.tree.map(jnp.asarray, cases)
    limits = jax.jit(jax.vmap(lambda case: road_limit(case.road)))(cases)
    worlds = jax.jit(jax.vmap(start))(cases)
    see = jax.vmap(observe)
    scenes = jax.jit(see)(cases, worlds, limits)
    keys = jax.random.split(jax.random.key(0), LANES)
    draw = jax.vmap(lambda key, scene: sample(key, scene, ONLINE))
    candidates = jax.jit(draw)(keys, scenes)
    features = feature_map("paper21")
    weights = untrained()
    policy, ranked = ranking_policy(features, "relu", RankConfig()), ranking(weights)
    plan = jax.tree.map(lambda x: jnp.stack([x] * LANES), no_plan())
    asked, fallback = jnp.zeros(LANES), jnp.zeros(LANES, bool)

    config, (now, limits) = RolloutConfig(), rollout._begin(cases)

    def loop(drive: Callable, params: object) -> Row:
        program = rollout._compiled(drive, 1, config.span, config.vehicle)
        return program, (params, cases, config.manner(), limits, now)

    return {
        "sampler": (draw, (keys, scenes)),
        "F": (jax.vmap(features.rows), (scenes, candidates)),
        "prediction": (jax.vmap(with_predicted_futures), (scenes,)),
        "filter": (jax.vmap(check), (scenes, candidates)),
        "hand-set cost": (
            jax.vmap(lambda *x: hand_score(None, *x)),
            (scenes, candidates),
        ),
        "observe": (see, (cases, worlds, limits)),
        "world step": (
            jax.vmap(lambda *x: step(*x, Vehicle())),
            (cases, worlds, asked, fallback),
        ),
        "ranking policy": (
            jax.vmap(policy, in_axes=(None, 0, 0)),
            (ranked, scenes, keys),
        ),
        "with commitment": (
            jax.vmap(policy, in_axes=(None, 0, 0, 0)),
            (ranked, scenes, keys, plan),
        ),
        "loop: driver models": loop(rule_policy, rule("IDM")),
        "loop: learned": loop(policy, ranked),
        "loop: hand-set": loop(policy, ranking(weights, "hand-set", 0.0)),
    }


def _measured(make: Callable, arguments: tuple) -> dict[str, float]:
    """Seconds to trace and to compile, instructions, milliseconds of a run."""
    begin = time.process_time()
    lowered = jax.jit(lambda *given: make(*given)).lower(*arguments)
    traced = time.process_time()
    compiled = lowered.compile()
    done = time.process_time()
    text = lowered.as_text()
    jax.block_until_ready(compiled(*arguments))
    taken: list[float] = []
    until = time.process_time() + 2.0
    while len(taken) < (_REPEATS.value or 5) or (
        not _REPEATS.value and time.process_time() < until
    ):
        start_s = time.process_time()
        jax.block_until_ready(compiled(*arguments))
        taken.append(time.process_time() - start_s)
    return {
        "trace_s": round(traced - begin, 2),
        "compile_s": round(done - traced, 2),
        "instructions": text.count(" = "),
        "run_ms": round(1e3 * float(np.median(taken)), 3),
    }


def main(_: list[str]) -> None:
    """Rows in turn."""
    before = json.loads(Path(_BEFORE.value).read_text()) if _BEFORE.value else {}
    result = {}
    for name, row in _rows().items():
        if _ROWS.value and name not in _ROWS.value:
            continue
        result[name] = found = _measured(*row)
        old = before.get("rows", {}).get(name, {})
        cells = [f"{key} {old.get(key, '')} -> {found[key]}" for key in found]
        print(f"{name:<22}" + "   ".join(cells), flush=True)
    write("compiling", {"lanes": LANES, "steps": STEPS, "rows": result}, _OUTPUT.value)


if __name__ == "__main__":
    app.run(main)
