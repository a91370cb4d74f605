"""A hand-made log, and the scenes that are stored of it."""

import jax
import numpy as np

from rcirl_jax.data.scenes.collect import Collector, assemble
from rcirl_jax.data.scenes.config import CollectConfig
from tests.helpers.roads import car, lane, recording, speeding_up

CUT = CollectConfig(
    smoothing_s=0.0, require_speed_change=False, require_obstacles=False
)


def straight(tracks):
    """Cars on a straight road of two lanes along x; lane "a" at y = 0."""
    x = np.arange(0.0, 601.0, 5.0)
    lanes = lane("a", x, 0.0, 20.0, left="b"), lane("b", x, 3.5, 20.0, right="a")
    return recording(*tracks, lanes=lanes)


def tracks():
    """An ego at 12 m/s behind a leader that brakes, a car beside, one behind."""
    return (
        car("ego", speeding_up(60.0, 12.0, -0.2), seconds=20.0),
        car("leader", speeding_up(100.0, 12.0, -0.3), seconds=20.0),
        car("beside", speeding_up(70.0, 13.0, 0.0), 3.5, seconds=20.0),
        car("behind", speeding_up(30.0, 11.0, 0.0), seconds=20.0),
    )


def stored(count=6):
    """Demonstrations [n] of the log."""
    rows = [r for r in Collector(straight(tracks()), CUT).scenes()]
    rows = [row for row in rows if row["track"] in (0, 3)][:count]
    numbers = [row["track"] for row in rows]
    return assemble(rows, vehicles=numbers, groups=numbers, recording=0)


class Rows:
    """As much of a dataset as held-out drives ask for."""

    def __init__(self, rows):
        self.rows = rows

    def indices(self, split):
        return np.arange(self.rows.vehicle.size if split == "test" else 0)

    def column(self, name):
        return np.asarray(getattr(self.rows, name))

    def read(self, index):
        return jax.tree.map(lambda x: np.asarray(x)[index], self.rows)
