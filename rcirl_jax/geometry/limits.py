"""The speed limit that a planner may plan with: posted, curves, and braking for both.

One rule for the simulator's observer (`jax.numpy`) and for scenes cut from logs
(`numpy`), so that a learner sees the limits that it will drive under.
"""

from types import ModuleType
from typing import Any

import numpy as np

COMFORT_BRAKING_MPS2 = 1.0  # m/s^2, with which a lower limit is approached
CENTRIPETAL_MPS2 = 2.0  # m/s^2, Apollo's bound for speed limits in curves
STRAIGHT_PER_M = 1e-5  # 1/m, curvature below which a road counts as straight
LOOK_AHEAD_M = 400.0  # m beyond a scene that its limits look: from 28 m/s to rest


def planning_limit(
    kappa: Any,  # noqa: ANN401
    path_l: Any,  # noqa: ANN401
    posted: Any,  # noqa: ANN401
    step: float,
    xp: ModuleType = np,
) -> Any:  # noqa: ANN401
    """Speed limit [R] m/s as the planner gets it, looking ahead.

        limit(s) = min(posted, sqrt(2 / |kappa + d2l/ds2|))     (Apollo, 2 m/s^2)
        v(s) = min over s' >= s of sqrt(limit(s')^2 + 2 b (s' - s)),  b = 1 m/s^2

    One reverse running minimum of limit^2 + 2 b s. A lower limit counts from
    one grid point before it: between points the planner interpolates.

    Args:
      kappa: [R] 1/m, curvature of the reference line on a uniform station grid.
      path_l: [R] m, lateral offset of the given path.
      posted: [R] m/s.
      step: m between grid points.
      xp: `numpy` or `jax.numpy`, which the arrays are of.
    """
    bend = xp.gradient(xp.gradient(path_l, step), step)
    sharp = xp.maximum(xp.abs(kappa + bend), STRAIGHT_PER_M)
    limit = xp.minimum(posted, xp.sqrt(CENTRIPETAL_MPS2 / sharp))
    limit = xp.minimum(limit, xp.concatenate([limit[1:], limit[-1:]]))
    ramp = 2.0 * COMFORT_BRAKING_MPS2 * step * xp.arange(limit.shape[0])
    lowest = _remaining_min(limit**2 + ramp, xp)
    return xp.sqrt(xp.maximum(lowest - ramp, 0.0))


def _remaining_min(x: Any, xp: ModuleType) -> Any:  # noqa: ANN401
    """Min over j >= i of x_j [R]."""
    if xp is np:
        return np.minimum.accumulate(x[::-1])[::-1]
    from jax import lax  # numpy alone is enough for numpy's arrays

    return lax.cummin(x, axis=0, reverse=True)
