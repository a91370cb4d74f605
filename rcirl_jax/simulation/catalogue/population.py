"""Ordinary drivers: the IDM population from which agents are drawn.

Distributions after reference tables of car-following calibrations: desired
speed N(1, 0.1) of the limit in [0.7, 1.3], time gap log-normal around 1.4 s,
standstill gap 1-4 m, acceleration 0.8-2.5, comfortable braking 1.5-3.5 m/s^2,
reaction 0.2-0.8 s, MOBIL politeness 0-0.5 and threshold 0.1-0.3 m/s^2.
"""

import numpy as np
from scipy.special import ndtri


def draw_driver(rng: np.random.Generator, speed_limit: float) -> dict[str, float]:
    """One driver's parameters by the names of `Driver`.

    Uniform draws and inverse distribution functions only, so that the stream
    is the same under every numpy.
    """
    u = np.clip(rng.random(8), 1e-6, 1.0 - 1e-6)
    share = float(np.clip(1.0 + 0.1 * ndtri(u[0]), 0.7, 1.3))
    headway = float(np.clip(1.4 * np.exp(0.3 * ndtri(u[1])), 0.6, 3.0))
    spread = lambda i, low, high: float(low + (high - low) * u[i])  # noqa: E731
    return {
        "desired": share * speed_limit,
        "headway": headway,
        "standstill": spread(2, 1.0, 4.0),
        "acceleration": spread(3, 0.8, 2.5),
        "braking": spread(4, 1.5, 3.5),
        "delay": spread(5, 0.2, 0.8),
        "politeness": spread(6, 0.0, 0.5),
        "threshold": spread(7, 0.1, 0.3),
        "lapse_start": np.inf,
        "lapse_end": np.inf,
    }
