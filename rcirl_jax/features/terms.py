"""A planner's own cost terms as columns of F: named functions given by its user.

    terms.py:TERMS     {name: (term, weight)}, with weight > 0 as it drives today

    cost = sum_i weight_i (mean over times of term_i),   lower is better

`term(scene, trajectory)` is a number or an array [T], of one `types.Scene` and one
`types.Trajectory`. Beyond the last valid time of a scene a trajectory stands still at
what it was. Terms that JAX can trace become a part of the compiled programs; those that
need numbers (numpy, `float`) are called back, one trajectory at a time, which is
slower.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.user_code import loaded, python_sha256
from rcirl_jax.types import Scene, Trajectory
from rcirl_jax.units import NUM_TIMES

Term = Callable[[Any, Any], Any]
# what JAX raises where a function needs numbers
NOT_TRACEABLE = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
)
EXPECTED = "expected {name: (term, weight)}, the weight as it drives today"
OF_A_TERM = f"expected a number or an array [{NUM_TIMES}] of (scene, trajectory)"
MOST = 64  # terms, as many features as a weights file has
LONGEST_NAME = 64  # characters, as weights files have it


@dataclasses.dataclass(frozen=True, kw_only=True)
class OwnTerms:
    """Own terms by their place; small and hashable."""

    place: str  # FILE.py:NAME
    sha256: str  # of the file
    names: tuple[str, ...]
    weights: tuple[float, ...]  # > 0, as the planner drives today

    @property
    def is_called_back(self) -> bool:
        """True if JAX cannot trace them; known once they were traced."""
        return self in _called_back

    def rows(self, scene: Scene, trajectories: Trajectory) -> tuple[jax.Array, ...]:
        """Computes the terms, each [T, K], of K trajectories [K, T] of a scene."""
        last = jnp.sum(scene.time_valid) - 1
        at = jnp.minimum(jnp.arange(NUM_TIMES), last)
        held = jax.tree.map(lambda x: x[:, at], trajectories)
        if not self.is_called_back:
            try:
                each = jax.vmap(self._columns, in_axes=(None, 0), out_axes=-1)
                return tuple(each(scene, held))
            except NOT_TRACEABLE:
                _called_back.add(self)
        shape = (len(self.names), *held.s.shape[::-1])
        made = jax.pure_callback(
            self.called,
            jax.ShapeDtypeStruct(shape, jnp.float32),
            scene,
            held,
            vmap_method="broadcast_all",
        )
        return tuple(made[i] for i in range(len(self.names)))

    def _columns(self, scene: Any, trajectory: Any, xp: Any = jnp) -> list:  # noqa: ANN401
        """Computes the terms [T] of one trajectory, by jax.numpy or numpy."""
        columns = []
        for name, (term, _) in _terms(self.place).items():
            try:
                made = xp.asarray(term(scene, trajectory), xp.float32)
            except NOT_TRACEABLE:
                raise
            except Exception as error:
                raise InputError(
                    f"{self.place}: {name}: {type(error).__name__}: {error}: "
                    f"{OF_A_TERM}"
                ) from error
            if made.shape not in ((), (NUM_TIMES,)):
                raise InputError(
                    f"{self.place}: {name}: shape {made.shape}: {OF_A_TERM}"
                )
            columns.append(xp.broadcast_to(made, (NUM_TIMES,)))
        return columns

    def called(self, scenes: Scene, trajectories: Trajectory) -> np.ndarray:
        """Computes the terms [..., F, T, K] of numbers, with leading axes or none.

        Args:
          scenes: leaves [..., of one scene].
          trajectories: K of each, leaves [..., K, T].

        Raises:
          InputError: a term fails, or is no number or array [T].
        """
        scenes, trajectories = jax.tree.map(np.asarray, (scenes, trajectories))
        lead, (count, times) = trajectories.s.shape[:-2], trajectories.s.shape[-2:]
        made = np.empty((*lead, len(self.names), times, count), np.float32)
        for place in np.ndindex(*lead):
            scene, some = jax.tree.map(lambda x, i=place: x[i], (scenes, trajectories))
            for k in range(count):
                one = jax.tree.map(lambda x, i=k: x[i], some)
                made[(*place, ..., k)] = self._columns(scene, one, np)
        return made


_called_back: set[OwnTerms] = set()  # terms that JAX has failed to trace


@functools.cache
def own_terms(place: str) -> OwnTerms:
    """Names the own terms at a place, FILE.py:NAME.

    Raises:
      InputError: no such file or name; what is there are no terms; a weight that is not
        above 0.
    """
    sha256, terms = python_sha256(place, "terms"), _terms(place)
    weights = tuple(float(weight) for _, weight in terms.values())
    return OwnTerms(place=place, sha256=sha256, names=tuple(terms), weights=weights)


@functools.cache
def _terms(place: str) -> Mapping[str, tuple[Term, float]]:
    """Loads {name: (term, weight)}."""
    found = loaded(place, "own terms")
    if not isinstance(found, Mapping) or not 0 < len(found) <= MOST:
        raise InputError(f"{place}: {type(found).__name__}: {EXPECTED}, 1 to {MOST}")
    for name, pair in found.items():
        fits = isinstance(pair, tuple) and len(pair) == 2 and callable(pair[0])
        if not isinstance(name, str) or not 0 < len(name) <= LONGEST_NAME or not fits:
            raise InputError(f"{place}: {name}: {pair}: {EXPECTED}")
        weight = pair[1]
        if not isinstance(weight, int | float) or not 0.0 < weight < math.inf:
            raise InputError(
                f"{place}: {name}: weight {weight!r}: expected a number above 0, as "
                "the planner drives today; of a new term a small one"
            )
    return found
