"""The learned value on top of the planner's own cost; see `planner.rank`."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.data.store.dataset import Dataset, Demonstrations
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.score import candidates_key
from rcirl_jax.export.reader import PriorCost
from rcirl_jax.planner.own_cost import OwnCost
from rcirl_jax.planner.prediction import with_predicted_futures
from rcirl_jax.planner.rank import ONLINE, Score, hand_score, online, own_score
from rcirl_jax.runtime.atomic_files import read_json, write_json
from rcirl_jax.sampling import SamplerConfig, sample
from rcirl_jax.sampling.sampler import as_planned
from rcirl_jax.tuning.run import Run
from rcirl_jax.types import Scene

OWN_COST = "hand-set"  # stands for the planner's own cost where none is given
COMPARED_SCENES = 256  # training scenes of each source in which costs are compared


def prior_cost_of(
    gain: float,
    recorded: Sequence[Demonstrations],
    own: OwnCost | None = None,
    sampler: SamplerConfig = ONLINE,
) -> PriorCost:
    """The prior cost of a weights file.

    The gain of a recipe is in units of the hand-set cost. That of another own cost is

        gain = gain of the recipe * unit(own cost) / unit(hand-set cost)
        unit(c) = median over scenes of (lower quartile of c - min of c)

    over the feasible candidates: what a cost sets between candidates that it would
    hardly choose says nothing. An own cost times 7, or plus 3, drives the same.

    Args:
      gain: the recipe's.
      recorded: the sources, whose training scenes are looked at.
      own: the user's own cost; None: the hand-set one.
      sampler: of the planner.
    """
    if own is None:
        return PriorCost(incumbent=OWN_COST, gain=gain)
    scenes, rows = some_scenes(recorded)
    unit_by = functools.partial(unit_of, scenes, rows, sampler=sampler)
    unit = float(unit_by(own.score) / unit_by(hand_score))
    return PriorCost(incumbent=own.name, gain=gain * unit)


def some_scenes(sources: Sequence[Demonstrations]) -> tuple[Scene, np.ndarray]:
    """Training scenes, as many of every source, and their rows; numpy leaves."""
    each = [one.indices("train") for one in sources]
    count = min(COMPARED_SCENES, *(index.size for index in each))
    rows = [index[np.linspace(0, index.size - 1, count).astype(int)] for index in each]
    parts = [one.read(some).scene for one, some in zip(sources, rows, strict=True)]
    scenes = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    return scenes, np.concatenate(rows)


@functools.partial(jax.jit, static_argnames=("score", "sampler"))
def unit_of(
    scenes: Scene, rows: jax.Array, score: Score, sampler: SamplerConfig = ONLINE
) -> jax.Array:
    """The unit [] of a cost, by the equation of `prior_cost_of`.

    Args:
      scenes: [S] of logs.
      rows: [S] of them in their dataset, which seed the candidates.
      score: minus the cost.
      sampler: of the planner.
    """

    def one(item: tuple[Scene, jax.Array]) -> jax.Array:
        scene = with_predicted_futures(as_planned(item[0], sampler))
        scene = scene.replace(time_valid=jnp.ones_like(scene.time_valid))
        candidates = sample(candidates_key(item[1]), scene, sampler)
        costs = -score(None, scene, candidates)
        costs = jnp.where(candidates.feasible, costs, jnp.nan)
        return jnp.nanquantile(costs, 0.25) - jnp.nanmin(costs)

    return jnp.nanmedian(jax.lax.map(one, (scenes, rows)))


def make_prior_cost(run: Run, sources: Sequence[Dataset]) -> None:
    """Writes the prior cost, if the recipe wants one."""
    config, path = run.config, prior_cost_file(run)
    if path is None:
        return
    inputs = {
        "gain": config.gain,
        "recorded": [one.hash for one in sources],
        "own_cost": run.own_cost.sha256 if run.own_cost else OWN_COST,
        **run.candidates,
    }
    sampler = online(config.train.sampler).sampler

    def work() -> None:
        made = prior_cost_of(config.gain, sources, run.own_cost, sampler)
        write_json(path, vars(made))

    run.stage("prior cost", inputs, [path], work)


def read_prior_cost(path: Path) -> PriorCost:
    """The prior cost of a file that `make_prior_cost` wrote.

    Raises:
      InputError: it is not.
    """
    found = read_json(path, "a prior cost as written")
    try:
        return PriorCost(incumbent=str(found["incumbent"]), gain=float(found["gain"]))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: {error}: expected a prior cost as written"
        ) from error


def prior_cost_file(run: Run) -> Path | None:
    """Returns the file of the prior cost, or None."""
    return run.folder / "prior_cost.json" if run.config.gain else None


def on_own_cost(run: Run, sources: Sequence[Dataset]) -> Run:
    """Names the cost that V is a residual on, and its unit, if the recipe wants one.

    The incumbent where it is an own cost, else the hand-set one.

    Args:
      run: folder and settings.
      sources: what was recorded.
    """
    train, path = run.config.train, run.folder / "own_unit.json"
    if not train.residual_on:
        return run
    place = run.config.incumbent if run.own_cost else OWN_COST
    inputs = {
        "own_cost": run.own_cost.sha256 if run.own_cost else OWN_COST,
        "recorded": [one.hash for one in sources],
        **run.candidates,
    }
    sampler = online(train.sampler).sampler

    def work() -> None:
        unit = float(unit_of(*some_scenes(sources), own_score(place), sampler))
        write_json(path, {"own_cost": place, "unit": unit})

    run.stage("own unit", inputs, [path], work)
    unit = float(read_json(path, "the unit of an own cost")["unit"])
    train = dataclasses.replace(train, residual_on=place, own_unit=unit)
    return dataclasses.replace(run, config=dataclasses.replace(run.config, train=train))
