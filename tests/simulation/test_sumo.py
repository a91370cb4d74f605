"""Car following against SUMO's own IDM, an independent implementation.

Every pair drives alone on its own edge: the leader's speeds are those that our
script made it drive, the follower is free. SUMO runs with steps of 0.1 s, the
ballistic update, one IDM iteration a step and no dawdling, so both integrate
the same equation with the same step.
"""

import functools
import subprocess
from pathlib import Path

import numpy as np
import pytest

from rcirl_jax.simulation.cases import Case
from tests.simulation.drives import drive
from tests.simulation.worlds import make_case

libsumo = pytest.importorskip(
    "libsumo", reason="SUMO is not installed: pip install eclipse-sumo libsumo"
)

STEPS = 300
LENGTH = 4.6  # m, of every car
EDGE = 3000.0  # m
# largest differences from SUMO, over all steps and pairs
SPEED_TOLERANCE = 0.02  # m/s
POSITION_TOLERANCE = 0.05  # m

# IDM parameters of the follower, its start, and the leader's phases
# (start s, speed m/s, rate m/s^2)
PAIRS = (
    {"headway": 1.4, "standstill": 2.0, "acceleration": 1.4, "braking": 2.0,
     "desired": 15.0, "v": 12.0, "gap": 40.0, "lead": 10.0,
     "phases": [(0.0, 10.0, 2.0), (8.0, 5.0, 1.5), (18.0, 12.0, 1.0)]},
    {"headway": 1.0, "standstill": 1.0, "acceleration": 2.5, "braking": 3.0,
     "desired": 20.0, "v": 8.0, "gap": 12.0, "lead": 8.0,
     "phases": [(0.0, 16.0, 2.0), (12.0, 9.0, 3.0)]},
    {"headway": 2.0, "standstill": 4.0, "acceleration": 0.8, "braking": 1.2,
     "desired": 30.0, "v": 22.0, "gap": 70.0, "lead": 20.0,
     "phases": [(0.0, 20.0, 1.0), (5.0, 14.0, 1.0), (20.0, 22.0, 0.8)]},
    {"headway": 1.2, "standstill": 2.5, "acceleration": 1.8, "braking": 2.5,
     "desired": 13.0, "v": 13.0, "gap": 30.0, "lead": 11.0,
     "phases": [(0.0, 11.0, 2.0), (4.0, 0.0, 2.5), (16.0, 9.0, 1.5)]},
)  # fmt: skip
FOLLOWER_START = 100.0  # m, front bumper


def case_of(pair: dict) -> Case:
    names = ("headway", "standstill", "acceleration", "braking", "desired", "v")
    rear = FOLLOWER_START - 0.5 * LENGTH
    leader = {"s": rear + pair["gap"] + LENGTH, "v": pair["lead"],
              "phases": pair["phases"], "desired": 60.0, "reacts": False}  # fmt: skip
    follower = {"s": rear, **{name: pair[name] for name in names}}
    return make_case([leader, follower], speed=0.0)


@functools.cache
def ours() -> tuple[np.ndarray, np.ndarray]:
    """Fronts [m] and speeds [m/s], each [pairs, steps, (leader, follower)]."""
    _, shot = drive([case_of(pair) for pair in PAIRS], steps=STEPS)
    return shot.agents.s[:, :, :2] + 0.5 * LENGTH, shot.agents.v[:, :, :2]


def write_network(folder: Path) -> Path:
    """One straight edge of one lane for every pair."""
    import sumo

    nodes, edges = [], []
    for i in range(len(PAIRS)):
        nodes += [f'<node id="a{i}" x="0" y="{50 * i}"/>']
        nodes += [f'<node id="b{i}" x="{EDGE}" y="{50 * i}"/>']
        edges += [f'<edge id="e{i}" from="a{i}" to="b{i}" numLanes="1" speed="60"/>']
    (folder / "n.nod.xml").write_text(f"<nodes>{''.join(nodes)}</nodes>")
    (folder / "n.edg.xml").write_text(f"<edges>{''.join(edges)}</edges>")
    network = folder / "n.net.xml"
    subprocess.run(
        [Path(sumo.SUMO_HOME) / "bin" / "netconvert", "-n", folder / "n.nod.xml",
         "-e", folder / "n.edg.xml", "-o", network, "--xml-validation", "never"],
        check=True, capture_output=True, timeout=60,
    )  # fmt: skip
    return network


