"""A planner's own candidates, given by its user: a function that JAX can trace.

    sampler.py:my_candidates     my_candidates(scene, key) -> s, l   [K, T] m

Stations and lateral offsets of the ego's centre at `TIMES_S`, in the scene's Frenet
frame, from where the ego is; `s` alone means along the given path. K is the same for
all scenes. What they are driven with beside these, and derivatives, are `sampler`'s.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.user_code import loaded, python_sha256
from rcirl_jax.types import Candidates, Ego, Obstacles, Path, Scene, Tag
from rcirl_jax.units import NUM_OBSTACLES, NUM_STATIONS, NUM_TIMES

MOST = 1024  # candidates of a scene
START_M = 0.01  # m by which a candidate may begin elsewhere than at the ego
OFF_PATH_M = 0.05  # m by which one may leave the given path where only speed is planned
APART_M = 0.5  # m between the ends of candidates that are told apart
EXPECTED = f"expected s, l [K, {NUM_TIMES}] m of (scene, key)"


@functools.cache
def _function(place: str, sha256: str) -> Callable[[Scene, jax.Array], Any]:
    if python_sha256(place, "sampler") != sha256:
        raise InputError(
            f"sampler: {place}: it is no longer the one that was trained with: "
            "expected the same file, or a new training"
        )
    return loaded(place, "sampler")


def own_positions(
    place: str, sha256: str, scene: Scene, key: jax.Array
) -> tuple[jax.Array, jax.Array | None]:
    """Stations and offsets [K, T] of the user's candidates; no offsets: the path's.

    Raises:
      InputError: the function fails, or returns something else.
    """
    try:
        made = _function(place, sha256)(scene, key)
        s, *aside = made if isinstance(made, tuple | list) else (made,)
        parts = [jnp.asarray(x, jnp.float32) for x in (s, *aside)]
    except InputError:
        raise
    except Exception as error:
        why = str(error).splitlines()[0] if str(error) else ""
        raise InputError(
            f"{place}: {type(error).__name__}: {why}: {EXPECTED}, in JAX alone"
        ) from error
    shapes = {x.shape for x in parts}
    shape = parts[0].shape
    fits = len(shape) == 2 and shape[1] == NUM_TIMES and 1 <= shape[0] <= MOST
    if not fits or len(shapes) > 1 or len(parts) > 2:
        found = " and ".join(str(x.shape) for x in parts)
        raise InputError(f"{place}: {found}: {EXPECTED}, K from 1 to {MOST}")
    return parts[0], parts[1] if len(parts) > 1 else None


@functools.cache
def own_count(place: str, sha256: str) -> int:
    """K of the user's candidates."""

    def blank(*shape: int, kind: Any = jnp.float32) -> Any:  # noqa: ANN401
        return jax.ShapeDtypeStruct(shape, kind)

    def alike(of: type, *shape: int) -> dict[str, Any]:
        return {field.name: blank(*shape) for field in dataclasses.fields(of)}

    others = {
        **alike(Obstacles, NUM_OBSTACLES, NUM_TIMES),
        "valid": blank(NUM_OBSTACLES, NUM_TIMES, kind=jnp.bool_),
        "kind": blank(NUM_OBSTACLES, kind=jnp.int32),
        "a": blank(NUM_OBSTACLES),
        "l_dot": blank(NUM_OBSTACLES),
    }
    scene = Scene(
        ego=Ego(**alike(Ego)),
        path=Path(**alike(Path, NUM_STATIONS)),
        obstacles=Obstacles(**others),
        time_valid=blank(NUM_TIMES, kind=jnp.bool_),
        tags=blank(len(Tag), kind=jnp.bool_),
    )
    made = jax.eval_shape(
        lambda scene: own_positions(place, sha256, scene, jax.random.key(0))[0], scene
    )
    return made.shape[0]


def check_own_sampler(
    place: str, on_path: bool, scenes: Scene, keys: jax.Array, made: Candidates
) -> None:
    """Refuses candidates that no planner could choose from.

    They have to be finite, the same when asked again, and begin where the ego is; where
    speed alone is planned, to stay on the given path. In most scenes some of them are
    feasible and differ.

    Args:
      place: FILE.py:FUNCTION.
      on_path: candidates differ in speed along the given path alone.
      scenes: leaves [n, ...].
      keys: [n], of the sampler.
      made: of each of them by `sampler.sample`, leaves [n, K, ...].

    Raises:
      InputError: one of these does not hold; names the scene, the candidate, the value.
    """
    sha256 = python_sha256(place, "sampler")
    ask = jax.jit(jax.vmap(functools.partial(own_positions, place, sha256)))
    first, again = (jax.tree.map(np.asarray, ask(scenes, keys)) for _ in range(2))
    ego = scenes.ego
    own = slice(1, 1 + first[0].shape[1])  # behind constant speed, see `sampler`

    def refuse(wrong: np.ndarray, value: np.ndarray, expected: str) -> None:
        if wrong.any():
            scene, which, time = np.argwhere(wrong)[0]
            raise InputError(
                f"{place}: scene {scene}, candidate {which}, time {time}: "
                f"{value[scene, which, time]:g}: expected {expected}"
            )

    pairs = zip("sl", first, again, (ego.s, ego.l), strict=True)
    for name, x, later, start in pairs:
        if x is None:
            continue
        refuse(~np.isfinite(x), x, f"a finite {name}")
        refuse(x != later, later, f"the same {name} when asked again")
        apart = np.abs(x[..., :1] - np.asarray(start)[:, None, None])
        refuse(apart > START_M, x, f"{name} of the ego at the first time")
    if on_path and first[1] is not None:
        path_l = np.asarray(made.trajectory.l)[:, own]
        off = np.abs(first[1] - path_l) > OFF_PATH_M
        off[..., 0] = False  # the ego may stand beside its path
        refuse(
            off,
            first[1],
            "the given path's l: only speed along it is planned (return s alone)",
        )
    some = np.asarray(made.feasible)[:, own].any(axis=1)
    if np.mean(some) < 0.5:
        raise InputError(
            f"{place}: in {np.mean(~some):.0%} of {some.size} scenes no candidate "
            "keeps the vehicle's limits: expected some that go on from the ego's speed "
            "and acceleration"
        )
    ends = [np.ptp(x[..., -1], axis=1) for x in first if x is not None]
    alike = np.max(ends, axis=0) < APART_M
    if np.mean(alike) > 0.5:
        raise InputError(
            f"{place}: in {np.mean(alike):.0%} of {alike.size} scenes all candidates "
            f"end within {APART_M:g} m: expected different ones"
        )
