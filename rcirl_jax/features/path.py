"""The scene's path at given stations, by few gathers.

A table lookup costs a gather of two neighbours, and a CPU pays for every number that
it gathers. What is read together stands in one of four tables; XLA drops a table that
nobody reads.
"""

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rcirl_jax.geometry.frenet import entry, path_curvature
from rcirl_jax.types import Scene, Trajectory
from rcirl_jax.units import STATION_STEP_M

SLOPE_POINTS = 3  # grid points on each side for dl/ds: 6 m, about a car's length


class PathView(flax.struct.PyTreeNode, kw_only=True):
    """The path at the stations of one trajectory; all [T]."""

    l: jax.Array  # m, lateral offset of the given path
    dl: jax.Array  # 1, its slope by station
    ddl: jax.Array  # 1/m, its second derivative
    kappa: jax.Array  # 1/m, curvature of the reference line
    dkappa: jax.Array  # 1/m^2, its slope
    speed_limit: jax.Array  # m/s
    road_left: jax.Array  # m, lateral offset of the drivable area's left edge
    road_right: jax.Array  # m, of its right edge

    def curvature(self, trajectory: Trajectory) -> jax.Array:
        """Curvature 1/m of the path that the trajectory drives; any equal shape."""
        at = path_curvature
        for _ in range(self.kappa.ndim):
            at = jax.vmap(at)
        return at(self.kappa, self.dkappa, trajectory.l, trajectory.dl, trajectory.ddl)


def table_slope(table: Float[Array, " p"], points: int) -> Float[Array, " p"]:
    """Central difference over `points` grid points on each side, by station."""
    first, last = (jnp.broadcast_to(table[i], (points,)) for i in (0, -1))
    padded = jnp.concatenate([first, table, last])
    return (padded[2 * points :] - padded[: -2 * points]) / (
        2.0 * points * STATION_STEP_M
    )


def path_view(scene: Scene, s: Float[Array, " t"]) -> PathView:
    """The path at stations s [T] m; linear between grid points, held at the ends."""
    path = scene.path
    dl = table_slope(path.l, SLOPE_POINTS)
    position = jnp.clip(s / STATION_STEP_M, 0.0, path.l.shape[0] - 1.0)
    low = jnp.minimum(position.astype(jnp.int32), path.l.shape[0] - 2)
    share = position - low
    entries = jax.vmap(entry, in_axes=(0, None))

    def at(*columns: jax.Array) -> jax.Array:
        table = jnp.stack(columns)
        rise = jnp.pad(table[:, 1:] - table[:, :-1], ((0, 0), (0, 1)))
        start, slope = jnp.split(entries(jnp.concatenate([table, rise]), low), 2)
        return start + share * slope

    l, dl_at, ddl = at(path.l, dl, table_slope(dl, SLOPE_POINTS))
    kappa, dkappa = at(path.kappa, table_slope(path.kappa, 1))
    (limit,) = at(path.speed_limit)
    road_left, road_right = at(path.road_left, path.road_right)
    return PathView(
        l=l,
        dl=dl_at,
        ddl=ddl,
        kappa=kappa,
        dkappa=dkappa,
        speed_limit=limit,
        road_left=road_left,
        road_right=road_right,
    )
