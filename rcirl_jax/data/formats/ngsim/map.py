"""One site of NGSIM: rows in SI units, from a table or from minutes of it.

Lanes, the notes and whether there are lateral positions belong to the whole site;
`Survey` finds them, also where only a minute of rows is held at a time.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.declared import Rows
from rcirl_jax.data.formats.lanes import StraightLane, straight_lanes
from rcirl_jax.data.formats.options import number, positive
from rcirl_jax.data.formats.tracks import spans_of, split_tracks, travel_heading
from rcirl_jax.types import Kind, Lane, Recording, Track

SITE = "Location"
MAX_FRAME_GAP = 1  # frames; a larger gap starts a new track
REUSE_S = 60.0  # s; a step back by more is a number given to another vehicle
MARGIN_M = 50.0  # m of lane beyond the first and last position
SIZE_M = (4.5, 1.8)  # m, a car


class Survey:
    """What the Recordings of a site share, from its rows in any portions.

    Its memory grows with the different values of Local_X, not with the rows.
    """

    def __init__(self) -> None:
        self.lateral = False  # any lateral position
        self._without: dict[str, set[float]] = {"length": set(), "width": set()}
        # lane -> different Local_X and how often each is met; ends of Local_Y
        self._across: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._along: dict[int, tuple[float, float]] = {}

    def add(self, table: Rows) -> None:
        """Take in rows."""
        self.lateral |= bool(np.any(table["Local_X"] != 0.0))
        for field, users in self._without.items():
            users.update(table["id"][table[f"v_{field.title()}"] <= 0.0])
        driven = table["Lane_ID"].astype(int)
        for lane in np.unique(driven).tolist():
            x, y = (table[name][driven == lane] for name in ("Local_X", "Local_Y"))
            self._across[lane] = _counted(x, self._across.get(lane))
            lower, upper = self._along.get(lane, (np.inf, -np.inf))
            self._along[lane] = min(lower, float(y.min())), max(upper, float(y.max()))

    def notes(self) -> list[str]:
        """What was missing."""
        notes = []
        if not self.lateral:
            notes.append("no lateral positions; built from lane numbers")
        for field, users in self._without.items():
            if users:
                notes.append(f"{len(users)} vehicles without {field}; default by class")
        return notes

    def lanes(self, path: Path, spec: Mapping) -> tuple[Lane, ...]:
        """One straight lane per lane number, over where it was driven +- 50 m."""
        width = number(spec, "lane_width_m")
        found = [
            StraightLane(
                id=str(lane),
                y=-_median(*self._across[lane])
                if self.lateral
                else -width * (lane - 0.5),
                lower=lower - MARGIN_M,
                upper=upper + MARGIN_M,
            )
            for lane, (lower, upper) in sorted(self._along.items())
        ]
        lanes = straight_lanes(path, found, width, number(spec, "speed_limit"))
        guessed = not self.lateral
        return tuple(
            dataclasses.replace(lane, width_assumed=guessed or lane.width_assumed)
            for lane in lanes
        )


def _counted(
    values: np.ndarray, known: tuple[np.ndarray, np.ndarray] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Different values [m], sorted, and counts [m]; `known` ones added."""
    found, counts = np.unique(values, return_counts=True)
    if known is None:
        return found, counts
    both, place = np.unique(np.concatenate([known[0], found]), return_inverse=True)
    total = np.zeros(both.size, np.int64)
    np.add.at(total, place, np.concatenate([known[1], counts]))
    return both, total


def _median(values: np.ndarray, counts: np.ndarray) -> float:
    """`np.median` of values met `counts` times each."""
    ends = np.cumsum(counts)
    middle = np.array([(ends[-1] - 1) // 2, ends[-1] // 2])
    return float(np.mean(values[np.searchsorted(ends, middle, side="right")]))


def site_recording(
    path: Path,
    name: str,
    table: Rows,
    spec: dict,
    survey: Survey,
    *,
    stamped: bool,
    notes: list[str],
) -> Recording:
    """A Recording of some rows.

    Args:
      path: named in errors.
      name: of the Recording.
      table: rows of the site, all or of a minute, each vehicle once in a frame.
      spec: source TOML.
      survey: of the whole site.
      stamped: the clock is Global_Time; rows may come in any order.
      notes: of this Recording.
    """
    frame_s = positive(spec, "frame_s")
    # with stamps no step back has a meaning
    reuse = 0.0 if stamped else REUSE_S / frame_s
    vehicles = table["id"].astype(np.int64)
    pieces = split_tracks(path, vehicles, table["frame"], MAX_FRAME_GAP, reuse)
    lateral = survey.lateral
    table = {**table, "leader_missing": _leader_missing(table)}
    tracks = [_track(name, table, rows, spec, lateral) for name, rows in pieces]
    return Recording(
        name=name,
        source=spec["source"],
        licence=spec["licence"],
        rate_hz=1.0 / frame_s,
        tracks=tuple(tracks),
        lanes=survey.lanes(path, spec),
        default_speed_limit=number(spec, "speed_limit"),
        notes=tuple(notes),
    )


def _leader_missing(table: Rows) -> np.ndarray:
    """[n] bool: the row names a vehicle ahead that has no row at that time."""
    named = table["Preceding"] > 0.0
    users = np.concatenate([table["id"], table["Preceding"]])
    number = np.unique(users, return_inverse=True)[1].reshape(2, -1)
    frames = np.unique(table["frame"], return_inverse=True)[1].reshape(-1)
    own, ahead = number * (frames.max() + 1) + frames
    return named & ~np.isin(ahead, own)


def _track(
    name: str, table: Rows, rows: np.ndarray, spec: dict, lateral: bool
) -> Track:
    frame_s = positive(spec, "frame_s")
    sizes = spec.get("sizes", {})
    kind = str(int(table["v_Class"][rows[0]]))
    default = sizes.get(kind, sizes.get("0", SIZE_M))
    size = [float(table[column][rows[0]]) for column in ("v_Length", "v_Width")]
    length, width = (
        own or float(usual) for own, usual in zip(size, default, strict=True)
    )
    x = table["Local_Y"][rows] - 0.5 * length
    if lateral:
        y = -table["Local_X"][rows]
    else:
        y = _lateral_from_lanes(table["Lane_ID"][rows], spec)
    t = table["frame"][rows] * frame_s
    return Track(
        id=name,
        kind=Kind.VEHICLE,
        length=length,
        width=width,
        size_assumed=0.0 in size,
        t=t,
        x=x,
        y=y,
        heading=travel_heading(t, x, y),
        speed=table["v_Vel"][rows],
        leader_missing=spans_of(t, table["leader_missing"][rows]),
    )


def _lateral_from_lanes(lane: np.ndarray, spec: dict) -> np.ndarray:
    """Lane centres [n] m, each switch spread over `lane_switch_s`.

        y = y_0 + sum_k (y_k - y_{k-1}) S((t - t_k) / 4 s + 1/2),  S(u) = 3u^2 - 2u^3

    with t_k midway between the last sample in the old lane and the first in the
    new one.
    """
    width = number(spec, "lane_width_m")
    span = number(spec, "lane_switch_s") / positive(spec, "frame_s")
    y = np.full(lane.shape, -width * (lane[0] - 0.5))
    samples = np.arange(lane.size)
    for at in np.flatnonzero(np.diff(lane) != 0.0):
        u = np.clip((samples - at - 0.5) / max(span, 1e-9) + 0.5, 0.0, 1.0)
        y -= width * (lane[at + 1] - lane[at]) * u**2 * (3.0 - 2.0 * u)
    return y
