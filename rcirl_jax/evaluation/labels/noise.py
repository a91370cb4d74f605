"""Errors of recorded positions, as simulated drives get them."""

import numpy as np

from rcirl_jax.errors import InputError

# sd of the slow and the white error of positions, m. With "ngsim" 17 % of the raw
# |a| exceed 3 m/s^2 (US-101: 17.9 %) and 0.1 % of the smoothed (US-101: 3.0 %, in
# part real braking); "rough" doubles the slow error
NOISES = {
    "none": (0.0, 0.0),
    "white": (0.0, 0.008),
    "ngsim": (0.2, 0.008),
    "rough": (0.4, 0.008),
}
SLOW_ERROR_S = (2.0, 6.0)  # s, range of the slow error's periods


def check_noise(noise: str) -> None:
    """InputError unless it is a key of `NOISES`."""
    if noise not in NOISES:
        raise InputError(f"--noise: {noise}: expected one of {', '.join(NOISES)}")


def position_errors(
    driven: np.ndarray, noise: tuple[float, float], rng: np.random.Generator
) -> np.ndarray:
    """[2, n] m, errors of the positions in x and y.

    A slow one, sum_i A sin(2 pi u / P_i + p_i) with variance 3 A^2 / 2, and a
    white one.

    Args:
      driven: [n] s in motion so far: u; a standing object's error hardly moves.
      noise: sd of both, m.
      rng: consumed.
    """
    periods = rng.uniform(*SLOW_ERROR_S, (2, 3, 1))
    phases = rng.uniform(0.0, 2.0 * np.pi, (2, 3, 1))
    waves = np.sin(2.0 * np.pi * driven / periods + phases)
    slow = noise[0] * np.sqrt(2.0 / 3.0) * waves.sum(axis=1)
    return slow + noise[1] * rng.standard_normal(slow.shape)
