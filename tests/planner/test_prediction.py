"""One observer: a scene from a log and one from the simulator show the same world."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.data.scenes.collect import Collector, assemble
from rcirl_jax.planner.plan import held
from rcirl_jax.planner.prediction import (
    NUM_BODIES,
    Bodies,
    predict,
    relevant,
    select_future,
    with_predicted_futures,
)
from rcirl_jax.simulation.recorded import case_of
from rcirl_jax.simulation.rollout import SPAN, RolloutConfig, drive_cases
from rcirl_jax.types import Kind
from rcirl_jax.units import DT_S, TIMES_S
from tests.helpers.scenes import random_scene, scene
from tests.simulation.stored import CUT, straight, tracks

PREDICT = jax.jit(predict)
AS_SEEN = jax.jit(with_predicted_futures)


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


FADING = 10.0 + np.append(
    0.0, np.cumsum(np.exp(-TIMES_S[:-1].astype(float) / 2.0) * DT_S)
)
CAR, STOPS, WALKER = {"s": 9.0, "speed": 8.0}, Kind.STATIC, Kind.PEDESTRIAN
# the others, and of the first of them a leaf and its values; lanes are 3.6 m wide
ALONE = {
    "the present acceleration fades": (
        [{"speed": 10.0, "a": 1.0}],
        {"v": FADING, "l": 0.0 * TIMES_S},
    ),
    "hard braking goes on until standing": (
        [{**CAR, "a": -4.0}],
        {"v": np.maximum(8.0 - 4.0 * TIMES_S, 0.0)},
    ),
    "who crosses keeps its velocity": (
        [{"l": -6.0, "l_dot": 1.4, "kind": WALKER}],
        {"l": -6.0 + 1.4 * TIMES_S},
    ),
    "who comes towards keeps its velocity": (
        [{"s": 80.0, "l": 3.5, "speed": -9.0}],
        {"s": 80.0 - 9.0 * TIMES_S},
    ),
    "a lane change ends in the middle of the lane": (
        [{"l": 0.5, "speed": 12.0, "l_dot": 0.8}],
        {"l": np.minimum(0.5 + 0.8 * TIMES_S, 3.6)},
    ),
    "who stands waits for the leader": ([{}, {"s": 8.0}], {"s": 0.0 * TIMES_S}),
    "static things stay": ([{"s": 30.0, "kind": STOPS}], {"s": 0 * TIMES_S + 30.0}),
}


@pytest.mark.parametrize("name", ALONE)
def test_what_is_predicted_of_one(name):
    rows, wanted = ALONE[name]
    made = scene(v=0.0, l=-30.0)
    found = dict(zip("slv", PREDICT(bodies(*rows), made.ego, made.path), strict=True))
    for leaf, values in wanted.items():
        np.testing.assert_allclose(found[leaf][0], values, atol=1e-3)


@pytest.mark.parametrize("gap", [4.0, 10.0, 40.0])
def test_a_follower_keeps_the_headway_it_has_now(gap):
    """The IDM with T = clip((gap - 2) / v, 0.4, 1.5), integrated here in float64."""
    made = scene(v=0.0, l=-30.0)  # its limit: 25 m/s
    pair = bodies({"speed": 10.0}, {"s": gap + 4.6, "speed": 10.0})
    s, _, v = PREDICT(pair, made.ego, made.path)
    headway = np.clip((gap - 2.0) / 10.0, 0.4, 1.5)
    station, speed = 0.0, 10.0
    for k, time in enumerate(TIMES_S.astype(float)):
        assert float(s[0, k]) == pytest.approx(station, abs=2e-3)
        assert float(v[0, k]) == pytest.approx(speed, abs=2e-3)
        room = gap + 10.0 * time - station
        closing = speed * (speed - 10.0) / (2.0 * np.sqrt(1.0 * 2.0))
        wanted = 2.0 + max(speed * headway + closing, 0.0)
        idm = 1.0 - (speed / 20.0) ** 4 - (wanted / room) ** 2
        a = (1.0 - np.exp(-time / 2.0)) * np.clip(idm, -8.0, 1.0)
        station += 0.5 * DT_S * (speed + max(speed + a * DT_S, 0.0))
        speed = max(speed + a * DT_S, 0.0)


def test_the_most_relevant_bodies_come_first():
    made = scene(v=0.0)
    rows = [{"s": float(s)} for s in (90, -20, 10, 70, 60, 50, 40, 30, 35, 80)]
    near = relevant(bodies(*rows), made.ego, made.path)
    # 20 m behind count as 40 m ahead
    order = [10.0, 30.0, 35.0, -20.0, 40.0, 50.0, 60.0, 70.0]
    assert sorted(np.asarray(near.s).tolist()) == sorted(order)
    assert np.asarray(near.s)[:3].tolist() == order[:3]


@pytest.mark.parametrize("seed", range(2))
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


@pytest.mark.parametrize("predicted", [True, False])
def test_either_future_of_a_scene(predicted):
    made = jax.tree.map(jnp.asarray, random_scene(2))
    found = jax.jit(select_future)(made, jnp.asarray(predicted)).obstacles
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
    config = RolloutConfig(steps=steps + 10, follow_log=True, frames_every=SPAN)
    _, _, scenes = drive_cases(human, None, cases, config)
    online = jax.tree.map(lambda x: x[0, steps // SPAN], scenes)

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