def write_routes(folder: Path) -> Path:
    """A leader and an IDM follower for every pair, departing at t = 0."""
    parts = []
    for i, pair in enumerate(PAIRS):
        parts.append(
            f'<vType id="lead{i}" length="{LENGTH}" maxSpeed="60" speedDev="0"/>'
            f'<vType id="idm{i}" carFollowModel="IDM" length="{LENGTH}" delta="4" '
            f'tau="{pair["headway"]}" minGap="{pair["standstill"]}" speedDev="0" '
            f'accel="{pair["acceleration"]}" decel="{pair["braking"]}" '
            f'emergencyDecel="8" maxSpeed="{pair["desired"]}"/>'
            f'<route id="r{i}" edges="e{i}"/>'
        )
    for i, pair in enumerate(PAIRS):
        ahead = FOLLOWER_START + pair["gap"] + LENGTH
        for name, kind, place, v in (
            (f"l{i}", f"lead{i}", ahead, pair["lead"]),
            (f"f{i}", f"idm{i}", FOLLOWER_START, pair["v"]),
        ):
            parts.append(
                f'<vehicle id="{name}" type="{kind}" route="r{i}" depart="0" '
                f'departPos="{place}" departSpeed="{v}" insertionChecks="none"/>'
            )
    path = folder / "n.rou.xml"
    path.write_text(f"<routes>{''.join(parts)}</routes>")
    return path


def run_sumo(folder: Path, leader_v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fronts and speeds as in `ours`; the leaders get the speeds [pairs, steps]."""
    command = [
        "sumo", "-n", str(write_network(folder)), "-r", str(write_routes(folder)),
        "--step-length", "0.1", "--step-method.ballistic", "true",
        "--no-step-log", "true", "--no-warnings", "true",
        "--xml-validation", "never", "--collision.action", "none",
        "--time-to-teleport", "-1",
    ]  # fmt: skip
    count = len(PAIRS)
    front, speed = np.zeros((2, count, STEPS, 2))
    libsumo.start(command)
    try:
        libsumo.simulationStep()  # the cars are inserted; t = 0 of our clock
        for i in range(count):
            libsumo.vehicle.setSpeedMode(f"l{i}", 0)
        for step in range(STEPS):
            for i in range(count):
                libsumo.vehicle.setSpeed(f"l{i}", float(leader_v[i, step]))
            libsumo.simulationStep()
            for i in range(count):
                for j, name in enumerate((f"l{i}", f"f{i}")):
                    front[i, step, j] = libsumo.vehicle.getLanePosition(name)
                    speed[i, step, j] = libsumo.vehicle.getSpeed(name)
    finally:
        libsumo.close()
    return front, speed


@pytest.fixture(scope="module")
def theirs(tmp_path_factory: pytest.TempPathFactory) -> tuple[np.ndarray, np.ndarray]:
    return run_sumo(tmp_path_factory.mktemp("sumo"), ours()[1][:, :, 0])


def test_the_follower_drives_as_sumos_idm_behind_the_same_leader(theirs):
    front, speed = ours()
    assert (np.ptp(speed[:, :, 1], axis=1) > 3.0).all()  # there is something to compare
    exact = {"rtol": 0.0}
    np.testing.assert_allclose(speed[..., 0], theirs[1][..., 0], atol=1e-3, **exact)
    np.testing.assert_allclose(front[..., 0], theirs[0][..., 0], atol=5e-3, **exact)
    for mine, other, most in ((speed, theirs[1], SPEED_TOLERANCE),
                              (front, theirs[0], POSITION_TOLERANCE)):  # fmt: skip
        np.testing.assert_allclose(mine[..., 1], other[..., 1], atol=most, **exact)
