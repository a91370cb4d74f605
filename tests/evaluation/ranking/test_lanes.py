"""Which lane is chosen, and when its line is crossed, on scenes made by hand."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.evaluation.ranking.lanes import (
    LaneOutcomes,
    LaneReport,
    Lanes,
    lane_metrics,
    lane_report,
    lanes_of,
)
from rcirl_jax.planner.mobil import MOBIL_ROW
from rcirl_jax.runtime.checked import checked
from rcirl_jax.units import TIMES_S
from tests.helpers.scenes import scene

HORIZON_S = 5.0
# three humans: to the left after 2 s, to the right after 3 s, and one that stays
HUMAN = Lanes(np.array([3.0, -3.5, 0.2]), np.array([1, -1, 0]), np.array([2, 3, 5.0]))
# candidates: keep, left after 2.5 s, left after 4.5 s, right after 1.5 s
LEFT = Lanes(*(np.tile(x, (3, 1)) for x in (
    [0.0, 3.0, 2.5, -3.0], [0, 1, 1, -1], [5.0, 2.5, 4.5, 1.5]
)))  # fmt: skip
LANES = LaneOutcomes(LEFT, HUMAN, HORIZON_S)


def chosen(which):
    values = np.zeros((3, 4))
    values[np.arange(3), which] = 1.0
    return lane_metrics(values, np.ones((3, 4), bool), LANES)


def test_metrics_by_hand():
    found = chosen([2, 3, 0])
    assert found["right_side"].tolist() == [1, 1, 1]
    assert found["in_time"].tolist() == [0, 1, 1]  # 2.5 s late, 1.5 s early
    assert found["crossing_error"].tolist() == [2.5, 1.5, 0.0]
    np.testing.assert_allclose(found["lateral_fde"], [0.5, 0.5, 0.2])
    wrong = chosen([3, 0, 1])
    assert wrong["right_side"].tolist() == [0, 0, 0]
    assert wrong["crossing_error"].tolist() == [3.0, 2.0, 0.0]  # as if at the horizon


def test_lines_are_crossed_between_the_times():
    """Straight aside at 1 m/s from 0.3 m on, half a lane is 1.8 m."""
    path = scene().path
    l = jnp.stack(
        [0.3 + TIMES_S, -0.3 - 0.5 * TIMES_S, 0.0 * TIMES_S, 2.0 + 0 * TIMES_S]
    )
    found = lanes_of(l, l[:, 11], path, HORIZON_S)
    np.testing.assert_allclose(found.crossed_s, [1.5, 3.0, 5.0, 0.0], atol=1e-5)
    assert found.side.tolist() == [1, -1, 0, 1]


def test_the_report_counts_each_group_of_scenes():
    """Four vehicles: two change lanes, two do not."""
    both = [Lanes(*(np.concatenate([x, x[2:]]) for x in part)) for part in LANES[:2]]
    twice = LaneOutcomes(both[0], both[1], HORIZON_S)
    ways = {"good": [1, 3, 0, 0], MOBIL_ROW: [0, 3, 0, 1]}
    table = {}
    for name, which in ways.items():
        values = np.zeros((4, 4))
        values[np.arange(4), which] = 1.0
        table[name] = [lane_metrics(values, np.ones((4, 4), bool), twice)]
    report = lane_report(table, twice, np.arange(4))
    assert report is not None
    assert (report.changes, report.vehicles, report.stays) == (2, 2, 2)
    share = {row: found["right_side"].value for row, found in report.rows.items()}
    keeps = {row: found["keeps"].value for row, found in report.rows.items()}
    assert share == {"good": 1.0, MOBIL_ROW: 0.5}
    assert keeps == {"good": 1.0, MOBIL_ROW: 0.5}
    assert report.rows["good"]["right_side"].exact
    assert report.minus_mobil["good"].mean == pytest.approx(0.5)
    stored = json.loads(json.dumps(dataclasses.asdict(report)))
    assert checked(stored, LaneReport, "lanes") == report
    assert lane_report(table, twice, np.zeros(4, int)) is None
