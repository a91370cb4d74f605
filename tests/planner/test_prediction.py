"""One observer: a scene from a log and one from the simulator show the same world."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.data.scenes.assemble import assemble
from rcirl_jax.data.scenes.collect import Collector
from rcirl_jax.planner.plan import held
from rcirl_jax.planner.prediction import (
    NUM_BODIES,
    Bodies,
    as_seen,
    either,
    predict,
    relevant,
)
from rcirl_jax.simulation.recorded.scenes import case_of
from rcirl_jax.simulation.rollout import RolloutConfig, drive_cases
from rcirl_jax.types import Kind
from rcirl_jax.units import DT_S, TIMES_S
from tests.helpers.scenes import random_scene, scene
from tests.simulation.stored import CUT, straight, tracks

PREDICT = jax.jit(predict)
AS_SEEN = jax.jit(as_seen)


def bodies(*rows):
    """Bodies from dicts; what is not given is a car at rest."""
    usual = {
        "s": 0.0, "l": 0.0, "speed": 0.0, "l_dot": 0.0, "a": 0.0, "half_s": 2.3,
        "half_l": 0.9, "kind": Kind.VEHICLE, "present": True,
    }  # fmt: skip
    column = lambda name: np.array([{**usual, **row}[name] for row in rows])  # noqa: E731
    types = {"kind": np.int32, "present": bool}
    leaves = {n: column(n).astype(types.get(n, np.float32)) for n in usual}
    return jax.tree.map(jnp.asarray, Bodies(**leaves))


def test_without_a_leader_the_present_acceleration_fades():
    made = scene(v=0.0, l=-30.0)
    s, l, v = PREDICT(bodies({"s": 20.0, "speed": 10.0, "a": 1.0}), made.ego, made.path)
    steps = np.exp(-TIMES_S[:-1].astype(float) / 2.0) * DT_S
    speed = 10.0 + np.append(0.0, np.cumsum(steps))
    np.testing.assert_allclose(v[0], speed, atol=1e-4)
    way = np.append(0.0, np.cumsum(0.5 * (speed[1:] + speed[:-1]) * DT_S))
    np.testing.assert_allclose(s[0], 20.0 + way, atol=1e-3)
    np.testing.assert_allclose(l[0], 0.0, atol=1e-6)


def test_hard_braking_goes_on_until_standing():
    made = scene(v=0.0, l=-30.0)
    s, _, v = PREDICT(bodies({"s": 9.0, "speed": 8.0, "a": -4.0}), made.ego, made.path)
    np.testing.assert_allclose(v[0], np.maximum(8.0 - 4.0 * TIMES_S, 0.0), atol=1e-4)
    assert float(s[0, -1]) == pytest.approx(9.0 + 8.0, abs=0.3)


def test_a_follower_slows_down_behind_its_leader_and_keeps_its_headway():
    made = scene(v=0.0, l=-30.0)
    pair = bodies({"s": 0.0, "speed": 15.0}, {"s": 30.0, "speed": 10.0})
    s, _, v = PREDICT(pair, made.ego, made.path)
    assert float(v[0, -1]) < 11.5
    gap = np.asarray(s[1] - s[0] - 4.6)
    assert gap.min() > 8.0
    # alone it would be where the leader is
    alone, _, _ = PREDICT(bodies({"s": 0.0, "speed": 15.0}), made.ego, made.path)
    assert float(alone[0, -1]) == pytest.approx(120.0, abs=1e-3)


def test_who_stands_waits_for_the_leader_and_static_things_stay():
    made = scene(v=0.0, l=-30.0)
    queue = bodies({"s": 0.0}, {"s": 8.0}, {"s": 30.0, "kind": Kind.STATIC})
    s, _, _ = PREDICT(queue, made.ego, made.path)
    np.testing.assert_allclose(s, np.array([0.0, 8.0, 30.0])[:, None] + 0 * s)
    moving = bodies({"s": 0.0}, {"s": 8.0, "speed": 6.0})
    s, _, _ = PREDICT(moving, made.ego, made.path)
    assert float(s[0, -1]) > 5.0


def test_crossing_and_oncoming_bodies_keep_their_velocity():
    made = scene(v=0.0)
    both = bodies(
        {"s": 20.0, "l": -6.0, "l_dot": 1.4, "kind": Kind.PEDESTRIAN},
        {"s": 80.0, "l": 3.5, "speed": -9.0},
    )
    s, l, v = PREDICT(both, made.ego, made.path)
    np.testing.assert_allclose(l[0], -6.0 + 1.4 * TIMES_S, atol=1e-5)
    np.testing.assert_allclose(s[1], 80.0 - 9.0 * TIMES_S, atol=1e-4)
    np.testing.assert_allclose(v[1], -9.0)


def test_a_lane_change_ends_in_the_middle_of_the_lane():
    made = scene(v=0.0)  # lanes 3.6 m wide, the ego's centred at 0
    _, l, _ = PREDICT(
        bodies({"s": 20.0, "l": 0.5, "speed": 12.0, "l_dot": 0.8}), made.ego, made.path
    )
    np.testing.assert_allclose(l[0], np.minimum(0.5 + 0.8 * TIMES_S, 3.6), atol=1e-4)


def test_the_most_relevant_bodies_come_first():
    made = scene(v=0.0)
    rows = [{"s": float(s)} for s in (90, -20, 10, 70, 60, 50, 40, 30, 35, 80)]
    near = relevant(bodies(*rows), made.ego)
    # 20 m behind count as 40 m ahead
    order = [10.0, 30.0, 35.0, -20.0, 40.0, 50.0, 60.0, 70.0]
    assert sorted(np.asarray(near.s).tolist()) == sorted(order)
    assert np.asarray(near.s)[:3].tolist() == order[:3]


@pytest.mark.parametrize("seed", range(4))
def test_what_is_seen_depends_on_the_present_alone(seed):
    """Recorded futures do not leak: any other future gives the same view."""
    made = jax.tree.map(jnp.asarray, random_scene(seed))
    o = made.obstacles
    later = lambda x: x.at[:, 1:].set(x[:, 1:] * 1.7 + 3.0)  # noqa: E731
    changed = o.replace(
        **{n: later(getattr(o, n)) for n in ("s_lower", "s_upper", "l_lower", "speed")},
        valid=o.valid.at[:, 1:].set(~o.valid[:, 1:]),
    )
    one, two = AS_SEEN(made), AS_SEEN(made.replace(obstacles=changed))
    assert all(jax.tree.leaves(jax.tree.map(np.array_equal, one, two)))
    assert one.obstacles.kind.shape == (NUM_BODIES + 2,)


@pytest.mark.parametrize("seed", range(4))
def test_to_look_twice_shows_the_same(seed):
    once = AS_SEEN(jax.tree.map(jnp.asarray, random_scene(seed)))
    twice = AS_SEEN(once)
    known = np.asarray(once.obstacles.valid)
    for name in ("s_lower", "s_upper", "l_lower", "l_upper", "speed"):
        a, b = (np.asarray(getattr(x.obstacles, name)) for x in (once, twice))
        np.testing.assert_allclose(a[known], b[known], atol=1e-3)
    np.testing.assert_array_equal(known, twice.obstacles.valid)


@pytest.mark.parametrize("predicted", [True, False])
def test_either_future_of_a_scene(predicted):
    made = jax.tree.map(jnp.asarray, random_scene(2))
    found = jax.jit(either)(made, jnp.asarray(predicted)).obstacles
    wanted = (AS_SEEN(made) if predicted else made).obstacles
    slots = wanted.valid.shape[0]
    same = jax.tree.map(lambda x, y: np.array_equal(x[:slots], y), found, wanted)
    assert all(jax.tree.leaves(same))
    assert not np.asarray(found.valid)[slots:].any()
    assert found.valid.shape == made.obstacles.valid.shape


# ------------------------------------------------------------- through both doors


def test_one_scene_through_both_doors():
    """A log as training data, and driven from a scene of a second before: equal."""
    recording = straight(tracks())
    rows = [row for row in Collector(recording, CUT).scenes() if row["track"] == 0]
    first, last = rows[2], rows[4]
    steps, none = int(last["frame"] - first["frame"]), [0, 0]
    made = assemble([first, last], vehicles=none, groups=none, recording=0)
    assert made.scene.time_valid.all()
    offline = AS_SEEN(jax.tree.map(lambda x: jnp.asarray(x[1]), made.scene))

    case = case_of(jax.tree.map(lambda x: np.asarray(x)[0], made))
    cases = jax.tree.map(lambda x: np.asarray(x)[None], case)
    human = lambda params, scene, key, before: held(scene.ego.v, 0.0 * scene.ego.v)  # noqa: E731
    config = RolloutConfig(steps=steps + 10, follow_log=True, scenes=True)
    _, _, scenes = drive_cases(human, None, cases, config)
    online = jax.tree.map(lambda x: np.asarray(x)[0, steps], scenes)

    np.testing.assert_array_equal(offline.time_valid, online.time_valid)
    np.testing.assert_array_equal(offline.obstacles.valid, online.obstacles.valid)
    known = np.asarray(offline.obstacles.valid)[:, 0]
    assert known.sum() == 3
    roads = ("kappa", "l", "speed_limit", "lane_left", "lane_right", "road_left")
    boxes = ("s_lower", "s_upper", "l_lower", "l_upper", "speed")
    for part, names, some, atol in (
        ("ego", ("s", "l", "dl", "v", "a", "length", "width"), ..., 2e-3),
        ("path", roads, ..., 2e-3),
        ("obstacles", ("kind", "a", "l_dot"), known, 5e-3),
        ("obstacles", boxes, known, 5e-2),
    ):
        for name in names:
            one, two = (getattr(getattr(x, part), name) for x in (offline, online))
            np.testing.assert_allclose(one[some], two[some], atol=atol, err_msg=name)
