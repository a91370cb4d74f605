"""The choice among own candidates: what is refused, and C++ chooses as Python does."""

import dataclasses

import numpy as np
import pytest

from rcirl_jax.export import Guard, load_weights
from rcirl_jax.export.own_planner.choose import choose
from rcirl_jax.export.own_planner.features import (
    TIMES_S,
    Ego,
    FeatureError,
    FeatureMap,
    Kind,
    Obstacle,
    Path,
    Scene,
)
from rcirl_jax.features import feature_map
from tests.helpers import drawn_scenes, own_planner
from tests.onboard.programs import ONBOARD, built, run

WEIGHTS = ONBOARD / "conformance" / "paper21.msgpack"
FLAT, T = np.zeros(128), np.ones(18)
SPEEDS = np.arange(4.0, 14.0)  # m/s


@pytest.fixture(scope="module")
def reader():
    return built("reader") / "reader"


def box(kind, s, speed=0.0 * T, length=4.5, width=1.8):
    return Obstacle(
        kind=kind,
        s_lower=s - 0.5 * length, s_upper=s + 0.5 * length,
        l_lower=-0.5 * width * T, l_upper=0.5 * width * T, speed=speed, valid=T,
    )  # fmt: skip


def braking_leader():
    """From 13 m/s to rest with 3 m/s^2, 30 m ahead."""
    t = np.minimum(TIMES_S, 13.0 / 3.0)
    return box(Kind.VEHICLE, 30.0 + 13.0 * t - 1.5 * t**2, 13.0 - 3.0 * t)


def stop_line():
    return box(Kind.STOP, 40.0 * T, length=0.1, width=40.0)


def road(*boxes, **edges):
    path = Path(kappa=FLAT, l=FLAT, speed_limit=FLAT + 14.0, **edges)
    return Scene(ego=Ego(v=8.0, length=4.9, width=2.0), path=path, obstacles=boxes)


def holding(speeds=SPEEDS):
    """Candidates [K, T] that take a speed at once and hold it."""
    return speeds[:, None] * TIMES_S


@pytest.fixture(scope="module")
def likes_speed():
    """A reward whose value is the station reached, under mode=speed."""
    reward = load_weights(WEIGHTS)
    fastest = np.zeros((21, 1), np.float32)
    fastest[reward.names.index("station")] = 1.0
    last = np.zeros(1, np.float32)
    return dataclasses.replace(reward, kernels=(fastest,), biases=(last,), gamma=T)


def test_the_best_value_that_is_admissible_is_chosen(likes_speed):
    """Behind a leader that brakes, before a line, and where none is admissible."""
    found = choose(likes_speed, road(braking_leader()), holding())
    assert np.argmax(found.values) == 9
    assert found.why[9].startswith("hits obstacles[0] after ")
    assert found.best == max(k for k in range(10) if not found.why[k])
    assert found.best < 9
    assert found.none == ""
    np.testing.assert_array_equal(found.admissible, [not x for x in found.why])
    found = choose(likes_speed, road(stop_line()), holding())
    assert found.why[9].startswith("passes the line obstacles[0] at ")
    assert found.best == 0  # 4 m/s for 8 s ends before it
    found = choose(likes_speed, road(box(Kind.STATIC, 12.0 * T)), holding())
    assert found.best is None
    assert found.none.startswith("none of 10 candidates is admissible: candidate 0 hit")
    nothing = choose(likes_speed, road(), np.zeros((0, 18)))
    assert (nothing.best, nothing.none) == (None, "none of 0 candidates is admissible")


EDGES = {"road_left": FLAT + 6.0, "road_right": FLAT - 6.0}


def test_offsets_that_differ_are_refused_where_l_was_not_trained(likes_speed):
    s, l = holding(), np.linspace(0.0, 3.0, 10)[:, None] * np.minimum(TIMES_S / 3.0, 1)
    with pytest.raises(FeatureError) as caught:
        choose(likes_speed, road(**EDGES), s, l)
    assert str(caught.value) == (
        "scene: candidates.l: 9 and 0 are 3.00 m apart at 3.29 s: expected no offsets, "
        f"or equal ones: l was not trained ({WEIGHTS}: mode=speed)"
    )
    assert choose(likes_speed, road(**EDGES), s, 0.05 * l).best is not None
    told = {**likes_speed.provenance, "mode": "path_speed"}
    both = dataclasses.replace(likes_speed, provenance=told)
    assert choose(both, road(**EDGES), s, l).best is not None


@pytest.fixture(scope="module")
def rewards(tmp_path_factory):
    """Weights by what is special of them; of candidates with offsets but `speed`."""
    folder, columns = tmp_path_factory.mktemp("weights"), feature_map("paper21")
    special = {
        "speed": {"mode": "speed"},
        "lateral": {"mode": "path_speed"},
        "prior": {"mode": "path_speed", "with_prior": True},
        "guarded": {"mode": "path_speed", "fastest": 5.0},
    }
    return {
        name: own_planner.drawn_reward(folder / name, columns, **how)
        for name, how in special.items()
    }


