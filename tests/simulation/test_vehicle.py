"""The ego against exact solutions, an integrator and its own path."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rcirl_jax.simulation.cases import EgoState
from rcirl_jax.simulation.world import Vehicle, drive, steering
from tests.simulation.worlds import make_case


def ego(v=10.0, l=0.0, a=0.0, curvature=0.0):
    f = jnp.float32
    return EgoState(
        s=f(0.0), l=f(l), heading=f(0.0), v=f(v), a=f(a), curvature=f(curvature)
    )


PLAIN = Vehicle()


def road_of(**more):
    return jax.tree.map(jnp.asarray, make_case(**more).road)


def run(state, road, command, steps, vehicle=PLAIN):
    def step(x, u):
        after = drive(x, road, u, vehicle)
        return after, after

    commands = jnp.broadcast_to(jnp.asarray(command, jnp.float32), (steps,))
    return jax.jit(lambda x: jax.lax.scan(step, x, commands)[1])(state)


def test_speed_never_turns_negative_and_the_car_then_stands():
    log = run(ego(v=4.0), road_of(), -6.0, 60)
    assert float(log.v.min()) == 0.0
    assert float(log.s[-1]) == float(log.s[-20])
    assert float(log.a[-1]) == 0.0


@pytest.mark.parametrize("kappa", [0.01, -0.05])
def test_a_bend_is_driven_on_its_centre_line(kappa):
    log = run(ego(v=8.0), road_of(kappa=kappa), 0.0, 200)
    assert float(jnp.abs(log.l).max()) < 0.25
    assert float(log.curvature[-1]) == pytest.approx(kappa, rel=0.02)


def test_equals_an_independent_integration_of_the_equations():
    road = road_of(kappa=0.015)
    vehicle = Vehicle(substeps=64)
    log = run(ego(v=12.0, l=0.8), road, 1.0, 20, vehicle)

    def rates(_, x, target):
        _, l, h, v, a, c = x
        shrink = 1.0 - 0.015 * l
        way = v * math.cos(h) / shrink
        return [way, v * math.sin(h), v * c - 0.015 * way, a,
                (1.0 - a) / 0.2, (target - c) / 0.05]  # fmt: skip

    x = np.array([0.0, 0.8, 0.0, 12.0, 0.0, 0.0])
    for _ in range(20):
        now = ego().replace(
            s=jnp.float32(x[0]), l=jnp.float32(x[1]), heading=jnp.float32(x[2]),
            v=jnp.float32(x[3]), a=jnp.float32(x[4]), curvature=jnp.float32(x[5]),
        )  # fmt: skip
        target = float(steering(now, road, vehicle))
        x = solve_ivp(rates, (0, 0.1), x, args=(target,), rtol=1e-9, atol=1e-9).y[:, -1]
    found = [log.s[-1], log.l[-1], log.heading[-1], log.v[-1], log.a[-1]]
    np.testing.assert_allclose(np.array(found, np.float64), x[:5], atol=5e-3)
    usual = run(ego(v=12.0, l=0.8), road, 1.0, 20)
    assert abs(float(usual.s[-1]) - x[0]) < 0.05  # m, at the substeps that are used
