"""Drives that the page plays: those of the suite, frame by frame."""

import jax
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.report.replays import AHEAD_M, BEHIND_M, FRAME_STEPS, make_replays
from rcirl_jax.simulation import rollout
from rcirl_jax.simulation.cases import STEP_S
from rcirl_jax.simulation.rollout import LANES, drive_cases
from rcirl_jax.simulation.suite import (
    drive_row,
    drive_with_logs,
    rollout_config,
)
from tests.report.tuning_case import PLAYED, SECONDS, cheap_rows, small_cases


def driven(row, cases, count):
    """Record and snapshots of the first cases, as the replays drive them."""
    at = np.minimum(np.arange(LANES), count - 1)
    full = jax.tree.map(lambda x: np.asarray(x)[at], cases.build(0, count))
    config = rollout_config(row, cases.duration_s, 1)
    logs = drive_cases(row.policy, row.params, full, config)
    return jax.tree.map(np.asarray, logs[0]), jax.tree.map(np.asarray, logs[1])


def test_frames_are_the_drives_own(replays):
    cases = small_cases()
    assert [one.case for one in replays] == list(PLAYED)
    for place, row in enumerate(cheap_rows()):
        record, shot = driven(row, cases, 2)
        for one in replays:
            number, drive = cases.ids.index(one.case), one.drives[place]
            assert drive.row == row.name
            last = int(record.valid[number].sum()) - 1
            steps = np.arange(FRAME_STEPS - 1, last + FRAME_STEPS, FRAME_STEPS)
            steps = np.minimum(steps, last)
            assert len(drive.s) == steps.size
            driven_m = record.s[number, : last + 1].max()
            assert drive.summary.startswith(f"{driven_m:.0f} m driven, ")
            hit = bool(record.at_fault[number, : last + 1].any())
            assert ("at-fault collision" in drive.summary) == hit
            for name, half in (("s", 0.051), ("l", 0.0051), ("v", 0.051)):
                shown = getattr(drive, name)
                wanted = getattr(record, name)[number, steps]
                assert shown == pytest.approx(wanted, abs=half)
            for frame, step in zip(drive.agents, steps, strict=True):
                slots = dict(zip(frame[::4], frame[1::4], strict=True))
                s = shot.agents.s[number, step]
                ahead = s - record.s[number, step]
                near = (ahead > -BEHIND_M) & (ahead < AHEAD_M)
                there = shot.agents.present[number, step] & near
                assert set(np.flatnonzero(there)) <= set(slots)
                for slot, station in slots.items():
                    assert station == pytest.approx(s[int(slot)], abs=0.051)
            assert {int(a) for f in drive.agents for a in f[::4]} <= set(one.bodies)


def test_the_drives_are_those_of_the_suite():
    """To the bit, and without another program: what the table says is what plays."""
    cases, row = small_cases(), cheap_rows()[0]
    config = rollout_config(row, cases.duration_s, 1)
    suite = drive_row(row, cases.build, len(cases.ids), config, chunk=60)
    program = rollout._compiled(row.policy, 1, config.span, config.vehicle)
    assert program._cache_size() == 1
    at = cases.ids.index(PLAYED[0])
    found, record, shot = drive_with_logs(row, cases.build(at, at + 1), config)
    assert program._cache_size() == 1
    for mine, theirs in zip(
        jax.tree.leaves(found), jax.tree.leaves(suite), strict=True
    ):
        np.testing.assert_array_equal(mine[0], theirs[at])
    assert record.s.shape == (1, config.steps)
    assert shot.plan_s.shape[:2] == (1, config.steps)


def test_a_crash_ends_the_drive_and_shows_who_was_hit(replays):
    crashed, fine = replays[0].drives
    assert "at-fault collision" in crashed.end
    assert crashed.events[0][1] == "at-fault collision"
    when = crashed.events[0][0]
    assert when < SECONDS - 0.3
    assert len(crashed.s) == int(np.ceil(when / STEP_S / FRAME_STEPS - 1e-6))
    assert crashed.start == when
    ahead = [station - crashed.s[-1] for station in crashed.agents[-1][1::4]]
    assert min(abs(gap) for gap in ahead) < 6.0  # two half lengths and a bit
    assert crashed.clearance[-1] <= 0.0
    assert not fine.end
    assert len(fine.s) == round(SECONDS / STEP_S / FRAME_STEPS)
    # at constant speed the plan k seconds ahead is k times the speed
    drive = replays[1].drives[0]
    for plan, speed in zip(drive.plan, drive.v, strict=True):
        assert plan == pytest.approx([k * speed for k in (1, 2, 3, 4, 5)], abs=0.4)


def test_a_case_that_the_suite_does_not_have():
    with pytest.raises(InputError, match="cut_in/007@0: expected a case"):
        make_replays(cheap_rows(), small_cases(), ["cut_in/007@0"], 1)
    assert make_replays(cheap_rows(), small_cases(), [], 1) == []
