"""Scenes -> what a learner compares: the human's features beside the candidates'.

Besides features, losses read distances, faults and densities (`CandidateInfo`).
"""

import functools
from collections.abc import Iterator
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.data.store.dataset import Demonstrations
from rcirl_jax.data.store.rows import check_some, refuse_scenes
from rcirl_jax.features import FeatureMap, feature_map
from rcirl_jax.features.columns import Frame
from rcirl_jax.features.mapping import candidate_frames
from rcirl_jax.planner.prediction import select_future, with_predicted_futures
from rcirl_jax.planner.rank import online, own_score
from rcirl_jax.planner.safety import check
from rcirl_jax.reward import CandidateInfo
from rcirl_jax.reward.network import matmul_f32
from rcirl_jax.sampling import (
    SamplerConfig,
    hard_negatives,
    sample,
    trajectory_from_positions,
    trajectory_on_path,
)
from rcirl_jax.sampling.sampler import as_planned, family_index
from rcirl_jax.train.state import Batch, FeatureBatch, TrainConfig
from rcirl_jax.types import Candidates, Demonstration, Scene, Tag, Trajectory
from rcirl_jax.units import TIMES_S

CHUNK = 128  # scenes featurised per call where no batch sets their number
NORMALISER_SCENES = 2048  # training scenes whose features fit the normaliser
NORMALISER_STREAM = 7  # fold_in number of the key that samples for the normaliser
LANES = 16  # float32 numbers of the widest vectors of a CPU
SAMPLER_STREAM = 0  # fold_in number of the sampler's key
NEGATIVE_STREAM = 1  # fold_in number of the hard negatives' key
FUTURES_STREAM = 2  # fold_in number of the draw between futures
SLOWED_STREAM = 3  # fold_in number of the draw of the ego's speed
OVER_LIMIT_MPS = 0.5  # m/s above the limit that counts as breaking it
KERNEL_M = 2.0  # m, bandwidth of the proposal's density


def human_of(demonstration: Demonstration, sampler: SamplerConfig) -> Trajectory:
    """The human's Trajectory under the sampler's mode.

    Along the given path in `speed` mode, as recorded in `path_speed` mode;
    through the operator that makes the candidates in both.
    """
    scene, human = demonstration.scene, demonstration.human
    if sampler.mode == "speed":
        return trajectory_on_path(scene, human.s)
    return trajectory_from_positions(scene, human.s, human.l)


def candidates_of(
    key: jax.Array, demonstration: Demonstration, config: TrainConfig
) -> Candidates:
    """Sampled candidates of one scene, with hard negatives if configured."""
    sampled = sample(
        jax.random.fold_in(key, SAMPLER_STREAM), demonstration.scene, config.sampler
    )
    if config.hard_negatives == 0:
        return sampled
    near = hard_negatives(
        jax.random.fold_in(key, NEGATIVE_STREAM),
        demonstration.scene,
        human_of(demonstration, config.sampler),
        config.sampler,
        config.hard_drawn,
    )
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), sampled, near)


def _under_futures(key: jax.Array, scene: Scene, futures: str) -> Scene:
    """The others' future as `TrainConfig.futures` says. Key not consumed."""
    if futures == "recorded":
        return scene
    if futures == "predicted":
        return with_predicted_futures(scene)
    return select_future(
        scene, jax.random.bernoulli(jax.random.fold_in(key, FUTURES_STREAM))
    )


def _slowed(key: jax.Array, scene: Scene, shares: tuple[float, ...]) -> Scene:
    """Simulated scenes, half of them with a slower, steady ego. Key not consumed."""
    if not shares:
        return scene
    every = jnp.asarray([*shares, *[1.0] * len(shares)])
    draw = jax.random.fold_in(key, SLOWED_STREAM)
    share = jnp.where(scene.tags[Tag.SIMULATED], jax.random.choice(draw, every), 1.0)
    ego = scene.ego
    slower = ego.replace(v=share * ego.v, a=jnp.where(share < 1.0, 0.0, ego.a))
    return scene.replace(ego=slower)


