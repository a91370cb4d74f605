"""The whole loop by one call; it draws a report, which needs the extra [report]."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rcirl_jax.api.learning import Place, folders_of, training_of
from rcirl_jax.evaluation.gate.types import GateConfig, Verdict
from rcirl_jax.runtime.executors import Executor, Here
from rcirl_jax.runtime.pipeline import only_one
from rcirl_jax.runtime.provenance import provenance
from rcirl_jax.train.running import Running
from rcirl_jax.tune.config import TuneConfig
from rcirl_jax.tune.evidence import verdict_of
from rcirl_jax.tune.loop import tune as run_stages
from rcirl_jax.tune.recipes import DEFAULT, load_recipe
from rcirl_jax.tune.run import Run


def tune(
    data: Place | Sequence[Place],
    workdir: Place,
    *,
    recipe: str = DEFAULT,
    incumbent: Place = "hand-set",
    suite: str = "full",
    cases: int | None = None,
    duration_s: float | None = None,
    drives: int = 240,
    executor: Executor | None = None,
    **settings: Any,  # noqa: ANN401
) -> Verdict:
    """Go through the whole loop: train, export, rank, drive, judge and report.

    The weights are WORKDIR/weights.msgpack, the page to open is WORKDIR/report.html.
    What is done is kept when it is called again. This is `rcirl autotune`.

    Args:
      data: folder of a dataset, or folders of several.
      workdir: folder of the run.
      recipe: as `train_reward`.
      incumbent: what drives today: a weights file, or a baseline's name.
      suite: cases of the closed loop: "full", "smoke", or families with commas.
      cases: of each family; None: as declared.
      duration_s: s of a case; None: 120, of "smoke" 20.
      drives: held-out recorded drives that say how near to people it drives.
      executor: where pieces of work run, of `rcirl_jax.runtime.executors`; None: here.
      **settings: as `train_reward`.

    Returns:
      The verdict: `decision` is "ship", "do not ship", "no difference" or "could not
      judge", `sentence` says why.

    Raises:
      InputError: a setting that cannot be, or bad data.
      Interrupted: the process was told to end; what is done stays.
    """
    chosen = load_recipe(recipe)
    folders = folders_of(data) or []
    config = TuneConfig(
        train=training_of(recipe, 0, settings),
        gate=GateConfig(),
        incumbent=os.fspath(incumbent),
        rehearsal=chosen.rehearsal,
        prior_cost=chosen.prior_cost,
        recipe=chosen.name,
        seeds=chosen.seeds,
        drives=drives,
        suite=suite,
        cases=cases,
        duration_s=duration_s,
    )
    flags = {"data": folders, "recipe": recipe, "incumbent": config.incumbent}
    run = Run(
        folder=Path(workdir),
        config=config,
        executor=executor or Here(),
        running=Running(),
        facts={"flags": {**flags, **settings}, **provenance()},
    )
    with only_one(run.folder):
        run_stages(run, folders)
    return verdict_of(run)
