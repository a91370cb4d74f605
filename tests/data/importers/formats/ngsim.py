"""NGSIM's native 18-column text, in feet, front bumpers, y to the right."""

import numpy as np

from tests.data.importers import writers as w
from tests.data.importers.formats import Fixture, cell
from tests.data.importers.formats.drives import straight


def write(folder):
    """Two lanes; the second car is seen later and for a shorter time."""
    rows = w.ngsim_rows(vehicle=1, lane=2, local_x=18.0, count=120)
    rows += w.ngsim_rows(vehicle=2, lane=1, local_x=6.0, first=130, count=70)
    rows += w.ngsim_rows(vehicle=3, lane=2, local_x=18.0, count=120, start_ft=150.0)
    path = w.ngsim_text(folder / "trajectories-0400-0415.txt", rows)
    length, width = 15.0 * w.FOOT, 6.0 * w.FOOT

    def car(first, count, across, start=20.0):
        t = np.arange(count) * 0.1
        begin = (start * w.FOOT - 0.5 * length, -across * w.FOOT)
        user = straight(t, begin, 0.0, w.SPEED, size=(length, width))
        return type(user)(**{**vars(user), "t": t + 0.1 * first})

    return Fixture(
        input=folder,
        assumed=(0, 2, 0),  # the limit of the two sites is known
        rate_hz=10.0,
        tracks={
            "1": car(0, 120, 18.0),
            "2": car(30, 70, 6.0),
            "3": car(0, 120, 18.0, 150.0),
        },
        num_lanes=2,
        has_heading=False,
        files=(path,),
        drops_rows=True,
        numbers={path: cell(w.NGSIM_COLUMNS.index("Local_Y"), " ")},
    )
