"""The cost of Apollo's speed DP: its sum by loops."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.features.columns import COLUMNS
from rcirl_jax.features.mapping import make_frame
from rcirl_jax.reward import SpeedDpCost, speed_dp_cost
from rcirl_jax.sampling import trajectory_from_positions
from rcirl_jax.units import DT_S, TIMES_S
from tests.helpers.scenes import random_scene

T = TIMES_S.size
NAMES = ("speed_limit", "follow_distance", "overtake_distance", "collision")


def sigmoid(x):
    return 1.0 / (1.0 + math.exp(-x))


@jax.jit
def columns(made, way):
    frame = make_frame(made, way)
    return {name: COLUMNS[name](frame) for name in NAMES}


def by_loops(made, way, w):
    """The docstring's sum, a time at a time in float64."""
    column = {name: np.asarray(x, np.float64) for name, x in columns(made, way).items()}
    v, a, j, s = (np.asarray(getattr(way, x), np.float64) for x in "vajs")
    total, hit = 0.0, False
    for t in range(T):
        if not made.time_valid[t]:
            continue
        hit |= column["collision"][t] > 0
        if t == 0:
            continue
        limit = column["speed_limit"][t]
        e = (v[t] - limit) / limit
        at = w.exceed * max(e, 0) ** 2 + w.below * max(-e, 0)
        at = w.speed * (at + w.cruise * abs(v[t] - limit))
        at += a[t] ** 2 * (1 + sigmoid(a[t] - 2) + sigmoid(-a[t] - 4)) + j[t] ** 2
        for name in ("follow_distance", "overtake_distance"):
            at += w.obstacle * max(20 - column[name][t], 0) ** 2
        total += DT_S * (at - w.way * s[t])
    return total + hit * w.collision_check


COST = jax.jit(lambda made, way, w: speed_dp_cost(made, way, SpeedDpCost(**w)))


@pytest.mark.parametrize("seed", range(3))
def test_equals_its_definition(seed):
    made, rng = random_scene(seed), np.random.default_rng(seed)
    speed = rng.uniform(2, 15) + rng.normal(0, 1.0, T).cumsum()
    stations = np.concatenate([[0.0], np.maximum(speed[1:], 0.0).cumsum() * DT_S])
    way = jax.jit(trajectory_from_positions)(made, jnp.asarray(stations), jnp.zeros(T))
    # without the charge of a crash, which hides the rest
    for weights in (SpeedDpCost(collision_check=0.0), SpeedDpCost()):
        found = float(COST(made, way, weights.fields()))
        assert found == pytest.approx(by_loops(made, way, weights), rel=2e-4)
