"""In a single file of cars nobody overtakes, nudges, cuts in or changes lane."""

import numpy as np

from rcirl_jax.evaluation.labels.platoons import CARS, measure_platoons, platoon


def test_a_platoon_has_no_manoeuvres():
    found = measure_platoons(1, seed=1)
    assert found["scenes"] > 800
    assert found["follow"] > 2 * found["scenes"]
    assert {name for name, count in found["never"].items() if count} <= {
        *("yield", "yielding")
    }
    # who wanders into the lane from beside it, and is braked for: one in a thousand
    assert found["never"]["yielding"] <= 0.002 * found["scenes"]


def test_the_cars_keep_their_order_and_go_round():
    made = platoon(np.random.default_rng(0))
    assert len(made.tracks) == CARS
    gaps = [
        np.hypot(a.x - b.x, a.y - b.y)
        for a, b in zip(made.tracks, made.tracks[1:], strict=False)
    ]
    assert min(gap.min() for gap in gaps) > 4.7
    for track in made.tracks:
        steps = np.hypot(np.diff(track.x), np.diff(track.y)) * made.rate_hz
        assert np.abs(steps - track.speed[1:]).max() < 1.5  # errors wander slowly
    assert np.unwrap(made.tracks[0].heading)[-1] > 1.9 * np.pi  # about a lap
    again = platoon(np.random.default_rng(0))
    np.testing.assert_array_equal(again.tracks[3].x, made.tracks[3].x)
