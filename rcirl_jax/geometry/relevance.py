"""Relevance of road users, by which they get slots of a scene.

One rule for the planner's observer (`jax.numpy`) and for scenes cut from logs
(`numpy`), so that a learner sees the road users that it will see while driving.
"""

from types import ModuleType
from typing import Any

import numpy as np

from rcirl_jax.units import STATION_STEP_M, TIMES_S

# 1, how much farther a metre aside counts than one along the path. In dense traffic
# (US-101, 16 road users in view, 8 slots) a weight of 4 loses the lead vehicle in
# 10 % of the scenes, one of 16 in 0.2 %, more than that loses who is passed closely.
ASIDE_WEIGHT = 16.0
BEHIND_WEIGHT = 2.0  # 1, how much farther a metre behind counts than one ahead


def relevance_distance(
    s: Any,  # noqa: ANN401
    l: Any,  # noqa: ANN401
    seen: Any,  # noqa: ANN401
    half: Any,  # noqa: ANN401
    speed: Any,  # noqa: ANN401
    path_l: Any,  # noqa: ANN401
    xp: ModuleType = np,
) -> Any:  # noqa: ANN401
    """Return the relevance [n] of each body as a distance in m; inf: never seen.

        d = min over t of along(t) + ASIDE_WEIGHT aside(t)

    along: metres ahead of the human that drives on at its speed, those behind count
    BEHIND_WEIGHT times; aside: metres between the bodies' side and the human's own
    path, zero in it. Bodies in the path thus come before those beside it, and
    approaching ones before departing ones.

    Args:
      s: [n, T] m, stations of the centres; a log knows the recorded ones, a planner
        those at the present speed.
      l: [n, T] m, offsets of the centres; a planner knows `lateral_motion`'s.
      seen: [n, T] bool.
      half: [n] m, half widths of the body and the human together.
      speed: [] m/s, of the human at the frame.
      path_l: [P] m, offset of the human's own path on the station grid.
      xp: `numpy` or `jax.numpy`, which the arrays are of.
    """
    apart = s - speed * TIMES_S
    along = xp.where(apart < 0.0, -BEHIND_WEIGHT * apart, apart)
    # the grid is uniform: its place is a division, where `interp` would search
    place = xp.clip(s / STATION_STEP_M, 0.0, path_l.shape[0] - 1.0)
    low = xp.minimum(place.astype(int), path_l.shape[0] - 2)
    start, end = xp.moveaxis(path_l[low[..., None] + np.arange(2)], -1, 0)
    own = start + (place - low) * (end - start)
    aside = xp.maximum(xp.abs(l - own) - half[:, None], 0.0)
    return xp.min(xp.where(seen, along + ASIDE_WEIGHT * aside, xp.inf), axis=1)
