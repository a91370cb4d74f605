"""The driver that changes lanes: which lane it takes, and who it lets pass."""

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.planner.mobil import Mobil, chosen_lane
from rcirl_jax.simulation.rollout import first_scenes
from tests.simulation.drives import stack
from tests.simulation.worlds import make_case

SLOW = {"s": 40.0, "v": 6.0, "desired": 6.0}
USUAL = Mobil()
TAKEN = jax.jit(lambda scene, driver: chosen_lane(scene, driver, scene.ego.l))


def scene_of(agents=(), lanes=(1, 0), route_right=None, **how):
    case = make_case(agents, speed=15.0, limit=20.0, lanes=lanes, **how)
    if route_right is not None:
        right = np.asarray(route_right, np.float32)
        case = case.replace(road=case.road.replace(route_right=right))
    return jax.tree.map(lambda x: x[0], first_scenes(stack([case]), steers=True))


def lane(scene, driver=USUAL):
    numbers = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), driver)
    return round(float(TAKEN(scene, numbers)[0].target) / 3.5)


def test_the_lane_by_hand():
    """IDM: 15 m/s, limit 20, 40 m behind 6 m/s; the left lane is free.

    front to rear is 40 - 2.3 - 2.4665 m, s* = 2 + 15 1.5 + 15 9 / (2 sqrt 2.8) m
    """
    gap, wanted = 40.0 - 2.3 - 0.5 * 4.933, 24.5 + 135.0 / (2.0 * 2.8**0.5)
    free = 1.4 * (1.0 - 0.75**4)
    kept = free - 1.4 * (wanted / gap) ** 2
    scene = scene_of([SLOW])
    assert lane(scene) == 1
    # the gain is what the slow leader costs, down to the last of it
    assert lane(scene, Mobil(threshold=free - kept - 0.01)) == 1
    assert lane(scene, Mobil(threshold=free - kept + 0.01)) == 0
    assert lane(scene_of([SLOW], lanes=(0, 0))) == 0
    assert lane(scene_of()) == 0


def test_who_comes_from_behind_is_asked():
    """At 22 m/s, 25 m behind, it would have to brake; that may be safe, not polite."""

    def behind(s, v):
        return scene_of([SLOW, {"s": s, "l": 3.5, "v": v, "desired": v}])

    assert lane(behind(-12.0, 22.0)) == 0  # not safe
    assert lane(behind(-60.0, 15.0)) == 1
    assert lane(behind(-28.0, 15.0), Mobil(politeness=0.0)) == 1
    assert lane(behind(-28.0, 15.0), Mobil(politeness=50.0)) == 0


def test_a_lane_that_ends_is_left():
    """The lane on the right ends 60 m ahead; the ego is on it."""
    at = np.arange(2304) * 2.0
    right = np.where(at < 60.0, -5.75, -1.75)
    assert lane(scene_of(lanes=(0, 1), path_l=-3.5, route_right=right)) == 0
