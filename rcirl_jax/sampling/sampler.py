"""The trajectory sampler: (key, scene, config) -> Candidates, offline and online."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rcirl_jax.features.columns import driven_curvature
from rcirl_jax.geometry.running import running_max
from rcirl_jax.sampling import lateral, speed
from rcirl_jax.sampling.config import SamplerConfig
from rcirl_jax.sampling.kinematics import trajectory_from_positions, trajectory_on_path
from rcirl_jax.types import Candidates, Scene, Trajectory
from rcirl_jax.units import HORIZON_S, TIMES_S


def _speed_families(config: SamplerConfig) -> np.ndarray:
    """Family number of every speed profile, in the order they are built."""
    num_stop = len(config.stop_times) * len(config.stop_gaps)
    num_edge = len(config.edge_times)
    counts = {
        "constant_speed": 1,
        "cruise": len(config.cruise_times) * len(config.cruise_levels),
        "stop": num_stop + len(config.stop_brakings),
        "follow": num_edge * config.num_followed * len(config.follow_headways),
        "overtake": num_edge,
        "envelope": len(config.envelopes),
        "emergency": len(config.emergency_brakings),
        "random": config.num_random,
    }
    numbers = [speed.family_index(name) for name in counts]
    return np.repeat(numbers, list(counts.values())).astype(np.int32)


def _pairs(config: SamplerConfig) -> tuple[np.ndarray, np.ndarray]:
    """(speed profile, lateral profile) of every `path_speed` candidate.

    Every speed profile is driven holding the offset and towards the lane's
    centre; every `lateral_stride`-th with each further lateral profile.
    """
    num_speed = _speed_families(config).size
    everyone = np.arange(num_speed)
    strided = everyone[:: config.lateral_stride]
    pairs = [(i, m) for m in (0, 1) for i in everyone]
    rest = range(2, lateral.num_lateral(config))
    pairs += [(i, m) for m in rest for i in strided]
    grid = np.array(pairs, np.int32)
    return grid[:, 0], grid[:, 1]


def num_candidates(config: SamplerConfig) -> int:
    """K, fixed by the configuration alone."""
    if config.mode == "speed":
        return _speed_families(config).size
    return _pairs(config)[0].size


def sample(key: jax.Array, scene: Scene, config: SamplerConfig) -> Candidates:
    """K candidate trajectories of one scene.

    Args:
      key: typed PRNG key, consumed; only the "random" family depends on it.
      scene: one scene.
      config: static; decides K.

    Returns:
      Candidates with K = `num_candidates(config)`. Infeasible ones stay in
      place and are masked; emergency stops count as feasible always.
    """
    with jax.named_scope("sampling"):
        stations = speed_profiles(key, scene, config)
        family = jnp.asarray(_speed_families(config))
        if config.mode == "speed":
            trajectory = jax.vmap(trajectory_on_path, in_axes=(None, 0))(
                scene, stations
            )
            allowed = jnp.ones(family.shape, bool)
        else:
            which_speed, which_lateral = _pairs(config)
            target, length, allowed = lateral.lateral_targets(scene, config)
            trajectory = jax.vmap(_with_lateral, in_axes=(None, 0, 0, 0))(
                scene,
                stations[which_speed],
                target[which_lateral],
                length[which_lateral],
            )
            family = family[which_speed]
            allowed = allowed[which_lateral] > 0.0
        inside = jax.vmap(lambda x: within_limits(scene, x, config))(trajectory)
        is_emergency = family == speed.family_index("emergency")
        return Candidates(
            trajectory=trajectory,
            feasible=(inside | is_emergency) & allowed,
            family=family,
        )


def speed_profiles(
    key: jax.Array, scene: Scene, config: SamplerConfig
) -> Float[Array, "m t"]:
    """Stations of all speed profiles, in the order of `_speed_families`.

    Reversing is replaced by standing still.
    """
    stations = jnp.concatenate(
        [
            speed.constant_speed(scene),
            speed.cruise(scene, config),
            speed.stop(scene, config),
            speed.follow(scene, config),
            speed.overtake(scene, config),
            speed.envelope(scene, config),
            speed.emergency(scene, config),
            speed.random_two_phase(key, scene, config),
        ]
    )
    return running_max(stations)


def _with_lateral(
    scene: Scene, s: jax.Array, target: jax.Array, length: jax.Array
) -> Trajectory:
    l = lateral.lateral_offset(scene, target, length, s)
    return trajectory_from_positions(scene, s, l)


def within_limits(
    scene: Scene, trajectory: Trajectory, config: SamplerConfig
) -> jax.Array:
    """Whether one trajectory respects the vehicle's limits at its valid times.

    a in [min, max], |j|, |kappa|, |v^2 kappa| bounded; v >= 0 holds by
    construction. Times outside the scene's mask and t = 0 (given) do not count.
    """
    kappa = driven_curvature(scene, trajectory)
    ok = (
        (trajectory.a >= config.min_acceleration)
        & (trajectory.a <= config.max_acceleration)
        & (jnp.abs(trajectory.j) <= config.max_jerk)
        & (jnp.abs(kappa) <= config.max_curvature)
        & (jnp.abs(trajectory.v**2 * kappa) <= config.max_lateral_acceleration)
    )
    counts = scene.time_valid.at[0].set(False)
    return jnp.all(ok | ~counts)


DRIFT_SHARE = 0.25  # 1, of a hard negative's size: how far it drifts aside instead


def hard_negatives(
    key: jax.Array, scene: Scene, human: Trajectory, config: SamplerConfig, count: int
) -> Candidates:
    """Offline only: `count` trajectories near the human that drive worse.

    Half brake late and lose the gap (stations ahead of the human's by up to
    6 m at the end), half lag behind; in `path_speed` a third of each drifts aside
    instead, by up to 1.5 m, one half to each side. The departure grows like
    (t / 8)^p with p in [1, 3], so that near times stay human. The key is consumed.
    """
    size_key, power_key = jax.random.split(key)
    size = jax.random.uniform(size_key, (count,), minval=1.0, maxval=6.0)
    sign = jnp.where(jnp.arange(count) % 2 == 0, 1.0, -1.0)
    power = jax.random.uniform(power_key, (count,), minval=1.0, maxval=3.0)
    share = jnp.asarray(TIMES_S) / HORIZON_S
    grows = share[None] ** power[:, None]
    drifts = (jnp.arange(count) % 6 >= 4) & (config.mode == "path_speed")
    along = jnp.where(drifts, 0.0, size * sign)
    stations = running_max(human.s[None] + along[:, None] * grows)
    if config.mode == "speed":
        trajectory = jax.vmap(trajectory_on_path, in_axes=(None, 0))(scene, stations)
    else:
        aside = jnp.where(drifts, DRIFT_SHARE * size * sign, 0.0)
        offsets = human.l[None] + aside[:, None] * grows
        trajectory = jax.vmap(trajectory_from_positions, in_axes=(None, 0, 0))(
            scene, stations, offsets
        )
    return Candidates(
        trajectory=trajectory,
        feasible=jax.vmap(lambda x: within_limits(scene, x, config))(trajectory),
        family=jnp.full((count,), speed.family_index("hard_negative"), jnp.int32),
    )
