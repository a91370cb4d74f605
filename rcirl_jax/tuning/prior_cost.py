"""The learned value on top of the planner's own cost; see `planner.rank`.

The familiarity is fitted on recorded scenes against scenes of the catalogue, and
stands in the weights file with the gains, so that a planner adds its own cost and
nothing else. It minimises the weighted binary cross entropy of `reward.familiarity`;
the catalogue weighs ELSEWHERE times as much as all recordings together, so that doubt
leaves the choice to the own cost, and every recorded source weighs as its share says:

    loss = mean_i w_i BCE(familiarity(x_i), y_i) + DECAY |weights|^2,   y = 1 recorded

with Adam over all scenes at once from a fixed seed: the same scenes give the same
familiarity. What never varies gets no weight.
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax

from rcirl_jax.data.store.dataset import Dataset, Demonstrations
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.score import candidates_key
from rcirl_jax.export.reader import PriorCost
from rcirl_jax.features import FeatureMap, feature_map
from rcirl_jax.planner.baselines import constant_speed_trajectory
from rcirl_jax.planner.own_cost import OwnCost
from rcirl_jax.planner.prediction import with_predicted_futures
from rcirl_jax.planner.rank import ONLINE, Score, hand_score, online, own_score
from rcirl_jax.reward.familiarity import (
    UNITS,
    Familiarity,
    familiar_nowhere,
    familiarity_logit,
    of_the_scene,
)
from rcirl_jax.runtime.atomic_files import read_json, write_json
from rcirl_jax.sampling import SamplerConfig, sample
from rcirl_jax.sampling.sampler import as_candidates, as_planned
from rcirl_jax.tuning.recipes import PriorCostConfig
from rcirl_jax.tuning.run import Run
from rcirl_jax.types import Scene

OWN_COST = "hand-set"  # stands for the planner's own cost where none is given
COMPARED_SCENES = 256  # training scenes of each source in which costs are compared
STEPS = 1500
STEP_SIZE = 1e-2
DECAY = 1e-3
ELSEWHERE = 3.0  # weight of the catalogue, where the recordings have 1
STILL = 1e-3  # scale below which a feature does not vary
LANES = 64  # scenes whose features are made together
ARRAYS = ("location", "scale", "kernel", "bias", "out", "offset")


def fitted_prior_cost(
    config: PriorCostConfig,
    recorded: Sequence[Dataset],
    shares: Sequence[float],
    elsewhere: Sequence[Dataset],
    features: FeatureMap,
    own: OwnCost | None = None,
    sampler: SamplerConfig = ONLINE,
) -> PriorCost:
    """The prior cost of a weights file, from the training splits.

    Gains of a recipe are in units of the hand-set cost. Those of another own cost are

        gain = gain of the recipe * unit(own cost) / unit(hand-set cost)
        unit(c) = median over scenes of (lower quartile of c - min of c)

    over the feasible candidates: what a cost sets between candidates that it would
    hardly choose says nothing. An own cost times 7, or plus 3, drives the same.

    Args:
      config: gains.
      recorded: the sources.
      shares: > 0, how much each of them counts.
      elsewhere: simulated demonstrations; needed where the gain varies.
      features: of the reward.
      own: the user's own cost; None: the hand-set one.
      sampler: of the planner.
    """
    made = familiar_nowhere(features.num_features)
    if config.low < config.high:
        mine = [_training_scenes(one, features, sampler) for one in recorded]
        weights = [
            np.full(len(x), share / len(x))
            for x, share in zip(mine, shares, strict=True)
        ]
        others = [
            _training_scenes(one, features, sampler, config.slowed) for one in elsewhere
        ]
        made = fit_familiarity(
            np.concatenate(mine),
            np.concatenate(weights),
            np.concatenate(others),
            np.asarray(of_the_scene(features)),
        )
    arrays = {name: np.asarray(getattr(made, name)) for name in ARRAYS}
    arrays["offset"] = arrays["offset"].reshape(1)
    name, unit = OWN_COST, 1.0
    if own is not None:
        scenes, rows = some_scenes(recorded)
        unit_by = functools.partial(unit_of, scenes, rows, sampler=sampler)
        each = unit_by(own.score), unit_by(hand_score)
        name, unit = own.name, float(each[0] / each[1])
    low, high = config.low * unit, config.high * unit
    return PriorCost(incumbent=name, low=low, high=high, **arrays)


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
    """The unit [] of a cost, by the equation of `fitted_prior_cost`.

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


def write_prior_cost(path: Path, prior_cost: PriorCost) -> None:
    """The prior cost as JSON; float32 survives it."""
    fields = dataclasses.asdict(prior_cost)
    as_lists = {n: x.tolist() for n, x in fields.items() if isinstance(x, np.ndarray)}
    write_json(path, {**fields, **as_lists})


