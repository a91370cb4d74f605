"""A hand-made log, and the scenes that are stored of it."""

import jax
import numpy as np

from rcirl_jax.data.scenes.collect import Collector, assemble
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.types import Kind, Lane, Recording, Track

CUT = CollectConfig(
    smoothing_s=0.0, require_speed_change=False, require_obstacles=False
)


def lane(name, y=0.0, **more):
    """A lane of 3.5 m along x."""
    x = np.arange(0.0, 601.0, 5.0)
    side = np.full(x.size, 1.75)
    return Lane(
        id=name, centre=np.stack([x, np.full(x.size, y)], axis=1), left_width=side,
        right_width=side, speed_limit=20.0, **more,
    )  # fmt: skip


def straight(tracks):
    """Cars on a straight road of two lanes along x; lane "a" at y = 0."""
    lanes = (lane("a", left="b"), lane("b", 3.5, right="a"))
    return Recording(
        name="hand", source="test", licence="none", rate_hz=10.0, tracks=tuple(tracks),
        lanes=lanes,
    )  # fmt: skip


def tracks():
    """An ego at 12 m/s behind a leader that brakes, a car beside, one behind."""
    t = np.arange(0.0, 20.01, 0.1)

    def track(name, s0, v0, a, y):
        moving = np.minimum(t, -v0 / a) if a < 0 else t
        x = s0 + v0 * moving + 0.5 * a * moving**2
        return Track(
            id=name, kind=Kind.VEHICLE, length=4.6, width=1.9, t=t, x=x,
            y=np.full_like(t, y), heading=0.0 * t, speed=np.maximum(v0 + a * t, 0.0),
        )  # fmt: skip

    return (
        track("ego", 60.0, 12.0, -0.2, 0.0),
        track("leader", 100.0, 12.0, -0.3, 0.0),
        track("beside", 70.0, 13.0, 0.0, 3.5),
        track("behind", 30.0, 11.0, 0.0, 0.0),
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
