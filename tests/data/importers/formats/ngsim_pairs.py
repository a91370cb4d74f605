"""NGSIM leader-follower pairs: front bumpers, in feet, ids in the file names."""

import dataclasses

import numpy as np

from tests.data.importers.formats import Fixture, cell
from tests.data.importers.formats.drives import straight

FOOT = 0.3048  # m
STEM = "ngsim_final_I80_trajectories-0400pm-0415pm_runfinal_I80_trajectories"
COLUMNS = (
    *("t", "x_follower", "v_follower", "a_follower", "x_leader", "v_leader"),
    *("a_leader", "leader_length", "spacing", "dv"),
)
T0 = 293.2  # s
T = np.arange(250) * 0.1
LENGTHS_FT = {"1025": 14.3, "1032": 15.2, "1040": 14.8}
# follower, leader, number in the file name
PAIRS = (("1032", "1025", "00046"), ("1040", "1032", "00012"))


def stations():
    """Car -> (front [n] ft, speed [n] ft/s); they slow down and speed up again."""
    speed = 30.0 + 8.0 * np.cos(0.25 * T)
    s = 30.0 * T + 32.0 * np.sin(0.25 * T)
    return {
        name: (300.0 - 70.0 * place + s, speed)
        for place, name in enumerate(("1025", "1032", "1040"))
    }


def pair_name(follower, leader, number):
    """File name of a pair."""
    return f"{STEM}-0400pm-0415pm_f{follower}_l{leader}_{number}.csv"


def write_pair(folder, follower, leader, number):
    """One CSV."""
    (xf, vf), (xl, vl) = stations()[follower], stations()[leader]
    length = LENGTHS_FT[leader]
    zero = np.zeros(T.shape)
    columns = [
        T0 + T,
        xf,
        vf,
        zero,
        xl,
        vl,
        zero,
        zero + length,
        xl - xf - length,
        vf - vl,
    ]
    rows = [
        ",".join(repr(float(v)) for v in cells) for cells in zip(*columns, strict=True)
    ]
    path = folder / pair_name(follower, leader, number)
    path.write_text("\n".join([",".join(COLUMNS), *rows]) + "\n")
    return path


def car(name, length):
    """A car in SI; its box reaches back from the front bumper."""
    front, speed = stations()[name]
    user = straight(T, (0.0, 0.0), 0.0, 0.0, size=(length, 1.8))
    return dataclasses.replace(user, x=front * FOOT - 0.5 * length, speed=speed * FOOT)


def write(folder):
    """Two pairs that share a car, and the manifest that is no log."""
    files = tuple(write_pair(folder, *pair) for pair in PAIRS)
    (folder / "manifest.csv").write_text("file,follower,leader\nx,1,2\n")
    lengths = {"1025": 14.3 * FOOT, "1032": 15.2 * FOOT, "1040": 4.5}
    return Fixture(
        input=folder,
        assumed=(0, 2, 4),  # no file says a width
        rate_hz=10.0,
        tracks={name: car(name, length) for name, length in lengths.items()},
        num_lanes=1,
        files=files,
        drops_rows=True,
        numbers=dict.fromkeys(files, cell(COLUMNS.index("x_follower"))),
    )
