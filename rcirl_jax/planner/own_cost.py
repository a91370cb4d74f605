"""A planner's own cost, given by its user: a function of Python, or a C library.

    costs.py:my_cost     my_cost(scene, candidates) -> costs [K], lower is better
    libcost.so           `rcirl_cost` of onboard/include/rcirl/cost_abi.h

A function that JAX can trace becomes a part of the planner's program. Any other, of
numpy or C, is called back from it, in processes of its own with a limit of time: that
is slower, and a crash or an endless loop ends in one line. `scene` and `candidates` are
`types.Scene` and `types.Candidates` of one scene, with numpy arrays where the function
is called back.
"""

import dataclasses
import functools
import logging
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.features.terms import NOT_TRACEABLE
from rcirl_jax.runtime.answering import AnsweringProcess, NoAnswer
from rcirl_jax.runtime.user_code import (
    is_python,
    loaded,
    python_file,
    source_sha256,
)
from rcirl_jax.types import Candidates, Scene

CALL_S = 20.0  # s in which a process has to answer for a batch of scenes
START_S = 60.0  # s in which it has to have loaded the cost
LONGEST_NAME = 64  # characters, as weights files have it
EXPECTED = "expected costs [K] of (scene, candidates), lower is better"

_failed: dict[str, str] = {}  # place -> line on why its process gave no costs
# JAX prints the traceback of a callback that fails; the line says it
logging.getLogger("jax._src.callback").addFilter(lambda record: not _failed)


def is_place(name: str) -> bool:
    """True for what names an own cost: FILE.py:FUNCTION or a library FILE.so."""
    is_library = name.endswith(".so") and not name.startswith("planner:")
    return is_library or is_python(name)


@dataclasses.dataclass(frozen=True, kw_only=True)
class OwnCost:
    """An own cost by its place; small, hashable, can be sent to other processes."""

    place: str  # as given
    sha256: str  # of the file and what it imports of its folder

    @property
    def name(self) -> str:
        """The name of its row: the function's, or the library's without lib and .so."""
        file, _, function = self.place.partition(".py:")
        return function if function else Path(file).stem.removeprefix("lib")

    @property
    def is_called_back(self) -> bool:
        """True if JAX cannot trace it: of a library, or found out while tracing."""
        return self.place.endswith(".so") or self in _called_back

    def score(self, params: None, scene: Scene, candidates: Candidates) -> jax.Array:
        """Minus the cost [K], as `planner.rank.Score`."""
        del params
        if self.is_called_back:
            return -self._asked(scene, candidates)
        try:
            costs = _function(self)(scene, candidates)
        except NOT_TRACEABLE:
            _called_back.add(self)
            return -self._asked(scene, candidates)
        except Exception as error:
            raise InputError(
                f"{self.place}: {type(error).__name__}: {error}: {EXPECTED}"
            ) from error
        count = candidates.feasible.shape
        if np.shape(costs) != count:
            raise InputError(
                f"{self.place}: shape {np.shape(costs)} for {count[0]} candidates: "
                f"{EXPECTED}"
            )
        return -jnp.asarray(costs, jnp.float32)

    def _asked(self, scene: Scene, candidates: Candidates) -> jax.Array:
        shape = jax.ShapeDtypeStruct(candidates.feasible.shape, jnp.float32)
        given = {"scene": scene, "candidates": candidates}

        def costs(given: dict) -> np.ndarray:
            return _processes(self).costs(jax.tree.map(np.asarray, given))

        return jax.pure_callback(costs, shape, given, vmap_method="broadcast_all")


_called_back: set[OwnCost] = set()  # functions that JAX has failed to trace


@functools.cache
def own_cost(place: str) -> OwnCost:
    """Names the own cost at a place.

    Raises:
      InputError: no such file or function, or a name that a baseline has.
    """
    file = python_file(place) if is_python(place) else Path(place)
    try:
        sha256 = source_sha256(file)
    except OSError as error:
        raise InputError(
            f"own cost: {place}: {error.strerror}: expected FILE.py:FUNCTION or a "
            "library FILE.so"
        ) from error
    made = OwnCost(place=place, sha256=sha256)
    if not 0 < len(made.name) <= LONGEST_NAME:
        raise InputError(
            f"own cost: {made.name}: expected a name of 1 to {LONGEST_NAME} characters"
        )
    if not place.endswith(".so"):
        _function(made)
    return made


@functools.cache
def _function(cost: OwnCost) -> Callable[[Scene, Candidates], Any]:
    """Loads the function of a Python file."""
    return loaded(cost.place, "own cost")


def words(cost: OwnCost) -> str:
    """Says how an own cost is computed."""
    how = "a function of JAX"
    if cost.is_called_back:
        how = f"called back in processes of its own, which is slower than {how}"
    return f"own cost {cost.name}: {how}"


def failure(error: BaseException) -> str | None:
    """Returns the line on the own cost's process that an error of JAX is about."""
    lines = [line for line in _failed.values() if line in str(error)]
    return lines[0] if lines else None