def featurise(
    key: jax.Array, batch: Batch, config: TrainConfig, features: FeatureMap
) -> FeatureBatch:
    """Candidates and features of a batch; each scene's key comes from its row.

    With `positive="nearest"` the feasible sampled candidate nearest to the human
    replaces the human's trajectory: training then asks for a trajectory that the
    planner can choose, and errors of the recording teach nothing.
    """
    seen = jnp.asarray(TIMES_S) <= config.train_horizon + 1e-6

    def one(index: jax.Array, demonstration: Demonstration) -> tuple:
        own_key = jax.random.fold_in(key, index)
        scene = as_planned(demonstration.scene, config.sampler)
        scene = _slowed(own_key, scene, config.slowed)
        scene = _under_futures(own_key, scene, config.futures)
        demonstration = demonstration.replace(scene=scene)
        valid = demonstration.scene.time_valid & seen
        candidates = candidates_of(own_key, demonstration, config)
        driven = human_of(demonstration, config.sampler)
        # the human stands behind the candidates, as often as fills whole vectors of a
        # processor: one pass for all
        sampled = candidates.feasible.size
        humans = LANES - sampled % LANES

        def join(many: jax.Array, one: jax.Array) -> jax.Array:
            return jnp.concatenate([many, jnp.tile(one, (humans, 1))])

        all_trajectories = jax.tree.map(join, candidates.trajectory, driven)
        frames = candidate_frames(demonstration.scene, all_trajectories)
        both = jnp.stack(
            features.of_trajectories(demonstration.scene, all_trajectories, frames)
        )
        human, rows = both[:, :, sampled].T, both[:, :, :sampled]
        frames = jax.tree.map(lambda x: x[:, :sampled], frames)

        def with_densities(info: CandidateInfo, counts: jax.Array) -> CandidateInfo:
            """Those of the candidates that count, where the loss asks for them."""
            if config.loss != "listwise":
                return info
            of_human, own = densities(driven, candidates.trajectory, counts, valid)
            return info.replace(human_density=of_human, density=own)

        info = info_of(driven, candidates, frames, valid)
        feasible = candidates.feasible
        if config.positive == "human":
            return human, rows, feasible, with_densities(info, feasible), valid
        # a planner can choose what the sampler made, not a hard negative
        choice = feasible & (candidates.family != family_index("hard_negative"))
        choice = choice & admitted(demonstration.scene, candidates, config)
        near = jnp.argmin(jnp.where(choice, info.distance, jnp.inf))
        # what is nearer than the positive without being a choice is no worse than it
        counts = choice | (info.distance > info.distance[near])
        if config.residual_on:
            # where nobody was recorded, what the own cost chooses
            own = own_score(config.residual_on)(None, scene, candidates)
            own = own / config.own_unit
            simulated = scene.tags[Tag.SIMULATED]
            chosen = jnp.argmax(jnp.where(choice, own, -jnp.inf))
            near = jnp.where(simulated, chosen, near)
            counts = jnp.where(simulated, choice, counts)
            info = info.replace(own=own, human_own=own[near])
        feasible = feasible & counts & jnp.any(choice)
        info = with_densities(info, feasible)
        info = info.replace(
            human_distance=info.distance[near],
            human_collides=info.collides[near],
            human_density=info.density[near],
        )
        feasible = feasible.at[near].set(False)
        return rows[:, :, near].T, rows, feasible, info, valid

    made = jax.vmap(one)(batch.index, batch.demonstrations)
    human, rows, feasible, info, valid = made
    return FeatureBatch(
        human=human,
        candidates=rows,
        feasible=feasible,
        time_valid=valid,
        info=info,
        weight=batch.weight,
        index=batch.index,
    )


def featurised(key: jax.Array, batch: Batch, config: TrainConfig) -> FeatureBatch:
    """`featurise` as one program, for what is made outside of a step.

    Runs that differ in seed, step size or loss share it.
    """
    return _featurised(key, batch, config.for_features)


@functools.partial(jax.jit, static_argnames="config")
def _featurised(key: jax.Array, batch: Batch, config: TrainConfig) -> FeatureBatch:
    return featurise(key, batch, config, feature_map(config.features))


