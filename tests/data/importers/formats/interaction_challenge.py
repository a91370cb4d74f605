"""INTERACTION challenge of 2021: cases of 4 s in one CSV per place."""

import numpy as np

from tests.data.importers.formats import Fixture, cell, osm
from tests.data.importers.formats.drives import samples
from tests.data.importers.formats.interaction import (
    SHIFT,
    VEHICLE_COLUMNS,
    road_users,
    row,
)

FORMAT = "interaction"
PLACE = "DR_CHN_Merging_ZS0"
CASE_STEPS = 40


def write(folder):
    """train/PLACE_train.csv with two cases; pedestrians have empty cells."""
    lines = [",".join(["case_id", *VEHICLE_COLUMNS])]
    tracks = {}
    # the second case holds other road users, at other steps
    for case, begin, names in ((1.0, 0, ("1", "P4")), (2.0, 50, ("2", "3", "P13"))):
        for name in names:
            kind, user, steps = road_users()[name]
            inside = steps[(steps >= begin) & (steps < begin + CASE_STEPS)]
            part = samples(user, inside)
            for k, step in enumerate(inside):
                cells = row(name, kind, part, k, step - begin)
                box = [f"{part.heading[k]:.3f}", part.length, part.width]
                box = box if kind == "car" else ["", "", ""]
                lines.append(",".join(str(c) for c in [case, *cells, *box]))
            series = {"t": part.t - begin / 10.0}
            tracks[name] = type(part)(**{**vars(part), **series})
    log = folder / "train" / f"{PLACE}_train.csv"
    log.parent.mkdir(parents=True)
    log.write_text("\n".join(lines) + "\n")
    place = osm.lanelet_map(folder / "maps" / f"{PLACE}.osm_xy", osm.in_metres, SHIFT)
    assert np.isfinite([t.x[0] for t in tracks.values()]).all()
    return Fixture(
        input=folder / "train",
        assumed=(4, 0, 2),  # a pedestrian in each case
        rate_hz=10.0,
        tracks=tracks,
        num_lanes=osm.NUM_LANES,
        files=(log, place),
        drops_rows=True,
        numbers={
            log: cell(1 + VEHICLE_COLUMNS.index("x")),
            place: " x='([^']*)'",
        },
    )
