"""The safety filter for other people's planners, numpy and C++, against JAX."""

import jax
import numpy as np
import pytest

from rcirl_jax.export.own_planner.choose import admit
from rcirl_jax.export.own_planner.features import FeatureError
from rcirl_jax.planner.safety import Reason, SafetyConfig, check, explain
from tests.helpers import drawn_scenes, own_planner
from tests.onboard.programs import built, run

SCENES, EACH = 250, 12
ROUNDING = 1e-3  # m, m/s, m/s^2 by which limits move for rulings that rounding decides


@pytest.fixture(scope="module")
def reader():
    return built("reader") / "reader"


def moved(by, entry):
    """The filter's limits, stricter by so much."""
    usual = SafetyConfig()
    wider = ("margin_along", "margin_across", "line_margin", "standstill")
    lower = ("speed_slack", "max_lateral_acceleration")
    return SafetyConfig(
        entry=entry,
        rss_recovery=usual.rss_recovery + by,
        **{name: getattr(usual, name) + by for name in wider},
        **{name: getattr(usual, name) - by for name in lower},
    )


def places(scenes, obstacle):
    """Places among the obstacles that a plain scene keeps."""
    kept = (scenes.obstacles.kind != 0) & scenes.obstacles.valid.any(axis=2)
    place = np.cumsum(kept, axis=1) - 1
    found = np.take_along_axis(place, np.maximum(obstacle, 0), axis=1)
    return np.where(obstacle < 0, -1, found)


def in_cpp(reader, folder, cases):
    """Rulings [n, K, 3] of the cases."""
    file = folder / "cases"
    np.concatenate([own_planner.as_numbers(*case) for case in cases]).tofile(file)
    found = np.frombuffer(run(reader, "admit", file), np.float32)
    return found.reshape(len(cases), -1, 3)


def in_jax(scenes, s, l, config):
    """Rulings [n, K, 3] of all scenes at once."""

    def of_one(scene, s, l):
        given = own_planner.candidates(scene, s, l)
        return check(scene, given, config).admissible, explain(scene, given, config)

    axes = (0, 0, None if l is None else 0)
    admissible, found = jax.jit(jax.vmap(of_one, axes))(scenes, s, l)
    reason, obstacle, time = (np.asarray(x) for x in found)
    np.testing.assert_array_equal(reason == Reason.NONE, admissible)
    time = np.where(np.isfinite(time), time, -1.0)
    return np.stack([reason, places(scenes, obstacle), time], axis=2)


def in_numpy(cases, config):
    found = [np.stack(admit(*case, safety=config), axis=1) for case in cases]
    return np.nan_to_num(np.stack(found), posinf=-1.0)


@pytest.mark.parametrize("on_path", [True, False])
def test_rulings_on_random_scenes_are_those_of_jax(reader, tmp_path, on_path):
    scenes = drawn_scenes.scenes(np.random.default_rng(5), SCENES)
    s, l = drawn_scenes.candidates(np.random.default_rng(6), scenes, EACH)
    l, entry = None if on_path else l, not on_path
    cases = own_planner.plain_cases(scenes, s, l)
    usual = SafetyConfig(entry=entry)
    looser, stricter = (in_numpy(cases, moved(x, entry)) for x in (-ROUNDING, ROUNDING))
    sure = (looser == stricter).all(axis=2)
    assert sure.mean() > 0.97
    wanted = in_jax(scenes, s, l, usual)
    counts = np.bincount(wanted[..., 0].astype(int).ravel(), minlength=9)
    never = {Reason.NOT_FEASIBLE}
    never |= {Reason.ROAD, Reason.ENTRY} if on_path else set()
    assert all(counts[x] >= 5 for x in set(Reason) - never), counts
    for rulings in (in_numpy(cases, usual), in_cpp(reader, tmp_path, cases)):
        np.testing.assert_allclose(rulings[sure], wanted[sure], rtol=1e-6)


def test_what_the_vehicle_cannot_drive_is_the_first_reason():
    scenes = drawn_scenes.scenes(np.random.default_rng(5), 1)
    s, _ = drawn_scenes.candidates(np.random.default_rng(6), scenes, 2)
    ((plain, *_),) = own_planner.plain_cases(scenes, s)
    found = admit(plain, s[0], feasible=np.array([False, True]))
    assert found.reason[0] == Reason.NOT_FEASIBLE
    assert found.reason[1] != Reason.NOT_FEASIBLE
    with pytest.raises(FeatureError, match=r"feasible: int64 \(1,\): expected bool"):
        admit(plain, s[0], feasible=np.array([1]))