def host_batch(
    demonstrations: Demonstration, weight: np.ndarray, index: np.ndarray
) -> Batch:
    """Returns a Batch of numpy arrays of the step's types."""
    weight, index = np.asarray(weight, np.float32), np.asarray(index, np.int32)
    return Batch(
        demonstrations=demonstrations,
        weight=cast(jax.Array, weight),
        index=cast(jax.Array, index),
    )


def in_chunks(
    key: jax.Array,
    rows: Demonstration,
    index: np.ndarray,
    config: TrainConfig,
    stored: np.ndarray | None = None,
) -> Iterator[FeatureBatch]:
    """Makes features (numpy) of S scenes, CHUNK at a time; each scene once.

    Args:
      key: of the candidates, with the numbers of `index`.
      rows: S demonstrations (numpy).
      index: [S] number of each scene.
      config: sampler, positive, features.
      stored: [S] dataset row of each scene, where that is not `index`.

    Raises:
      InputError: no scenes, or a feature is NaN or infinite (names the scene).
    """
    stored = index if stored is None else stored
    check_some("train", index)
    for start in range(0, index.size, CHUNK):
        # the last chunk is filled up: one shape to compile
        at = np.minimum(np.arange(start, start + CHUNK), index.size - 1)
        taken = jax.tree.map(lambda x, at=at: x[at], rows)
        batch = jax.device_put(host_batch(taken, np.ones(CHUNK), index[at]))
        made, keep = featurised(key, batch, config), min(CHUNK, index.size - start)
        made = jax.tree.map(lambda x, n=keep: np.asarray(x[:n]), made)
        refuse_scenes("train", taken, stored[at], not_finite(made, config.features))
        yield made


def normaliser_rows(dataset: Demonstrations, config: TrainConfig) -> np.ndarray:
    """[n, F] features of humans and feasible candidates of some training scenes."""
    index = dataset.indices("train")
    chosen = np.random.default_rng([config.seed, NORMALISER_STREAM])
    chosen = np.sort(chosen.permutation(index.size)[:NORMALISER_SCENES])
    rows = dataset.read(index[chosen])
    key = jax.random.fold_in(jax.random.key(config.seed), NORMALISER_STREAM)
    parts = in_chunks(key, rows, chosen, config, index[chosen])
    return np.concatenate([valid_feature_rows(part) for part in parts])


def valid_feature_rows(batch: FeatureBatch) -> np.ndarray:
    """[n, F] features at valid times of humans and feasible candidates."""
    valid = np.asarray(batch.time_valid)
    human = np.asarray(batch.human)[valid]
    both = np.asarray(batch.feasible)[:, :, None] & valid[:, None, :]
    return np.concatenate([human, np.asarray(batch.points)[both]])


def not_finite(made: FeatureBatch, preset: str) -> dict[str, Any]:
    """Returns name -> [B] bool: scenes in which that feature or fact is not finite.

    Args:
      made: features (numpy).
      preset: of the features.
    """
    candidates, human = np.asarray(made.candidates), np.asarray(made.human)
    found = {
        f"feature {name}": ~np.isfinite(candidates[:, i]).all(axis=(1, 2))
        | ~np.isfinite(human[:, :, i]).all(axis=1)
        for i, name in enumerate(feature_map(preset).names)
    }
    info = made.info
    of_each = np.asarray(info.distance + info.breaks_rule + info.density + info.own)
    of_human = np.asarray(info.human_distance + info.human_density + info.human_own)
    bad = (~np.isfinite(of_each) & np.asarray(made.feasible)).any(axis=-1)
    bad |= ~np.isfinite(of_human)
    return {**found, "distance, density, broken rules or own cost of a candidate": bad}


