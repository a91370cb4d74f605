"""Synthetic human traffic: roads, drivers and the simulation that joins them.

The embedded default data of the project: made on the host with numpy, the same
on every run for a given seed, free of any third party's rights.
"""

from rcirl_jax.data.synthetic.drivers import DriverConfig
from rcirl_jax.data.synthetic.roads import ROADS, Road
from rcirl_jax.data.synthetic.traffic import RunConfig, simulate

__all__ = ["ROADS", "DriverConfig", "Road", "RunConfig", "simulate"]
