"""The generic CSV with the packaged mapping: SI units, named columns."""

import numpy as np

from rcirl_jax.types import Kind
from tests.data.importers import writers as w
from tests.data.importers.formats import Fixture, cell
from tests.data.importers.formats.drives import arc, samples, straight

COLUMNS = (
    *("t", "id", "x", "y", "heading", "speed", "length", "width", "kind", "lane"),
)
T = np.round(np.arange(150) * 0.1, 3)


def road_users():
    """Id -> (road user, its samples, lane)."""
    walk = {"kind": Kind.PEDESTRIAN, "size": (0.6, 0.6)}
    return {
        "car0": (straight(T, (0.0, 0.0), 0.0, 12.0), np.arange(150), "a"),
        "car1": (straight(T, (40.0, -3.5), 0.0, 10.0), np.arange(30, 120), "b"),
        "car2": (arc(T, (20.0, 0.0), 0.0, 9.0, 900.0), np.arange(150), "a"),
        "person": (straight(T, (90.0, 0.0), 0.0, 1.2, **walk), np.arange(150), "a"),
    }


def write(folder):
    """log.csv."""
    rows = []
    for name, (user, steps, lane) in road_users().items():
        part = samples(user, steps)
        for k in range(part.t.size):
            state = [part.x[k], part.y[k], part.heading[k], part.speed[k]]
            box = [user.length, user.width, user.kind.name.lower(), lane]
            rows.append([part.t[k], name, *(f"{v:.4f}" for v in state), *box])
    path = w.table(folder / "log.csv", COLUMNS, rows)
    return Fixture(
        input=folder,
        assumed=(2, 2, 0),  # straight lanes, bounded by each other on one side only
        rate_hz=10.0,
        tracks={
            name: samples(u, steps) for name, (u, steps, _) in road_users().items()
        },
        num_lanes=2,
        files=(path,),
        drops_rows=True,
        numbers={path: cell(COLUMNS.index("x"))},
    )
