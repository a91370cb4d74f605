"""The interface of a simulator (metres, seconds, radians), and which there are.

Episodes run in lock step, one ego each, so that all plans of a step are made at once:

    running = simulator.start(simulator.episodes(count, seed), own=None)
    while any(view is not None for view in (views := running.look())):
        running.step(moves)  # 0.1 s
"""

import dataclasses
import importlib
import inspect
import math
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from rcirl_jax.errors import InputError, did_you_mean
from rcirl_jax.export.own_planner.inputs import Body, Car, CentreLine, Signal
from rcirl_jax.features.columns import path_curvature
from rcirl_jax.geometry.frenet import reference_line_from_polyline
from rcirl_jax.planner.plan import COMMAND_STEP_S
from rcirl_jax.units import STATION_STEP_M

STEP_S = COMMAND_STEP_S  # s between two views of an episode
FADING_M = 15.0  # m of way in which an offset from the line falls to 1 / e


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """One moment as it is seen: the arguments of `scene_from`, and the way so far.

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
    # m, how far the centre line lies to the left of that of the view before: it is
    # another one where the ego has changed lanes
    aside: float = 0.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Move:
    """The ego's motion in the next 0.1 s along its centre line, and its plan from then.

    A simulator that moves the ego takes `way`, `speed` and `acceleration`, one that
    tracks trajectories itself takes `future`.
    """

    way: float  # m
    speed: float  # m/s at its end
    acceleration: float  # m/s^2 at its end
    future: np.ndarray  # [18, 3] the plan from now on: t s, way m, speed m/s
    # where paths are planned: offset m to the left of the centre line, its slope 1 and
    # second derivative 1/m by station, at the end
    beside: tuple[float, float, float] | None = None


class Running(Protocol):
    """Some episodes under way; lists have one entry an episode."""

    def look(self) -> list[View | None]:
        """Return what is seen now; None: the episode is over."""
        ...

    def step(self, moves: Sequence[Move | None]) -> None:
        """Advance 0.1 s; None: the own driver drives, or the episode is over."""
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
    changes_lanes: bool  # its egos may leave the middle of their lane

    def episodes(self, count: int, seed: int) -> list[str]:
        """Return names of different episodes, KIND/NUMBER; a name says all of it."""
        ...

    def start(self, episodes: Sequence[str], own: str | None) -> Running:
        """Begin episodes, the ego driven by moves or by one of the own drivers."""
        ...


class Episode(Protocol):
    """One episode of a simulator whose episodes know nothing of each other."""

    def look(self) -> View | None:
        """Return what is seen now; None: it is over."""
        ...

    def step(self, move: Move | None) -> None:
        """Advance 0.1 s; None: the own driver drives."""
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
        """Return what each of them sees."""
        return self.views

    def step(self, moves: Sequence[Move | None]) -> None:
        """Advance each that is not over."""
        for n, (episode, move) in enumerate(zip(self.episodes, moves, strict=True)):
            if self.views[n] is not None:
                episode.step(move)
                self.views[n] = episode.look()

    def close(self) -> None:
        """End all of them."""
        for episode in self.episodes:
            episode.close()


def drawn_names(kinds: Sequence[str], count: int, seed: int) -> list[str]:
    """Return `count` names KIND/SEED/NUMBER, the kinds in turn."""
    return [f"{kinds[n % len(kinds)]}/{seed}/{n:04d}" for n in range(count)]


class Way:
    """A lane's smoothed middle by station: the line that an ego is moved along.

    Args:
      points: [m, 2] m, in driving direction.
      speed_limit: m/s, one, or one for each point from which it holds.
      lane_width: m.
      left: m from the middle to the left edge of the lanes that may be driven on; None:
        of this lane.
      right: m to their right edge.
    """

    def __init__(
        self,
        points: np.ndarray,
        speed_limit: float | np.ndarray,
        lane_width: float,
        left: float | None = None,
        right: float | None = None,
    ) -> None:
        points = np.asarray(points, float)
        arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
        size = int(arc[-1] / STATION_STEP_M) + 1
        line = reference_line_from_polyline(
            points - points[0], size=size, step=STATION_STEP_M
        )
        self.stations = np.arange(size) * STATION_STEP_M
        self._x = np.asarray(line.x, float) + points[0, 0]
        self._y = np.asarray(line.y, float) + points[0, 1]
        self._heading = np.asarray(line.heading, float)
        self._kappa = np.asarray(line.kappa, float)
        limits = np.broadcast_to(speed_limit, arc.shape)
        last = np.searchsorted(arc, self.stations, "right") - 1
        self.limits = limits[np.clip(last, 0, None)]
        self.centre_line = CentreLine(  # as the planner gets it
            points=np.stack([self._x, self._y], axis=1),
            speed_limit=self.limits,
            lane_width=lane_width,
            road_left=left,
            road_right=right,
        )

    def place(
        self, s: float, offset: float = 0.0, gone: float = 0.0
    ) -> tuple[float, float, float, float]:
        """Return (x, y) m, heading rad and curvature 1/m of a car at a station.

        An offset fades to offset exp(-gone / FADING_M): planned anew on the way, it
        goes on as before.

        Args:
          s: m, station.
          offset: m to the left of the line at first.
          gone: m that the car has driven since then.
        """
        x, y, heading, kappa = (
            float(np.interp(s, self.stations, table))
            for table in (self._x, self._y, self._heading, self._kappa)
        )
        left = offset * math.exp(-gone / FADING_M)
        return (
            x - left * math.sin(heading),
            y + left * math.cos(heading),
            heading + math.atan(-left / FADING_M),
            kappa,
        )

    def beside(
        self, s: float, planned: tuple[float, float, float] | None
    ) -> tuple[float, float, float, float]:
        """Return (x, y) m, heading rad and curvature 1/m of a car beside the line.

        Args:
          s: m, station.
          planned: `Move.beside`; None: on the line.
        """
        x, y, heading, kappa = self.place(s)
        if planned is None:
            return x, y, heading, kappa
        l, dl, ddl = planned
        shrink = max(1.0 - kappa * l, 0.1)
        return (
            x - l * math.sin(heading),
            y + l * math.cos(heading),
            heading + math.atan(dl / shrink),
            float(path_curvature(np.float64(kappa), np.zeros(()), l, dl, ddl)),
        )

    def project(self, x: float, y: float) -> tuple[float, float]:
        """Return the station m of a place and how far m it lies left of the line."""
        n = int(np.argmin((self._x - x) ** 2 + (self._y - y) ** 2))
        h = self._heading[n]
        dx, dy = x - self._x[n], y - self._y[n]
        s = float(self.stations[n] + dx * np.cos(h) + dy * np.sin(h))
        at, left, heading, _ = self.place(s)
        return s, (y - left) * math.cos(heading) - (x - at) * math.sin(heading)

    def limit(self, s: float) -> float:
        """Return the posted limit m/s at a station."""
        n = int(s / STATION_STEP_M)
        return float(self.limits[min(max(n, 0), len(self.limits) - 1)])


# name: (module, class, extra of pyproject.toml that it needs)
SIMULATORS = {
    "highway_env": ("rcirl_jax.simulators.highway", "HighwayEnv", "highway"),
    "sumo": ("rcirl_jax.simulators.sumo", "Sumo", "sumo"),
    "commonroad": ("rcirl_jax.simulators.commonroad", "CommonRoad", ""),
}


def open_simulator(name: str, **options: str) -> Simulator:
    """Return the simulator of a name; its package is imported here and not before.

    Args:
      name: of `SIMULATORS`.
      **options: of its class.

    Raises:
      InputError: no such name or option, or its package is not installed.
    """
    if name not in SIMULATORS:
        raise InputError(
            f"simulator: {name}: expected one of {', '.join(SIMULATORS)}"
            f"{did_you_mean(name, list(SIMULATORS))}"
        )
    module, kind, extra = SIMULATORS[name]
    try:
        simulator: Any = getattr(importlib.import_module(module), kind)
    except ModuleNotFoundError as error:
        if str(error.name).startswith("rcirl_jax"):
            raise
        raise InputError(
            f"simulator: {name}: {error.name} is not installed: "
            f"pip install 'rcirl-jax[{extra}]'"
        ) from None
    try:
        inspect.signature(simulator).bind(**options)
    except TypeError as error:
        known = ", ".join(inspect.signature(simulator).parameters) or "none"
        raise InputError(f"options: {error}: expected NAME=VALUE of {known}") from None
    return simulator(**options)
