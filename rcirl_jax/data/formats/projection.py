"""Latitude and longitude to metres, by PROJ (pyproj) on the WGS84 ellipsoid."""

import numpy as np

from rcirl_jax.errors import extra_module

FARTHEST_M = 2e7  # m, half a circumference; keeps the far side of the globe finite


def utm_zone(longitude: float) -> int:
    """Returns the UTM zone, 1 to 60, of a longitude in degrees, without exceptions."""
    return int(np.floor((longitude + 180.0) / 6.0)) % 60 + 1


def utm(
    latitude: np.ndarray, longitude: np.ndarray, zone: int, *, south: bool = False
) -> np.ndarray:
    """Returns easting and northing [n, 2] m of positions in degrees.

    Args:
      latitude: [n] degrees north.
      longitude: [n] degrees east.
      zone: UTM zone whose central meridian is used, also beyond its borders.
      south: add the false northing of the southern hemisphere.
    """
    system = f"+proj=utm +zone={zone} {'+south ' if south else ''}+ellps=WGS84"
    project = extra_module("pyproj").Transformer.from_pipeline(system).transform
    places = np.stack(project(longitude, latitude), axis=1)
    return np.clip(places, -FARTHEST_M, FARTHEST_M)


def earth_centred(latitude: float, longitude: float) -> np.ndarray:
    """Returns Earth-centred x, y, z [3] m of a place in degrees on the ellipsoid."""
    system = "+proj=cart +ellps=WGS84"
    project = extra_module("pyproj").Transformer.from_pipeline(system).transform
    return np.array(project(longitude, latitude, 0.0))


def projected(
    longitude: np.ndarray, latitude: np.ndarray, middle: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Projects degrees to metres [n] east and north of a middle (latitude, longitude).

    A transverse Mercator projection of true scale through the middle: north is up
    there, so that compass headings are those of the positions.
    """
    system = {"proj": "tmerc", "ellps": "WGS84", "lat_0": middle[0], "lon_0": middle[1]}
    return extra_module("pyproj").Proj(**system, k=1.0)(longitude, latitude)
