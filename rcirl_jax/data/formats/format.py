"""Declarations of the log formats; loads no reader."""

import dataclasses
from collections.abc import Mapping
from typing import Any


@dataclasses.dataclass(frozen=True, kw_only=True)
class Format:
    """A log format."""

    module: str = ""  # where it is not called as the format is
    # how its files or folders are called
    names: tuple[str, ...] = ()
    # sets of columns, in small letters, of which each tells its tables
    columns: tuple[frozenset[str], ...] = ()
    # whether its module has `is_log(file, table)`, which tells other tables; the table
    # is None where the file is none that can be opened
    has_is_log: bool = False
    # whether one part (see `importers.parts`) is a file with a few recordings, which a
    # worker reads as a whole
    is_small: bool = False
    # bytes of the longest part, of many recordings, whose scenes may be held at once
    # (docs/formats, "Large inputs"); 0: parts are read by the first process
    shard_bytes: int = 0
    # whether a part is a file that is read in pieces where it is long
    is_cut: bool = False
    # options besides those of its packaged TOML, each with a value of its type; an
    # option that is a table has a value for each of its own
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    # tables in which any name may stand, or whose reader knows which may
    free: tuple[str, ...] = ()
    # options of several types, which the reader checks
    checked: tuple[str, ...] = ("pattern",)


def _of_columns(*tables: str) -> tuple[frozenset[str], ...]:
    """`Format.columns` of names with blanks between them."""
    return tuple(frozenset(names.split()) for names in tables)


LONG = {"long_bytes": 0, "table": {}}
FORMATS = {
    "apollo": Format(
        names=("*.record", "*.record.*"),
        shard_bytes=2**28,
        checked=("pattern", "topics"),
    ),
    "argoverse2": Format(
        names=("scenario_*.parquet",), is_small=True, free=("kinds", "sizes")
    ),
    "commonroad": Format(names=("*.xml",), is_small=True),
    "csv": Format(
        module="csv.reader",
        is_cut=True,
        options={
            **{"reference_point": "centre", "heading_convention": "ccw_from_x"},
            **{"automated_values": ["yes"], "scale": {}, "offset": {}, **LONG},
            "kinds": {"car": "vehicle"},
            "lanes": [
                {
                    **{"id": "1", "points": [[0.0, 0.0]], "width": 3.5},
                    **{"speed_limit": 9.0, "left": "2", "right": "3"},
                    "successors": ["4"],
                },
                {"file": "lanes.csv"},
            ],
            "missing": [
                {"time": [0.0, 8.0], "x": [0.0, 9.0], "y": [0.0, 0.0], "recording": "d"}
            ],
            "defaults": {
                **{"rate_hz": 10.0, "length": 4.5, "width": 1.8, "kind": "vehicle"},
            },
        },
        free=("columns", "units", "scale", "offset", "kinds", "table"),
        checked=("pattern", "lanes", "missing"),
    ),
    "interaction": Format(
        columns=_of_columns("track_id timestamp_ms agent_type"),
        is_small=True,
        options={"map": "maps", "table": {}},
        free=("table",),
    ),
    "l5": Format(names=("*.zarr",)),
    "levelx": Format(
        columns=_of_columns("frame id xvelocity", "frame trackid xcenter"),
        is_small=True,
        options={"map": "maps", "partial": True, "table": {}},
        free=("sizes", "table"),
    ),
    "ngsim": Format(
        columns=_of_columns("vehicle_id frame_id local_y v_vel lane_id"),
        has_is_log=True,
        is_cut=True,
        options=LONG,
        free=("sizes", "table"),
    ),
    "ngsim_pairs": Format(
        columns=_of_columns("x_follower x_leader leader_length"),
        is_small=True,
        options={"table": {}},
        free=("table",),
    ),
    "nuplan": Format(names=("*.db",), shard_bytes=2**28),
    "openacc": Format(has_is_log=True, is_small=True, free=("sizes",)),
    "ros2": Format(
        module="ros2.reader",
        names=("*.mcap", "*.db3"),
        shard_bytes=2**28,
        options={"lanes": {"file": "lanes.csv"}},
        free=("lights", "kinds"),
        checked=("pattern", "topics", "lanes"),
    ),
    "synthetic": Format(module="synthetic.reader", names=("*.toml",)),
    "waymo": Format(names=("*.tfrecord*",), shard_bytes=2**30, free=("kinds",)),
}
