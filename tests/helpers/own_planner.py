"""F outside of this package against F inside: scenes out, answers in."""

import dataclasses
import functools

import jax
import numpy as np

from rcirl_jax.export.loading import reward_params
from rcirl_jax.export.own_planner import features as plain
from rcirl_jax.export.own_planner.builder import plain_scene
from rcirl_jax.features import FeatureMap, feature_map
from rcirl_jax.planner.rank import learned_score
from rcirl_jax.planner.safety import check, choose
from rcirl_jax.sampling.kinematics import trajectory_from_positions, trajectory_on_path
from rcirl_jax.sampling.sampler import as_candidates
from rcirl_jax.units import TIMES_S
from tests.helpers.weights_files import columns_of, example_weights, saved

TOLERANCE = 1e-5  # of max(1, |x|)


def every_column():
    """A feature map of all the columns that any preset has."""
    presets = [feature_map(name) for name in ("paper21", "apollo21")]
    specs = {spec.name: spec for preset in presets for spec in preset.specs}
    return FeatureMap("every", tuple(specs.values()))


def drawn_reward(
    path, columns, hidden=(15,), scene_gating=False, seed=3, mode=None,
    with_prior=False, fastest=None,
):  # fmt: skip
    """A weights file of these columns at the usual times, of weights as trained.

    `fastest` m/s is the highest speed that the training saw.
    """
    specs, rng = columns.specs, np.random.default_rng(seed)
    size = len(specs)
    shape = (seed, size, TIMES_S.size, hidden, "tanh", scene_gating)
    drawn = example_weights(*shape, with_prior=with_prior)
    if mode is not None:
        provenance = {**drawn.provenance, "mode": mode}
        drawn = dataclasses.replace(drawn, provenance=provenance)
    lower, upper = (
        np.array([getattr(s, n) for s in specs]) for n in ("lower", "upper")
    )
    seen = upper.copy()
    if fastest is not None:
        seen[columns.names.index("velocity")] = fastest
    gates = drawn.scene_gating
    if gates is not None:  # as training leaves it: what candidates share at t = 0
        gates = gates / size * np.array(columns.context)[:, None]
    made = dataclasses.replace(
        drawn,
        preset=columns.preset,
        **columns_of(specs),
        lower=lower,
        upper=upper,
        training_range=np.stack([lower, seen]),
        location=np.array([spec.none for spec in specs]),
        scale=0.3 * (upper - lower),
        times=TIMES_S,
        kernels=tuple(kernel / np.sqrt(len(kernel)) for kernel in drawn.kernels),
        biases=(*drawn.biases[:-1], np.zeros(1)),  # as training leaves it
        gamma=drawn.gamma / np.sqrt(TIMES_S.size),
        scene_gating=gates,
    )
    x = rng.uniform(lower, upper, (3, TIMES_S.size, size)).astype(np.float32)
    return saved(path, made, x)


def candidates(scene, s, l):
    """The Candidates of one scene from [K, T] positions; l None: on the path."""
    if l is None:
        return as_candidates(jax.vmap(trajectory_on_path, (None, 0))(scene, s))
    make = jax.vmap(trajectory_from_positions, (None, 0, 0))
    return as_candidates(make(scene, s, l))


def plain_cases(scenes, s, l=None):
    """Cases (plain scene, s, l) of scenes [n] and positions [n, K, T]."""
    ones = [jax.tree.map(lambda x, n=n: x[n], scenes) for n in range(len(s))]
    offsets = [None] * len(s) if l is None else l
    return [(plain_scene(x), *at) for x, *at in zip(ones, s, offsets, strict=True)]


@functools.cache
def _answers(columns, activation, on_path):
    score = learned_score(columns, activation)

    def of_one(params, scene, s, l):
        both = candidates(scene, s, None if on_path else l)
        return columns.of_candidates(scene, both), score(params, scene, both)

    return jax.jit(jax.vmap(of_one, (None, 0, 0, 0)))


def compiled_score(columns, reward):
    """A compiled function (scene, s, l [K, T]) -> values [K] of one planning frame."""
    score, params = learned_score(columns, reward.activation), reward_params(reward)
    return jax.jit(lambda scene, s, l: score(params, scene, candidates(scene, s, l)))


def compiled_choice(columns, reward):
    """A compiled function (scene, s, l [K, T]) -> index of the best admissible."""
    score, params = learned_score(columns, reward.activation), reward_params(reward)

    def of_one(scene, s, l):
        given = candidates(scene, s, l)
        return choose(check(scene, given), given, score(params, scene, given))

    return jax.jit(of_one)


def jax_answers(columns, reward, scenes, s, l=None):
    """Features [n, K, T, F] and values [n, K] of JAX.

    Stations and offsets are [n, K, T]; without offsets candidates are on the path.
    """
    program = _answers(columns, reward.activation, l is None)
    found = program(reward_params(reward), scenes, s, s if l is None else l)
    return tuple(np.asarray(x) for x in found)


def numpy_answers(reward, scene, s, l=None):
    """The same of one plain scene by the file for planners; s, l [K, T]."""
    found = plain.FeatureMap(reward.names, reward.units)(scene, s, l)
    return found, reward.value(found, scene.time_valid)


def entries(scene, s, l=None):
    """A case as pairs (label, numbers), as in onboard/conformance/README.md."""
    yield "ego", list(dataclasses.asdict(scene.ego).values())
    for name in ("kappa", "l", "speed_limit", "road_left", "road_right"):
        yield "path_l" if name == "l" else name, getattr(scene.path, name)
    yield "num_valid", [scene.num_valid]
    yield "obstacles", [len(scene.obstacles)]
    for box in scene.obstacles:
        yield "kind", [box.kind]
        for name in ("s_lower", "s_upper", "l_lower", "l_upper", "speed", "valid"):
            yield name, getattr(box, name)
    yield "candidates", [len(s)]
    yield "on_path", [l is None]
    for k in range(len(s)):
        yield "s", s[k]
        if l is not None:
            yield "l", l[k]


def as_numbers(scene, s, l=None):
    """The numbers of `entries` one after the other, float32."""
    return np.concatenate([np.asarray(x, np.float32) for _, x in entries(scene, s, l)])


def error(found, expected):
    """Largest |found - expected| / max(1, |expected|); inf where one is not finite."""
    apart = np.abs(np.asarray(found, float) - expected)
    apart /= np.maximum(1.0, np.abs(expected))
    return float(np.max(np.nan_to_num(apart, nan=np.inf), initial=0.0))


def in_valid_times(scenes, features):
    """Features [n, K, T, F] with 0 at times that do not count."""
    return np.where(np.asarray(scenes.time_valid)[:, None, :, None], features, 0.0)
