"""Of one simulated drive: its worst moment, its road, when a plan was made."""

import json
import re
import types

import numpy as np
import pytest

from rcirl_jax.report.replays import plan_start, road_in_plane, worst_step
from rcirl_jax.simulation.cases import STEP_S
from rcirl_jax.units import TIMES_S
from tests.helpers.commands import succeeded
from tests.helpers.weights_files import random_weights

STEPS = 200
SPEED = 12.0  # m/s
HIT = 150  # step of the crash


def drive(*, crash=False, planned=1):
    """A car ahead that brakes, followed at one speed; a plan every few steps."""
    time = (np.arange(STEPS) + 1) * STEP_S
    s = SPEED * time
    clearance = np.abs(60.0 + 9.0 * time - s) - 1.75
    collision = np.zeros(STEPS, np.int32)
    valid = np.ones(STEPS, bool)
    if crash:
        collision[HIT], valid[HIT + 1 :], clearance[HIT] = 1, False, -0.2
    begin = np.append(0.0, s)[(np.arange(STEPS) // planned) * planned]
    record = types.SimpleNamespace(
        valid=valid, s=s, a=np.sin(time), clearance=clearance, collision=collision,
        at_fault=collision,
    )  # fmt: skip
    plan = begin[:, None] + 11.0 * TIMES_S[None]
    return record, types.SimpleNamespace(plan_s=plan)


@pytest.mark.parametrize(
    ("crash", "changes", "worst"),
    [
        (True, {"at_fault": np.zeros(STEPS)}, lambda r: HIT),
        (False, {}, lambda r: np.argmin(r.clearance)),
        (False, {"clearance": np.full(STEPS, np.inf)}, lambda r: np.argmin(r.a)),
    ],
)
def test_worst_step_prefers_the_crash(crash, changes, worst):
    record, _ = drive(crash=crash)
    for name, values in changes.items():
        setattr(record, name, values)
    assert worst_step(record) == int(worst(record))


def test_a_circle_in_the_plane():
    x, y, heading = road_in_plane(np.full(101, 0.01))
    np.testing.assert_allclose(np.hypot(x, y - 100.0), 100.0, rtol=1e-9)
    np.testing.assert_allclose(np.diff(heading), 0.02, rtol=1e-9)


@pytest.mark.parametrize("planned", [1, 5])
def test_plan_starts_when_it_was_made(planned):
    record, shot = drive(planned=planned)
    for step in (0, 3, 4, 5, 77, 149):
        made = step // planned * planned * STEP_S
        assert plan_start(record, shot, step) == pytest.approx(made)


def test_a_case_is_one_page_with_the_player(tmp_path):
    weights = random_weights(tmp_path / "w.msgpack")
    flags = (f"--weights={weights}", "--row=IDM", f"--output={tmp_path}/out",
             "--case=stopped_lead/000@0", "--duration=2")  # fmt: skip
    done = succeeded("rcirl_jax", "replay", *flags)
    (page,) = (tmp_path / "out").iterdir()
    block = r'<script type="application/json" id="replays">(.*?)</script>'
    (data,) = re.findall(block, page.read_text())
    (found,) = json.loads(data)["cases"]
    (driven,) = found["drives"]
    assert (found["case"], driven["row"]) == ("stopped_lead/000@0", "IDM")
    assert len(driven["s"]) == 10  # 2 s at 5 Hz
    assert driven["summary"] in done.stdout
