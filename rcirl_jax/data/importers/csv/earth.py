"""Latitude and longitude to metres, about a place near by."""

import numpy as np

from rcirl_jax.errors import extra_module


def projected(
    longitude: np.ndarray, latitude: np.ndarray, middle: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """East and north [n] m of a middle (latitude, longitude), all in degrees.

    A transverse Mercator projection on the WGS84 ellipsoid of true scale through the
    middle: north is up there, so that compass headings are those of the positions.
    """
    pyproj = extra_module("pyproj")
    latitude_0, longitude_0 = middle
    place = pyproj.Proj(
        proj="tmerc", ellps="WGS84", lat_0=latitude_0, lon_0=longitude_0, k=1.0
    )
    return place(longitude, latitude)
