"""The dial: numbers of several gains, and their differences to the own cost alone."""

import dataclasses

import numpy as np
import pytest

from rcirl_jax.evaluation.closed_loop.dial import MEASURES, compare_settings
from rcirl_jax.simulation.metrics import CaseMetrics

FAMILIES = np.repeat(["a", "b"], 2)
WAY = np.full(4, 100.0)  # m
VEHICLES = np.array([0, 0, 1])


def drives(progress, faults=(0, 0, 0, 0)):
    values = {f.name: np.ones(4) for f in dataclasses.fields(CaseMetrics)}
    faults = np.array(faults)
    values |= {
        "progress": np.array(progress), "at_fault": faults, "no_fault": 1.0 - faults,
        "holds": np.tile(faults[:, None] == 0, 6), "rms_j": np.full(4, 0.5),
        "rms_a": np.full(4, 0.25),
    }  # fmt: skip
    return CaseMetrics(**values)


def test_settings_are_measured_and_set_against_the_own_cost():
    rows = {0.0: drives([50.0] * 4), 2.0: drives([100.0] * 4, (0, 0, 0, 1))}
    distance = {0.0: np.array([3.0, 4.0, 5.0]), 2.0: np.array([2.0, 3.0, 4.0])}
    found = compare_settings(rows, FAMILIES, WAY, distance, VEHICLES)
    own, turned = found[0.0], found[2.0]
    assert set(own) == set(MEASURES)
    assert all(one["minus_own"]["mean"] == 0.0 for one in own.values())
    # half the way: 5 of 16 parts of the score are halved; an own fault scores nothing
    assert own["nuplan"]["value"] == pytest.approx(100.0 * (1.0 - 2.5 / 16.0))
    assert turned["nuplan"]["value"] == pytest.approx(75.0)
    assert turned["progress"]["value"] == pytest.approx(200.0)
    assert turned["progress"]["minus_own"]["mean"] == pytest.approx(100.0)
    # Clopper and Pearson's interval of 3 in 4
    ends = [turned["no_fault"][key] for key in ("value", "low", "high")]
    assert ends == pytest.approx([75.0, 19.412, 99.369], abs=1e-3)
    assert turned["no_fault"]["minus_own"]["mean"] == pytest.approx(-25.0)
    rms = [own[name]["value"] for name in ("rms_acceleration", "rms_jerk")]
    assert rms == pytest.approx([0.25, 0.5])
    assert turned["distance"]["value"] == pytest.approx(3.0)
    assert turned["distance"]["minus_own"]["mean"] == pytest.approx(-1.0)
