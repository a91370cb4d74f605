"""Every physical constant of the package, and the codes of its arrays.

A constant has its name, value, unit and source.

Inside the package everything is SI and radians. Constants that belong to one
algorithm's configuration live in that algorithm's config dataclass instead.
"""

import enum

import numpy as np

# --- time axis (the paper, section IV-A: t_0 .. t_17 over 8 s) ---
NUM_TIMES = 18  # T, points on the time axis
HORIZON_S = 8.0  # s, planning horizon
DT_S = HORIZON_S / (NUM_TIMES - 1)  # s, 0.470588; never accumulated
TIMES_S = np.linspace(0.0, HORIZON_S, NUM_TIMES).astype(np.float32)  # [T] s

# --- scene array sizes (static shapes) ---
NUM_OBSTACLES = 16  # N, obstacle slots of a scene
NUM_STATIONS = 128  # P, points of the station grid along the reference line
STATION_STEP_M = 2.0  # m between points of the station grid

# --- scenes ---
LINE_HALF_WIDTH_M = 20.0  # m aside of the reference line; a stop line spans the road

# --- conversions at the borders ---
FOOT_M = 0.3048  # m, international foot
MPH_MPS = 0.44704  # m/s per mile per hour

# --- physics and vehicles ---
EGO_LENGTH_M = 4.933  # m, Lincoln MKZ (Apollo vehicle_param)
EGO_WIDTH_M = 2.11  # m, Lincoln MKZ with mirrors (Apollo vehicle_param)


class Kind(enum.IntEnum):
    """The kinds of obstacles, as stored in `Obstacles.kind`."""

    NONE = 0  # an empty slot
    VEHICLE = 1
    CYCLIST = 2
    PEDESTRIAN = 3
    STATIC = 4  # a standing object that never moves
    STOP = 5  # a stop line or a red light; valid only while it demands a stop
    VIRTUAL = 6  # the destination of the route
