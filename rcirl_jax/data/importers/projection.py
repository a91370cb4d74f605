"""Latitude and longitude to metres: UTM on the WGS84 ellipsoid.

Krueger's series in the third flattening n, to its fourth power; the error
stays below a micrometre within a zone. Formulas as in Karney (2011),
"Transverse Mercator with an accuracy of a few nanometers", section 3.
"""

import numpy as np

SEMI_MAJOR_M = 6378137.0  # m, WGS84
FLATTENING = 1.0 / 298.257223563  # 1, WGS84
SCALE = 0.9996  # 1, on the central meridian of a UTM zone
FALSE_EASTING_M = 500000.0  # m
FALSE_NORTHING_M = 10000000.0  # m, southern hemisphere
MAX_ACROSS = 0.9  # 1, keeps what lies on the other side of the globe finite

_N = FLATTENING / (2.0 - FLATTENING)
_RADIUS_M = SEMI_MAJOR_M / (1.0 + _N) * (1.0 + _N**2 / 4.0 + _N**4 / 64.0)
_ALPHA = (
    _N / 2.0 - 2.0 * _N**2 / 3.0 + 5.0 * _N**3 / 16.0 + 41.0 * _N**4 / 180.0,
    13.0 * _N**2 / 48.0 - 3.0 * _N**3 / 5.0 + 557.0 * _N**4 / 1440.0,
    61.0 * _N**3 / 240.0 - 103.0 * _N**4 / 140.0,
    49561.0 * _N**4 / 161280.0,
)


def utm_zone(longitude: float) -> int:
    """UTM zone, 1 to 60, of a longitude in degrees (Norway's exceptions left out)."""
    return int(np.floor((longitude + 180.0) / 6.0)) % 60 + 1


def utm(
    latitude: np.ndarray, longitude: np.ndarray, zone: int, *, south: bool = False
) -> np.ndarray:
    """Easting and northing [n, 2] m of positions in degrees.

    E = E_0 + k_0 A (eta' + sum_j alpha_j cos(2 j xi') sinh(2 j eta')),
    N = N_0 + k_0 A (xi' + sum_j alpha_j sin(2 j xi') cosh(2 j eta')).

    Args:
      latitude: [n] degrees north.
      longitude: [n] degrees east.
      zone: UTM zone whose central meridian is used, also beyond its borders.
      south: add the false northing of the southern hemisphere.
    """
    sine = np.sin(np.deg2rad(np.asarray(latitude, np.float64)))
    turn = np.deg2rad(np.asarray(longitude, np.float64) - (6.0 * zone - 183.0))
    e = 2.0 * np.sqrt(_N) / (1.0 + _N)
    t = np.sinh(np.arctanh(sine) - e * np.arctanh(e * sine))
    across = np.clip(np.sin(turn) / np.hypot(1.0, t), -MAX_ACROSS, MAX_ACROSS)
    xi, eta = np.arctan2(t, np.cos(turn)), np.arctanh(across)
    orders = 2.0 * np.arange(1, len(_ALPHA) + 1)[:, None]
    alpha = np.array(_ALPHA)[:, None]
    east = eta + np.sum(alpha * np.cos(orders * xi) * np.sinh(orders * eta), axis=0)
    north = xi + np.sum(alpha * np.sin(orders * xi) * np.cosh(orders * eta), axis=0)
    offset = FALSE_NORTHING_M if south else 0.0
    return np.stack(
        [
            FALSE_EASTING_M + SCALE * _RADIUS_M * east,
            offset + SCALE * _RADIUS_M * north,
        ],
        axis=1,
    )