def read_prior_cost(path: Path) -> PriorCost:
    """The prior cost of a file that `write_prior_cost` wrote.

    Raises:
      InputError: it is not.
    """
    found = read_json(path, "a prior cost as written")
    try:
        arrays = {n: np.asarray(found[n], np.float32) for n in ARRAYS}
        own = str(found["incumbent"]), float(found["low"]), float(found["high"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: {error}: expected a prior cost as written"
        ) from error
    return PriorCost(incumbent=own[0], low=own[1], high=own[2], **arrays)


def _training_scenes(
    dataset: Dataset,
    features: FeatureMap,
    sampler: SamplerConfig,
    slowed: Sequence[float] = (),
) -> np.ndarray:
    """Features of the training scenes, then of the same with a slower, steady ego."""
    scene = dataset.load("train").scene
    egos = [scene.ego.replace(v=x * scene.ego.v, a=0.0 * scene.ego.a) for x in slowed]
    scenes = [scene, *[scene.replace(ego=ego) for ego in egos]]
    return np.concatenate([scene_features(one, features, sampler) for one in scenes])


def scene_features(
    scenes: Scene, features: FeatureMap, sampler: SamplerConfig = ONLINE
) -> np.ndarray:
    """[n, F] raw features of n scenes at t = 0, as a planner of a sampler sees them."""
    count = len(scenes.ego.v)
    parts = []
    for first in range(0, count, LANES):
        # the last are filled up: one shape to compile
        at = np.minimum(np.arange(first, first + LANES), count - 1)
        some = jax.tree.map(lambda x, at=at: np.asarray(x)[at], scenes)
        parts.append(np.asarray(_scene_features(some, features, sampler)))
    return np.concatenate(parts)[:count]


@functools.partial(jax.jit, static_argnames=("features", "sampler"))
def _scene_features(
    scenes: Scene, features: FeatureMap, sampler: SamplerConfig
) -> jax.Array:
    def one(scene: Scene) -> jax.Array:
        scene = with_predicted_futures(as_planned(scene, sampler))
        straight = constant_speed_trajectory(scene, sampler.mode == "speed")
        rows = features.rows(scene, as_candidates(straight))
        return jnp.stack([row[0, 0] for row in rows])

    return jax.vmap(one)(scenes)


def fit_familiarity(
    recorded: np.ndarray, weights: np.ndarray, elsewhere: np.ndarray, counts: np.ndarray
) -> Familiarity:
    """The familiarity of recorded scenes.

    Args:
      recorded: [n, F] of `scene_features`.
      weights: [n] > 0, of the recorded scenes.
      elsewhere: [m, F], of the catalogue's.
      counts: [F] bool, of `of_the_scene`.
    """
    both = np.concatenate([recorded, elsewhere]).astype(np.float64)
    location, spread = both.mean(axis=0), both.std(axis=0)
    varies = counts & (spread > STILL)
    scale = np.where(varies, spread, 1.0)
    shares = np.concatenate(
        [
            weights / weights.sum(),
            np.full(len(elsewhere), ELSEWHERE / len(elsewhere)),
        ]
    )
    mask = jnp.asarray(varies, jnp.float32)[:, None]
    first, last = jax.random.split(jax.random.key(0))
    size = recorded.shape[1]
    start = Familiarity(
        location=jnp.asarray(location, jnp.float32),
        scale=jnp.asarray(scale, jnp.float32),
        kernel=mask * jax.random.normal(first, (size, UNITS)) * size**-0.5,
        bias=jnp.zeros(UNITS),
        out=jax.random.normal(last, (UNITS,)) * UNITS**-0.5,
        offset=jnp.zeros(()),
    )
    labels = np.arange(len(both)) < len(recorded)
    return _fit(
        start,
        mask,
        jnp.asarray(both, jnp.float32),
        jnp.asarray(labels, jnp.float32),
        jnp.asarray(shares / (1.0 + ELSEWHERE), jnp.float32),
    )


@jax.jit
def _fit(
    start: Familiarity, mask: jax.Array, x: jax.Array, y: jax.Array, share: jax.Array
) -> Familiarity:
    optimizer = optax.adam(STEP_SIZE)
    free = {name: getattr(start, name) for name in ("kernel", "bias", "out", "offset")}

    def loss(free: dict[str, jax.Array]) -> jax.Array:
        logits = familiarity_logit(start.replace(**free), x)
        fit = jnp.sum(share * optax.sigmoid_binary_cross_entropy(logits, y))
        return fit + DECAY * sum(jnp.sum(leaf**2) for leaf in free.values())

    def step(_: int, carry: tuple) -> tuple:
        free, state = carry
        updates, state = optimizer.update(jax.grad(loss)(free), state)
        return optax.apply_updates(free, updates), state

    free, _ = jax.lax.fori_loop(0, STEPS, step, (free, optimizer.init(free)))
    return start.replace(**free | {"kernel": mask * free["kernel"]})


def fit_prior_cost(
    run: Run,
    sources: Sequence[Dataset],
    shares: Sequence[float],
    drives: Sequence[Dataset],
) -> Path | None:
    """The prior cost, fitted on recordings against simulated drives, if wanted."""
    config, path = run.config, prior_cost_file(run)
    if path is None:
        return None
    inputs = {
        "prior_cost": dataclasses.asdict(config.prior_cost),
        "recorded": [one.hash for one in sources],
        "shares": list(shares),
        "drives": [one.hash for one in drives],
        "features": config.train.features,
        "own_cost": run.own_cost.sha256 if run.own_cost else OWN_COST,
        **run.candidates,
    }
    sampler = online(config.train.sampler).sampler

    def work() -> None:
        features = feature_map(config.train.features)
        made = fitted_prior_cost(
            config.prior_cost, sources, shares, drives, features, run.own_cost, sampler
        )
        write_prior_cost(path, made)

    run.stage("prior cost", inputs, [path], work)
    return path


def prior_cost_file(run: Run) -> Path | None:
    """Returns the file of the prior cost, or None."""
    return run.folder / "prior_cost.json" if run.config.prior_cost.wanted else None


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
