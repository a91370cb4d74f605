"""NGSIM I-80 leader-follower pairs: one CSV per pair, in FEET.

Columns t, x_follower, v_follower, a_follower, x_leader, v_leader, a_leader,
leader_length, spacing, dv; t in s, x of the front bumper along the road, spacing
between the follower's front and the leader's rear. Taken from the re-extracted
NGSIM set of T. Zhang, P. Jin et al. (arXiv 2201.04755), folder cf_ngsim_I80.

Traps: files share vehicles and some hold the same pair twice (run, follower and
leader stand in the file name ..._fF_lL_NNNNN.csv), so pairs that share a vehicle
are one group; the follower's own length is known only where it leads in another
file; there is no lateral position and no lane; whom the leader follows is not in
the file (a MissingAgent ahead says so, and its scenes are dropped).
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rcirl_jax.data.formats.declared import open_log, read_log
from rcirl_jax.data.formats.files import files_below
from rcirl_jax.data.formats.lanes import StraightLane, straight_lanes
from rcirl_jax.data.formats.options import (
    UNITS,
    number,
    one_of,
    one_pattern,
    positive,
    section,
)
from rcirl_jax.data.formats.tracks import split_tracks
from rcirl_jax.data.readers.tables.rows import LINE, Rows, attach_row_stats
from rcirl_jax.data.readers.tables.table import open_table
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, MissingAgent, Recording, Track

NEEDED = {
    **{"t": "time", "x_follower": "place", "v_follower": "speed"},
    **{"x_leader": "place", "v_leader": "speed", "leader_length": "number"},
}
OPTIONAL = {"spacing": "number"}
PLACES = ("x_follower", "x_leader")
NAME = re.compile(r"(?P<run>.*?)_?f(?P<follower>\d+)_l(?P<leader>\d+)(_\d+)?")
MAX_GAP_FRAMES = 5.5  # frames missing inside one track
MARGIN_M = 50.0  # m of lane beyond the first and last position
SPACING_FT = 0.5  # tolerance of spacing against the positions


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """Yields one Recording of two cars per file."""
    files = files_below(path, one_pattern(spec))
    groups = _groups(files)
    lengths = _leader_lengths(files, section(spec, "table"))
    for file in files:
        table, stats = open_log(file, spec)
        follower = _ids(file)[1]
        options = {"user": None, "places": PLACES, "name_of": lambda _, n=follower: n}
        rows = read_log(table, stats, NEEDED, OPTIONAL, **options)
        made = _recording(file, spec, rows, groups[file], lengths)
        yield validate_recording(attach_row_stats(made, stats), file)


def _ids(path: Path) -> tuple[str, str, str]:
    """(run, follower, leader) by the file's name."""
    match = NAME.fullmatch(path.stem)
    if match is None:
        return path.stem, "follower", "leader"
    return match["run"], match["follower"], match["leader"]


def _groups(files: Sequence[Path]) -> dict[Path, str]:
    """Vehicle-disjoint group of each file: files that share a car are joined."""
    cars = [[(run, car) for car in pair] for run, *pair in map(_ids, files)]
    every = dict.fromkeys(car for pair in cars for car in pair)
    numbers = {car: number for number, car in enumerate(every)}
    edges = np.array([[numbers[car] for car in pair] for pair in cars]).T
    graph = coo_array((np.ones(len(files)), edges), shape=(len(numbers),) * 2)
    labels = connected_components(graph, directed=False)[1][edges[0]]
    first = dict(zip(labels[::-1], files[::-1], strict=True))
    return {file: first[n].stem for file, n in zip(files, labels, strict=True)}


def _leader_lengths(
    files: Sequence[Path], options: Mapping
) -> dict[tuple[str, str], float]:
    """(run, car) -> length in the files' unit, of every car that leads somewhere."""
    lengths = {}
    for file in files:
        run, _, leader = _ids(file)
        try:
            length = float(open_table(file, options).samples("leader_length")[0])
        except (InputError, ValueError, IndexError):
            continue  # reported when the file itself is read
        if np.isfinite(length):
            lengths[run, leader] = length
    return lengths


def _recording(
    path: Path,
    spec: dict,
    rows: Rows,
    group: str,
    lengths: dict[tuple[str, str], float],
) -> Recording:
    factor = UNITS[one_of(spec, "unit", ("ft", "m"))]
    run, follower, leader = _ids(path)
    length = float(np.median(rows["leader_length"]))
    if "spacing" in rows:  # positions are those of front bumpers
        gap = rows["x_leader"] - rows["x_follower"] - length
        wrong = np.flatnonzero(np.abs(gap - rows["spacing"]) > SPACING_FT)
        if wrong.size:
            row = int(wrong[0])
            raise InputError(
                f"{path}: line {rows[LINE][row]}: spacing: {rows['spacing'][row]:g}: "
                f"expected {gap[row]:g}, x_leader - x_follower - leader_length"
            )
    own = lengths.get((run, follower))
    notes = ["no lateral positions; both cars on one straight lane"]
    if own is None:
        own = number(spec, "follower_length_m") / factor
        notes.append(f"length of follower {follower} unknown; default")
    rate = positive(spec, "rate_hz")
    # t is rounded to the clock: it is written with the noise of floating point
    frames = np.round((rows["t"] - rows["t"].min()) * rate)
    pieces = split_tracks(path, np.zeros(frames.size, int), frames, MAX_GAP_FRAMES)
    cars = ("follower", follower, own), ("leader", leader, length)
    tracks = tuple(
        Track(
            id=name + part.removeprefix("0"),
            kind=Kind.VEHICLE,
            length=size * factor,
            width=number(spec, "width_m"),
            size_assumed=True,  # no file says a width
            t=frames[at] / rate,
            x=(rows[f"x_{role}"][at] - 0.5 * size) * factor,
            y=np.zeros(at.shape),
            heading=np.zeros(at.shape),
            speed=rows[f"v_{role}"][at] * factor,
        )
        for role, name, size in cars
        for part, at in pieces
    )
    limit = number(spec, "speed_limit")
    lane = StraightLane(
        id="1",
        y=0.0,
        lower=min(float(track.x.min()) for track in tracks) - MARGIN_M,
        upper=max(float(track.x.max()) for track in tracks) + MARGIN_M,
    )
    last, end = max(float(track.t[-1]) for track in tracks), (lane.upper, 0.0)
    return Recording(
        name=path.stem,
        source=spec["source"],
        licence=spec["licence"],
        rate_hz=rate,
        tracks=tracks,
        lanes=straight_lanes(path, [lane], number(spec, "lane_width_m"), limit),
        group=group,
        # somebody ahead of both cars all the time
        missing_agents=(MissingAgent(t0=0.0, t1=last, start=end, end=end),),
        default_speed_limit=limit,
        notes=tuple(notes),
    )