class Processes:
    """Processes that compute an own cost, as many as are asked at a time."""

    def __init__(self, place: str) -> None:
        self._place, self._lock = place, threading.Lock()
        self._idle: list[AnsweringProcess] = []

    def costs(self, given: dict) -> np.ndarray:
        """Computes the costs [..., K].

        Args:
          given: "scene" and "candidates", leaves [..., of one scene].

        Raises:
          InputError: the process died, or gave no costs in time.
        """
        feasible = given["candidates"].feasible
        lead = feasible.shape[:-1]
        flat = jax.tree.map(
            lambda x: np.ascontiguousarray(x.reshape(-1, *x.shape[len(lead) :])), given
        )
        plain = _named(flat)
        with self._lock:
            process = self._idle.pop() if self._idle else None
        process = process or self._started()
        made = self._asked(process, plain, CALL_S)
        with self._lock:
            self._idle.append(process)
        costs = np.asarray(made, np.float32)
        if costs.shape != (len(flat["candidates"].feasible), feasible.shape[-1]):
            self._fails(f"shape {costs.shape[1:]} for {feasible.shape[-1]} candidates")
        return costs.reshape(feasible.shape)

    def _started(self) -> AnsweringProcess:
        program = [sys.executable, "-m", "rcirl_jax.planner.own_cost_process"]
        process = AnsweringProcess([*program, self._place])
        self._asked(process, {}, START_S)
        return process

    def _asked(
        self, process: AnsweringProcess, given: dict[str, np.ndarray], limit: float
    ) -> np.ndarray:
        try:
            made = process.ask(given, limit)
        except NoAnswer as error:
            self._fails(str(error))
        if "wrong" in made:
            self._fails(str(made["wrong"]))
        return made["costs"]

    def _fails(self, why: str) -> NoReturn:
        line = str(InputError(f"{self._place}: {why}: {EXPECTED}"))
        _failed[self._place] = line
        raise InputError(line)


_processes_of: dict[OwnCost, Processes] = {}
_making = threading.Lock()


def _processes(cost: OwnCost) -> Processes:
    with _making:
        if cost not in _processes_of:
            _processes_of[cost] = Processes(cost.place)
        return _processes_of[cost]


def _named(tree: Any, name: str = "") -> dict[str, np.ndarray]:  # noqa: ANN401
    """Arrays by their places, "scene.ego.v": a process need not know our types."""
    if dataclasses.is_dataclass(tree):
        tree = {x.name: getattr(tree, x.name) for x in dataclasses.fields(tree)}
    if not isinstance(tree, dict):
        return {name[1:]: tree}
    parts = [_named(part, f"{name}.{key}") for key, part in tree.items()]
    return {key: array for part in parts for key, array in part.items()}


def check_own_cost(
    cost: OwnCost, scenes: Scene, candidates: Candidates, names: Sequence[str] = ()
) -> None:
    """Refuses a cost that no planner could rank by.

    Its costs of feasible candidates have to be finite, the same when asked again, the
    same for a scene alone and in a batch (to 1e-4 of their spread), and different
    within most scenes.

    Args:
      cost: the own cost.
      scenes: leaves [n, ...].
      candidates: of each of them, leaves [n, K, ...].
      names: rows that there are besides.

    Raises:
      InputError: one of these does not hold; names the cost, the scene and the value.
    """
    if cost.name in names:
        raise InputError(
            f"own cost: {cost.name}: expected another name than the rows' "
            f"{', '.join(names)}"
        )
    score = functools.partial(cost.score, None)
    together = jax.jit(jax.vmap(score))
    try:
        costs = -np.asarray(together(scenes, candidates), np.float64)
        again = -np.asarray(together(scenes, candidates), np.float64)
        some = np.linspace(0, len(costs) - 1, 8).astype(int)
        one = lambda i: jax.tree.map(lambda x: x[i], (scenes, candidates))  # noqa: E731
        alone = np.stack([-np.asarray(jax.jit(score)(*one(i)), float) for i in some])
    except jax.errors.JaxRuntimeError as error:
        if line := failure(error):
            raise InputError(line) from error
        raise
    feasible = np.asarray(candidates.feasible)
    wrong = ~np.isfinite(costs) & feasible
    if wrong.any():
        scene, which = np.argwhere(wrong)[0]
        raise InputError(
            f"{cost.place}: scene {scene}, candidate {which}: {costs[scene, which]}: "
            "expected a finite cost of every feasible candidate"
        )
    if not np.array_equal(costs[feasible], again[feasible]):
        scene, which = np.argwhere((costs != again) & feasible)[0]
        raise InputError(
            f"{cost.place}: scene {scene}, candidate {which}: {costs[scene, which]:g}, "
            f"then {again[scene, which]:g}: expected the same cost when asked again"
        )
    low = np.where(feasible, costs, np.inf).min(axis=1)
    high = np.where(feasible, costs, -np.inf).max(axis=1)
    spread = np.where(feasible.any(axis=1), high - low, 0.0)
    apart = np.where(feasible[some], np.abs(alone - costs[some]), 0.0).max(axis=1)
    far = apart > 1e-4 * np.maximum(spread[some], np.abs(low[some]) * 1e-2) + 1e-6
    if far.any():
        raise InputError(
            f"{cost.place}: scene {some[np.argmax(far)]}: alone and in a batch its "
            f"costs differ by {apart.max():g}: expected each scene to count for itself"
        )
    if np.mean(spread > 0.0) < 0.5:
        raise InputError(
            f"{cost.place}: in {np.mean(spread <= 0.0):.0%} of {len(costs)} scenes all "
            "candidates cost the same: expected a cost that tells them apart"
        )
