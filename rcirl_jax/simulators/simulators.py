"""What a simulator gives and takes (metres, seconds, radians), and which there are.

Episodes run in lock step, one ego each, so that all plans of a step are made at once:

    running = simulator.start(simulator.episodes(count, seed), own=None)
    while any(view is not None for view in (views := running.look())):
        running.step(moves)  # 0.1 s
"""

import dataclasses
import importlib
import inspect
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from rcirl_jax.errors import InputError, did_you_mean
from rcirl_jax.export.own_planner.inputs import Body, Car, CentreLine, Signal
from rcirl_jax.planner.plan import COMMAND_STEP_S

STEP_S = COMMAND_STEP_S  # s between two views of an episode


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """What is seen at one moment: the arguments of `scene_from`, and the way so far.

    A line that stays the same should be the same object from view to view: it is
    smoothed once.
    """

    ego: Car
    centre_line: CentreLine
    obstacles: Sequence[Body] = ()  # all that may matter within 8 s, at least 100 m
    signals: Sequence[Signal] = ()
    destination: tuple[float, float] | None = None  # (x, y) m where it shall stand
    way: float  # m that the ego has driven since the first view
    speed_limit: float  # m/s, posted, where the ego is
    passed_red: int = 0  # stop lines passed against a red light since the last view


@dataclasses.dataclass(frozen=True, kw_only=True)
class Move:
    """What the ego does in the next 0.1 s along its centre line, and means to do then.

    A simulator that moves the ego takes `way`, `speed` and `acceleration`, one that
    tracks trajectories itself takes `future`.
    """

    way: float  # m
    speed: float  # m/s at its end
    acceleration: float  # m/s^2 at its end
    future: np.ndarray  # [18, 3] the plan from now on: t s, way m, speed m/s


class Running(Protocol):
    """Some episodes under way; lists have one entry an episode."""

    def look(self) -> list[View | None]:
        """What is seen now; None: the episode is over."""
        ...

    def step(self, moves: Sequence[Move | None]) -> None:
        """Go on by 0.1 s; None: the own driver drives, or the episode is over."""
        ...

    def close(self) -> None:
        """End what runs."""
        ...


class Simulator(Protocol):
    """A simulator that somebody else wrote."""

    name: str
    # its own ways to drive the ego, the first being the one to compare with
    own_drivers: tuple[str, ...]
    together: int  # episodes that run in lock step at most

    def episodes(self, count: int, seed: int) -> list[str]:
        """Names of different episodes, KIND/NUMBER; a name says all that makes it."""
        ...

    def start(self, episodes: Sequence[str], own: str | None) -> Running:
        """Begin episodes, the ego driven by moves or by one of the own drivers."""
        ...


class Episode(Protocol):
    """One episode of a simulator whose episodes know nothing of each other."""

    def look(self) -> View | None:
        """What is seen now; None: it is over."""
        ...

    def step(self, move: Move | None) -> None:
        """Go on by 0.1 s; None: the own driver drives."""
        ...

    def close(self) -> None:
        """End what runs."""
        ...


class LockStep:
    """A `Running` of separate episodes; one that is over is not stepped again."""

    def __init__(self, episodes: Sequence[Episode]) -> None:
        self.episodes = episodes
        self.views = [episode.look() for episode in episodes]

    def look(self) -> list[View | None]:
        """What each of them sees."""
        return self.views

    def step(self, moves: Sequence[Move | None]) -> None:
        """Each of them that is not over goes on."""
        for n, (episode, move) in enumerate(zip(self.episodes, moves, strict=True)):
            if self.views[n] is not None:
                episode.step(move)
                self.views[n] = episode.look()

    def close(self) -> None:
        """End all of them."""
        for episode in self.episodes:
            episode.close()


# name: (module, class, extra of pyproject.toml that it needs)
SIMULATORS = {
    "highway_env": ("rcirl_jax.simulators.highway", "HighwayEnv", "highway"),
    "sumo": ("rcirl_jax.simulators.sumo", "Sumo", "sumo"),
    "commonroad": ("rcirl_jax.simulators.commonroad.simulator", "CommonRoad", ""),
}


def open_simulator(name: str, **options: Any) -> Simulator:  # noqa: ANN401
    """The simulator of a name; its package is imported here and not before.

    Args:
      name: of `SIMULATORS`.
      **options: of its class.

    Raises:
      InputError: no such name or option, or its package is not installed.
    """
    if name not in SIMULATORS:
        raise InputError(
            f"--simulator: {name}: expected one of {', '.join(SIMULATORS)}"
            f"{did_you_mean(name, list(SIMULATORS))}"
        )
    module, kind, extra = SIMULATORS[name]
    try:
        simulator = getattr(importlib.import_module(module), kind)
    except ModuleNotFoundError as error:
        if str(error.name).startswith("rcirl_jax"):
            raise
        raise InputError(
            f"--simulator: {name}: {error.name} is not installed: "
            f"pip install 'rcirl-jax[{extra}]'"
        ) from None
    try:
        inspect.signature(simulator).bind(**options)
    except TypeError as error:
        known = ", ".join(inspect.signature(simulator).parameters) or "none"
        raise InputError(
            f"--options: {error}: expected NAME=VALUE of {known}"
        ) from None
    return simulator(**options)
