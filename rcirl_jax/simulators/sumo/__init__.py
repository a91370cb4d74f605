"""SUMO (Alvarez Lopez et al. 2018) by libsumo: signalised corridors.

`network.py` writes the roads and the traffic of a run into a temporary folder, all of
it drawn here; `run.py` is the simulator. libsumo holds one simulation a process, so the
episodes of a run are corridors side by side that no vehicle leaves.
"""

from rcirl_jax.simulators.sumo.run import Sumo

__all__ = ["Sumo"]