def test_a_prior_cost_needs_own_values(rewards):
    reward, s, own = rewards["prior"], holding(), -np.arange(10.0)
    found = choose(reward, road(), s, own=own)
    columns = FeatureMap(reward.names, reward.units)(road(), s)
    np.testing.assert_array_equal(found.values, reward.total(columns, own))
    for given, line in (
        ({}, "own: None: expected own values, for it has"),
        ({"own": own, "guard": Guard(reward)}, "guard: given: expected none, for it"),
        ({"own": own[1:]}, r"own: shape \(9,\): expected 10 finite num"),
    ):
        with pytest.raises(FeatureError, match=line):
            choose(reward, road(), s, **given)


def test_own_values_choose_out_of_distribution(rewards):
    reward, s, own = rewards["guarded"], holding(), -np.arange(10.0)
    guard = Guard(reward)
    found = choose(reward, road(), s, own=own, guard=guard)
    assert found.in_distribution is False
    np.testing.assert_array_equal(found.values, own.astype(np.float32))
    assert found.best == 0
    alone = choose(reward, road(), s, guard=guard)
    assert alone.best is None
    assert alone.none.endswith(": no own values to choose by")
    assert choose(reward, road(), s).in_distribution is None


SCENES, EACH = 60, 40


def in_cpp(reader, folder, reward, cases, own=None, guard=False):
    """(best, why none, values, why) of each case."""
    file, values = folder / "cases", folder / "own"
    np.concatenate([own_planner.as_numbers(*case) for case in cases]).tofile(file)
    given = () if own is None else (values,)
    if own is not None:
        own.astype("<f4").tofile(values)
    words = ("choose", "guard" if guard else "free", reward.file, file, *given)
    lines = iter(run(reader, *words).decode().splitlines())
    for _, s, _ in cases:
        best, none = next(lines).split(" ", 1)
        values, why = zip(*(next(lines).split(" ", 1) for _ in s), strict=True)
        best = None if int(best) == len(s) else int(best)
        yield best, none, np.array(values, np.float32), list(why)


@pytest.mark.parametrize("name", ["speed", "prior", "guarded", "no_own"])
def test_choices_in_cpp_are_those_of_python(reader, rewards, tmp_path, name):
    reward = rewards["guarded" if name == "no_own" else name]
    guard = name in ("guarded", "no_own")
    scenes = drawn_scenes.scenes(np.random.default_rng(9), SCENES)
    s, l = drawn_scenes.candidates(np.random.default_rng(8), scenes, EACH)
    own = np.random.default_rng(7).normal(scale=3.0, size=(SCENES, EACH))
    own = None if name in ("speed", "lateral", "no_own") else own.astype(np.float32)
    cases = own_planner.plain_cases(scenes, s, None if name == "speed" else l)
    told, equal, known = in_cpp(reader, tmp_path, reward, cases, own, guard), 0, set()
    for n, (best, none, values, why) in enumerate(told):
        options = {"own": None if own is None else own[n]}
        options["guard"] = Guard(reward) if guard else None
        wanted = choose(reward, *cases[n], **options)
        known.add(wanted.in_distribution)
        np.testing.assert_allclose(values, wanted.values, rtol=1e-4, atol=1e-4)
        if why != list(wanted.why):  # a box that touches by rounding
            continue
        equal += 1
        assert none == wanted.none
        assert (best is None) == (wanted.best is None)
        if best is not None:
            assert wanted.values[best] >= wanted.values[wanted.best] - 1e-4
    assert equal > 0.9 * SCENES
    assert known == ({True, False} if guard else {None})


def test_what_python_refuses_cpp_refuses_with_the_same_line(reader, rewards, tmp_path):
    s, l = holding(), np.linspace(0.0, 3.0, 10)[:, None] * np.minimum(TIMES_S / 3.0, 1)
    wide = dataclasses.replace(road(**EDGES), obstacles=())
    unknown = road(road_left=FLAT + 1e6, road_right=FLAT - 1e6)
    for name, case in (
        ("speed", (wide, s, l)),
        ("prior", (wide, s, None)),
        ("lateral", (wide, s + 12.0 * (np.arange(10) == 3)[:, None], None)),
        ("lateral", (wide, s, l + 2.0)),
        ("lateral", (unknown, s, l)),
    ):
        ((best, none, values, _),) = in_cpp(reader, tmp_path, rewards[name], [case])
        scene, *ways = case
        if scene is unknown:
            scene = road()
        with pytest.raises(FeatureError) as caught:
            choose(rewards[name], scene, *ways)
        assert none == str(caught.value)
        assert best is None
        assert np.isinf(values).all() or name == "prior"