def info_of(
    driven: Trajectory,
    candidates: Candidates,
    frames: Frame,
    valid: jax.Array,
) -> CandidateInfo:
    """Distances, collisions and broken rules of one scene, leaves [K].

    Over the times in `valid` [T]; the human's own are of the recorded trajectory.
    `frames` are those of the candidates, [T, K].
    """
    x = candidates.trajectory
    count = jnp.sum(valid)
    seen = valid[:, None]
    fast = frames.point.v > frames.path.speed_limit + OVER_LIMIT_MPS
    crossed = frames.relations.line_overrun > 0.0  # at the one time that it happens
    return CandidateInfo(
        human_distance=jnp.zeros(()),
        human_collides=jnp.zeros((), bool),
        distance=mean_distance(x, driven, valid),
        collides=jnp.any((frames.relations.body < 0.0) & seen, axis=0),
        breaks_rule=jnp.where(
            jnp.any(crossed & seen, axis=0), 1.0, jnp.sum(fast & seen, axis=0) / count
        ),
        human_density=jnp.zeros(()),
        density=jnp.zeros(x.s.shape[:1]),
        human_own=jnp.zeros(()),
        own=jnp.zeros(x.s.shape[:1]),
    )


def admitted(scene: Scene, candidates: Candidates, config: TrainConfig) -> jax.Array:
    """[K] bool: candidates that the safety filter lets a planner choose.

    An expert in the simulator stops at a line and then drives over it; the planner's
    view at the start of the scene forbids that for all its times.

    Args:
      scene: as the planner sees it.
      candidates: of it, K.
      config: `admissible_in` says in which scenes the filter is asked: in none, in
        those that an expert drove, or in all; elsewhere every candidate is admitted.
    """
    if config.admissible_in == "none":
        return jnp.ones(candidates.feasible.shape, bool)
    passed = check(scene, candidates, online(config.sampler).safety).admissible
    if config.admissible_in == "simulated":
        passed = passed | ~scene.tags[Tag.SIMULATED]
    return passed


def densities(
    driven: Trajectory, x: Trajectory, counts: jax.Array, valid: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Log densities of the human [] and of the candidates [K] (`log_density`).

    Args:
      driven: the human's curve.
      x: the candidates, [K, T].
      counts: [K] bool, those that the partition function sums over, and the positive.
      valid: [T] bool, times that count.
    """
    # the human's own curve, the origin, stands last
    s, l = (
        jnp.pad(a - b, ((0, 1), (0, 0))) for a, b in ((x.s, driven.s), (x.l, driven.l))
    )
    squared = rms_squared(s, l, valid)
    others = counts & ~jnp.eye(counts.size, dtype=bool)
    human = log_density(squared[-1, :-1], counts)
    return human, log_density(squared[:-1, :-1], others)


def rms_squared(s: jax.Array, l: jax.Array, valid: jax.Array) -> jax.Array:
    """Squared RMS distances [K, K] m^2 of K trajectories over valid times [T].

    d_ij^2 = |p_i|^2 + |p_j|^2 - 2 p_i p_j with each trajectory as a vector p: a matrix
    product, where the differences of all pairs take twenty times as long.

    Args:
      s: [K, T] m, stations from an origin near the curves, for the sake of rounding.
      l: [K, T] m, offsets likewise.
      valid: [T] bool.
    """
    weight = jnp.sqrt(valid / jnp.sum(valid))
    p = jnp.concatenate([s * weight, l * weight], axis=1)
    own = jnp.sum(p * p, axis=1)
    return jnp.maximum(own[:, None] + own - 2.0 * matmul_f32(p, p.T), 0.0)


def mean_distance(a: Trajectory, b: Trajectory, valid: jax.Array) -> jax.Array:
    """Mean distance [m] over valid times [T]."""
    distance = jnp.sqrt((a.s - b.s) ** 2 + (a.l - b.l) ** 2 + 1e-9)
    return jnp.sum(jnp.where(valid, distance, 0.0), axis=-1) / jnp.sum(valid)


def log_density(squared: jax.Array, others: jax.Array) -> jax.Array:
    """Log of the kernel density of the candidates [...].

    log(1 + sum over others of exp(-d^2 / (2 KERNEL_M^2))): each trajectory counts as
    one sample of its own, so that none has density 0.

    Args:
      squared: [..., K] in m^2, squared distance to every candidate.
      others: [..., K] bool, candidates that count besides it; a twin of it does.
    """
    kernel = jnp.exp(-0.5 * squared / KERNEL_M**2)
    return jnp.log1p(jnp.sum(jnp.where(others, kernel, 0.0), axis=-1))
