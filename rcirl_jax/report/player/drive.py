"""One simulated drive as arrays: its worst moment, its road, when a plan was made.

Step k of a record is the moment (k + 1) * 0.1 s.
"""

import numpy as np

from rcirl_jax.simulation.cases import ROAD_STEP_M, STEP_S, Record, Snapshot


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
