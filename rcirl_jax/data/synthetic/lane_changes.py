"""Lane changes: MOBIL, towards the destination, and pulling over."""

import numpy as np

from rcirl_jax.data.synthetic.drivers import DriverConfig, idm_acceleration
from rcirl_jax.data.synthetic.state import Neighbours, RoadTable, State

MIN_CHANGE_MPS = 4.0  # m/s, slower cars do not begin a lane change
MIN_SIDE_GAP_M = 2.0  # m, gap to the new leader and the new follower
SIDE_GAP_S = 0.25  # s, and this much of the driving time
OWN_BRAKING_MPS2 = 2.0  # m/s^2, a change may cost its driver this much
GO_RIGHT_M = 500.0  # m before the destination: the driver works to the right
GO_RIGHT_MPS2 = 1.5  # m/s^2, incentive to do so
PULL_OVER_M = 30.0  # m before the destination, at least, the car pulls over
PULL_OVER_S = 3.2  # s before it, and
PULL_OVER_MPS2 = 1.5  # m/s^2, before more braking than this is needed
STRIP_CLEAR_M = 12.0  # m around the car's way on the strip that must be free


def change_lanes(
    state: State,
    table: RoadTable,
    around: Neighbours,
    desired: np.ndarray,
    config: DriverConfig,
    clock: float,
) -> None:
    """Begin at most one lane change per recording: the most wanted safe one.

    One at a time, so that two cars never choose the same gap at once.
    """
    rows, grid = table.index(state.s)
    able = state.alive & (state.phase >= 1.0) & (state.v > MIN_CHANGE_MPS)
    able &= clock - state.changed > config.change_pause_s
    able &= table.calm[rows, grid] & (state.lane < table.num_lanes)
    able &= state.s < table.length - 2.0 * MIN_CHANGE_MPS * config.change_time_s[1]
    gains = np.stack(
        [
            np.where(able, _gain(state, table, around, desired, side), -np.inf)
            for side in (-1, 1)
        ]
    )
    flat = np.moveaxis(gains, 0, 2).reshape(len(state.s), -1)
    best = np.argmax(flat, axis=1)
    for r in np.flatnonzero(flat[np.arange(len(flat)), best] > 0.0):
        slot, right = divmod(int(best[r]), 2)
        begin_change(
            state, int(r), slot, int(state.lane[r, slot]) + 2 * right - 1, clock
        )


def begin_change(state: State, r: int, slot: int, lane: int, clock: float) -> None:
    """From now on the car is in both lanes."""
    state.old_lane[r, slot] = state.lane[r, slot]
    state.lane[r, slot] = lane
    state.phase[r, slot] = 0.0
    state.changed[r, slot] = clock


def _gain(
    state: State, table: RoadTable, around: Neighbours, desired: np.ndarray, side: int
) -> np.ndarray:
    """MOBIL's incentive minus its threshold [m/s^2]; -inf where unsafe."""
    rows = np.arange(len(state.s))[:, None]
    here = 1 << state.lane
    target = state.lane + side
    exists = (target >= 0) & (target < table.num_lanes)
    there = np.where(exists, 1 << np.maximum(target, 0), 0)
    lead, to_lead = around.leader(here)
    behind, to_behind = around.follower(here)
    new_lead, to_new_lead = around.leader(there)
    new_behind, to_new_behind = around.follower(there)
    length = state.driver["length"]

    def follow(i: np.ndarray, leader: np.ndarray, distance: np.ndarray) -> np.ndarray:
        gap = distance - 0.5 * (length[rows, i] + length[rows, leader])
        return idm_acceleration(
            state.v[rows, i],
            desired[rows, i],
            gap,
            state.v[rows, leader],
            state.driver[rows, i],
        )

    me = np.broadcast_to(np.arange(state.s.shape[1]), state.s.shape)
    mine, mine_after = follow(me, lead, to_lead), follow(me, new_lead, to_new_lead)
    # followers that do not exist neither lose nor gain
    has_behind, has_new = np.isfinite(to_behind), np.isfinite(to_new_behind)
    old_now = follow(behind, me, to_behind)
    old_after = follow(behind, lead, to_behind + to_lead)
    new_now = follow(new_behind, new_lead, to_new_behind + to_new_lead)
    new_after = follow(new_behind, me, to_new_behind)
    others = np.where(has_new, new_after - new_now, 0.0)
    others += np.where(has_behind, old_after - old_now, 0.0)
    gain = mine_after - mine + state.driver["politeness"] * others
    gain += _wish(state, table, side) - state.driver["threshold"]
    room = MIN_SIDE_GAP_M + SIDE_GAP_S * state.v
    room_behind = MIN_SIDE_GAP_M + SIDE_GAP_S * state.v[rows, new_behind]
    ahead = to_new_lead - 0.5 * (length + length[rows, new_lead])
    back = to_new_behind - 0.5 * (length + length[rows, new_behind])
    safe = exists & (ahead > room) & (mine_after > -OWN_BRAKING_MPS2)
    calm = (back > room_behind) & (new_after > -state.driver["safe"])
    return np.where(safe & (~has_new | calm), gain, -np.inf)


def _wish(state: State, table: RoadTable, side: int) -> np.ndarray:
    """Extra incentive of drivers near their destination, m/s^2."""
    left = state.driver["destination"] - state.s
    near = (left < GO_RIGHT_M) & (state.lane < table.num_lanes)
    return np.where(near, side * GO_RIGHT_MPS2, 0.0)


def pull_over(
    state: State, table: RoadTable, config: DriverConfig, clock: float
) -> None:
    """Drivers at their destination leave the right lane, or give it up.

    They give up if they are not in the right lane in time or if somebody
    stands where they want to.
    """
    left = state.driver["destination"] - state.s
    on_strip = state.lane >= table.num_lanes
    reach = np.maximum(PULL_OVER_S * state.v, state.v**2 / (2.0 * PULL_OVER_MPS2))
    near = state.alive & ~on_strip & (left < np.maximum(PULL_OVER_M, reach))
    for r, slot in zip(*np.nonzero(near), strict=True):
        if state.phase[r, slot] < 1.0 or state.lane[r, slot] < table.num_lanes[r] - 1:
            state.driver["destination"][r, slot] = np.inf
            continue
        strip = on_strip[r] & state.alive[r]
        behind = state.s[r] > state.s[r, slot] - STRIP_CLEAR_M
        before = state.s[r] < state.driver["destination"][r, slot] + STRIP_CLEAR_M
        if np.any(strip & behind & before):
            state.driver["destination"][r, slot] = np.inf
        else:
            begin_change(state, r, slot, int(table.num_lanes[r, 0]), clock)
            on_strip[r, slot] = True
