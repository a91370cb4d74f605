"""Which of those in view get a slot of the scene: the most relevant first."""

import numpy as np

from rcirl_jax.data.scenes.motion import GRID_M
from rcirl_jax.units import TIMES_S

ASIDE_WEIGHT = 4.0  # 1, how much farther a metre aside counts than one along the path
BEHIND_WEIGHT = 2.0  # 1, how much farther a metre behind counts than one ahead


def distances(
    s: np.ndarray,
    l: np.ndarray,
    seen: np.ndarray,
    half: np.ndarray,
    speed: float,
    path_l: np.ndarray,
) -> np.ndarray:
    """[n] relevance of each body as a distance, the least of all times; inf: unseen.

        d(t) = along(t) + ASIDE_WEIGHT aside(t)

    along: metres ahead of the human that drives on at its speed, those behind count
    BEHIND_WEIGHT times; aside: metres between the bodies' side and the human's own
    path, zero in it. Bodies in the path thus come before those beside it, and
    approaching ones before departing ones.

    Args:
      s: [n, T] m, stations of the centres.
      l: [n, T] m, offsets of the centres.
      seen: [n, T] bool.
      half: [n] m, half widths of the body and the human together.
      speed: m/s, of the human at the frame.
      path_l: [P] m, offset of the human's own path at the stations of the grid.
    """
    apart = s - speed * TIMES_S
    along = np.where(apart < 0.0, -BEHIND_WEIGHT * apart, apart)
    aside = np.maximum(np.abs(l - np.interp(s, GRID_M, path_l)) - half[:, None], 0.0)
    return np.min(np.where(seen, along + ASIDE_WEIGHT * aside, np.inf), axis=1)
