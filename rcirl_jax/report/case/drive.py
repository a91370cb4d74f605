"""One simulated drive as arrays: its worst moment, its road in the plane, its agents.

Step k of a record is the moment (k + 1) * 0.1 s.
"""

import dataclasses
from pathlib import Path

import jax
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.simulation.cases import (
    ROAD_STEP_M,
    STEP_S,
    Case,
    Record,
    Snapshot,
)
from rcirl_jax.types import Kind

VIEW_BEHIND_M, VIEW_AHEAD_M = 30.0, 70.0  # m of road in a strip


@dataclasses.dataclass(frozen=True, kw_only=True)
class CaseDrive:
    """One drive as numpy arrays, with its road in x and y."""

    case: Case
    record: Record
    shot: Snapshot
    last: int  # last valid step
    worst: int  # step of the worst moment
    heading: np.ndarray  # [R] rad, of the reference line
    x: np.ndarray  # [R] m
    y: np.ndarray  # [R] m

    def time(self, step: int) -> float:
        """Seconds into the drive at a step."""
        return (step + 1) * STEP_S

    def place(
        self, s: np.ndarray, l: np.ndarray, station: float
    ) -> tuple[np.ndarray, ...]:
        """(x, y, line heading) of Frenet points, seen from the line at `station`."""
        x, y, heading = self._world(s, l)
        x0, y0, heading0 = self._world(np.array(station), np.array(0.0))
        cosine, sine = np.cos(heading0), np.sin(heading0)
        dx, dy = x - x0, y - y0
        return dx * cosine + dy * sine, dy * cosine - dx * sine, heading - heading0

    def _world(self, s: np.ndarray, l: np.ndarray) -> tuple[np.ndarray, ...]:
        grid = np.arange(self.x.size) * ROAD_STEP_M
        at = np.clip(s, 0.0, grid[-1])
        x, y, heading = (np.interp(at, grid, v) for v in (self.x, self.y, self.heading))
        beyond = s - at  # straight beyond both ends
        x = x + beyond * np.cos(heading) - l * np.sin(heading)
        return x, y + beyond * np.sin(heading) + l * np.cos(heading), heading


def worst_step(record: Record) -> int:
    """The step to look at: an at-fault crash, a crash, the smallest clearance.

    Without anybody near it is the hardest braking.
    """
    valid = np.asarray(record.valid, bool)
    for hits in (record.at_fault, record.collision):
        found = np.flatnonzero(valid & (np.asarray(hits) > 0))
        if found.size:
            return int(found[0])
    clearance = np.where(valid, np.asarray(record.clearance), np.inf)
    if np.isfinite(clearance).any():
        return int(np.argmin(clearance))
    return int(np.argmin(np.where(valid, np.asarray(record.a), np.inf)))


def road_in_plane(kappa: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(x, y, heading) [R] of the reference line from its curvature [R] 1/m.

    heading' = kappa, x' = cos(heading), y' = sin(heading); trapezoids on the
    ROAD_STEP_M grid, chords at the mean heading.
    """
    kappa = np.asarray(kappa, np.float64)
    turn = 0.5 * (kappa[1:] + kappa[:-1]) * ROAD_STEP_M
    heading = np.append(0.0, np.cumsum(turn))
    chord = ROAD_STEP_M * np.sinc(0.5 * turn / np.pi)
    middle = heading[:-1] + 0.5 * turn
    x = np.append(0.0, np.cumsum(chord * np.cos(middle)))
    return x, np.append(0.0, np.cumsum(chord * np.sin(middle))), heading


def on_host(path: Path, case: Case, record: Record, snapshot: Snapshot) -> CaseDrive:
    """One drive's arrays fetched from the device; `path` names it in errors.

    Raises:
      InputError: the record holds no valid step, or several drives.
    """
    case, record, snapshot = jax.tree.map(np.asarray, (case, record, snapshot))
    if np.ndim(record.valid) != 1 or not np.any(record.valid):
        raise InputError(
            f"{path}: record.valid: shape {np.shape(record.valid)}, "
            f"{int(np.sum(record.valid))} valid steps: expected one drive's [S], >= 1"
        )
    x, y, heading = road_in_plane(np.asarray(case.road.kappa))
    return CaseDrive(
        case=case,
        record=record,
        shot=snapshot,
        last=int(np.flatnonzero(record.valid)[-1]),
        worst=worst_step(record),
        heading=heading,
        x=x,
        y=y,
    )


def window(drive: CaseDrive, before_s: float, after_s: float) -> tuple[int, int]:
    """First and last step of a window around the moment, moved into the drive."""
    size = int(round((before_s + after_s) / STEP_S))
    first = drive.worst - int(round(before_s / STEP_S))
    first = min(max(first, 0), max(drive.last - size, 0))
    return first, min(first + size, drive.last)


def present_at(drive: CaseDrive, step: int) -> np.ndarray:
    """[A] agents to draw; whom the ego hits in this step has left the world."""
    agents = drive.shot.agents
    present = np.asarray(agents.present[step], bool)
    if drive.record.collision[step] > 0:
        before = np.asarray(agents.gone[max(step - 1, 0)], bool)
        fresh = np.asarray(agents.gone[step], bool) & ~(before & (step > 0))
        near = np.abs(agents.s[step] - drive.record.s[step]) < VIEW_BEHIND_M
        present = present | (fresh & near)
    return present & (np.asarray(drive.case.agents.kind) != Kind.NONE)


def plan_start(record: Record, snapshot: Snapshot, step: int) -> float:
    """Time [s] at which the plan in force at a step was made.

    A held plan repeats; it begins where the ego was when it was made.
    """
    plans, s = np.asarray(snapshot.plan_s), np.append(0.0, np.asarray(record.s))
    k = step
    while k > 0 and abs(s[k] - plans[step, 0]) > 1e-3:
        if not np.array_equal(plans[k - 1], plans[step]):
            break
        k -= 1
    return k * STEP_S
