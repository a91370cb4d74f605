"""The numpy file for planners: what it refuses, and that it needs numpy only."""

import numpy as np
import pytest

from rcirl_jax.export.own_planner import features
from rcirl_jax.export.own_planner.features import (
    Ego,
    FeatureError,
    FeatureMap,
    Kind,
    Obstacle,
    Path,
    Scene,
)
from rcirl_jax.features import columns as f
from tests.helpers.own_planner import every_column

FLAT = np.zeros(128)
T = np.ones(18)
S = 10.0 * features.TIMES_S[None]


def ego(**changes):
    return Ego(**{"v": 10.0, "length": 4.0, "width": 2.0, **changes})


def path(**changes):
    return Path(**{"kappa": FLAT, "l": FLAT, "speed_limit": FLAT + 25.0, **changes})


def box(**changes):
    leaves = {"s_lower": 20 * T, "s_upper": 24 * T, "l_lower": -T, "l_upper": T}
    return Obstacle(
        **{"kind": Kind.VEHICLE, "speed": 8 * T, "valid": T > 0, **leaves, **changes}
    )


def scene(**changes):
    return Scene(**{"ego": ego(), "path": path(), "obstacles": [box()], **changes})


def columns():
    made = every_column()
    return FeatureMap(made.names, [spec.unit for spec in made.specs])


def test_it_has_the_columns_of_the_package():
    assert set(features.UNITS) == set(f.COLUMNS)
    assert {spec.name: spec.unit for spec in every_column().specs} == features.UNITS


GAP = np.where(np.arange(18) == 3, np.nan, 1.0)


def test_nobody_reads_what_is_not_there():
    hidden = box(speed=8 * GAP, valid=np.isfinite(GAP))
    found = columns()(scene(obstacles=[hidden]), S)
    assert np.isfinite(found).all()
    assert found[0, 3, columns().names.index("follow_distance")] == 100.0


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ({"ego": ego(width=0.0)}, "ego.width: 0.0: expected over 0 m"),
        (
            {"path": path(kappa=FLAT[1:])},
            "path.kappa: shape (127,): expected shape (128,)",
        ),
        (
            {"obstacles": [box(), box(s_lower=30 * T)]},
            "obstacles[1].s_lower[0]: 30.0: expected at most s_upper",
        ),
        (
            {"obstacles": [box(speed=GAP)]},
            "obstacles[0].speed[3]: nan: expected finite numbers",
        ),
        ({"num_valid": 19}, "num_valid: 19: expected 1 to 18"),
    ],
)
def test_wrong_scenes_have_one_line(given, line):
    with pytest.raises(FeatureError) as caught:
        columns()(scene(**given), S)
    assert str(caught.value) == f"scene: {line}"


@pytest.mark.parametrize(
    ("ways", "line"),
    [
        ((S[:, 1:],), "candidates.s: shape (1, 17): expected shape (1, 18)"),
        ((S, np.zeros((2, 18))), "candidates.l: shape (2, 18): expected shape (1, 18)"),
        ((S * np.nan,), "candidates.s[0, 0]: nan: expected finite numbers"),
    ],
)
def test_wrong_candidates_have_one_line(ways, line):
    with pytest.raises(FeatureError) as caught:
        columns()(scene(), *ways)
    assert str(caught.value) == f"scene: {line}"


def test_unknown_columns_and_other_units_are_refused():
    with pytest.raises(
        FeatureError, match=r"features\[1\]: weather: expected one of l, "
    ):
        FeatureMap(["l", "weather"], ["m", "1"])
    with pytest.raises(FeatureError, match=r"features\[0\]: l: ft: expected m"):
        FeatureMap(["l"], ["ft"])
    with pytest.raises(FeatureError, match=r"units: 0 units: expected 1"):
        FeatureMap(["l"], [])
