"""Synthetic human traffic as an importer: TOML of recordings -> Recordings.

See data_specs/sources/synthetic.toml for every key. Each recording has random streams
of its entry's seed and its number in the entry; it is a group of its own.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from rcirl_jax.data.formats.options import USER_KEYS
from rcirl_jax.data.formats.synthetic.roads import ROADS, lanes, to_world
from rcirl_jax.data.formats.synthetic.traffic import (
    DRIVER,
    RunConfig,
    schedule,
    simulate,
)
from rcirl_jax.data.recording import LEAVE_OUT, validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.checked import check_names, checked
from rcirl_jax.runtime.specs import load_toml
from rcirl_jax.types import Kind, Recording, Signal, Track

MAX_RECORDINGS = 100_000  # of all entries
BATCH = 32  # recordings simulated together, at most
SEEN_FROM_M = 30.0  # m, tracks begin this far from the road's start
SEEN_UNTIL_M = 60.0  # m, and end this far before its end
MIN_TRACK_S = 1.0  # s, shorter tracks are dropped
POSITION_STREAM = 1  # last part of a seed: the stream of the position noise
TRAFFIC_STREAM = 0  # last part of a seed: the stream of the simulation

Text = Annotated[str, msgspec.Meta(min_length=1)]


class _File(msgspec.Struct, forbid_unknown_fields=True):
    """The TOML as it is written."""

    source: Text
    licence: Text
    rate_hz: Annotated[float, msgspec.Meta(ge=2.0, le=50.0)]
    warmup_s: Annotated[float, msgspec.Meta(ge=0.0, le=600.0)]
    position_noise_m: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
    drivers: dict[str, float | Annotated[list[float], msgspec.Meta(max_length=4)]]
    recordings: Annotated[list[dict], msgspec.Meta(min_length=1)]


class _Entry(msgspec.Struct, forbid_unknown_fields=True):
    """One of [[recordings]]."""

    road: str
    count: Annotated[int, msgspec.Meta(ge=1, le=10_000)]
    duration_s: Annotated[float, msgspec.Meta(ge=1.0, le=3600.0)]
    density_veh_per_km: Annotated[float, msgspec.Meta(ge=1.0, le=60.0)]
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """Yields all recordings that a TOML file declares.

    Args:
      path: the file, like data_specs/sources/synthetic.toml.
      spec: the packaged settings; what `path` does not set is taken from there.

    Raises:
      InputError: an unknown key or a bad value, before anything is simulated.
    """
    own = load_toml(path)
    # what an import adds says nothing here: none of these is refused
    packaged = {k: v for k, v in spec.items() if k not in (LEAVE_OUT, USER_KEYS)}
    settings = {**packaged, **own}
    if isinstance(own.get("drivers", {}), dict):
        settings["drivers"] = {**spec.get("drivers", {}), **own.get("drivers", {})}
    file = checked(settings, _File, path)
    drivers = _drivers(path, file.drivers)
    jobs = []  # (name, run) of every recording
    for number, row in enumerate(file.recordings, start=1):
        where = f"{path}: recordings[{number}]"
        entry = checked(row, _Entry, where)
        if entry.road not in ROADS:
            raise InputError(
                f"{where}: road: {entry.road}: expected one of {', '.join(ROADS)}"
            )
        if len(jobs) + entry.count > MAX_RECORDINGS:
            raise InputError(
                f"{where}: count: {entry.count} after {len(jobs)}: "
                f"expected up to {MAX_RECORDINGS} of all entries"
            )
        for index in range(entry.count):
            run = RunConfig(
                road=entry.road,
                duration_s=entry.duration_s,
                density_veh_per_km=entry.density_veh_per_km,
                seed=(entry.seed, index, TRAFFIC_STREAM),
                rate_hz=file.rate_hz,
                warmup_s=file.warmup_s,
            )
            jobs.append((f"{entry.road}-{number:02d}-{index:03d}", run))
    return (
        dataclasses.replace(validate_recording(made), progress=number / len(jobs))
        for number, made in enumerate(_simulated(jobs, drivers, file), start=1)
    )


def _drivers(
    path: Path, found: Mapping[str, float | list[float]]
) -> dict[str, list[float]]:
    """Returns every driver's parameter as [number], [low, high] or four numbers."""
    check_names(f"{path}: drivers: ", found, list(DRIVER))
    made = {}
    for name, (least, most) in DRIVER.items():
        value = found.get(name, [])
        made[name] = numbers = value if isinstance(value, list) else [value]
        bounds = numbers[-2:]
        good = len(numbers) in (1, 2, 4) and least <= bounds[0] <= bounds[-1]
        if not good or not all(0.0 <= x <= most for x in numbers):
            raise InputError(
                f"{path}: drivers: {name}: {value}: expected a number, [low, high] or "
                f"[mean, sd, low, high], within {least:g} to {most:g}"
            )
    return made


def _simulated(
    jobs: list[tuple[str, RunConfig]], drivers: dict[str, list[float]], file: _File
) -> Iterator[Recording]:
    """Simulates neighbours of equal duration together, in the declared order."""
    for _, alike in itertools.groupby(jobs, key=lambda job: job[1].duration_s):
        while batch := list(itertools.islice(alike, BATCH)):
            samples, offsets = simulate([run for _, run in batch], drivers)
            for number, (name, run) in enumerate(batch):
                of = samples["recording"] == number
                own = {key: values[of] for key, values in samples.items()}
                yield _recording(name, run, own, offsets[number], file)


def _recording(
    name: str,
    run: RunConfig,
    samples: dict[str, np.ndarray],
    offsets: np.ndarray,
    file: _File,
) -> Recording:
    """Returns a simulated recording; `name` is also its group."""
    road = ROADS[run.road]
    rng = np.random.default_rng((*run.seed[:-1], POSITION_STREAM))
    seen = (samples["s"] > SEEN_FROM_M) & (samples["s"] < road.length - SEEN_UNTIL_M)
    tracks = []
    for number in np.unique(samples["number"][seen]).tolist():
        rows = np.flatnonzero(samples["number"] == number)
        # where the car stands, or wants to stand, on the strip
        place = to_world(
            road,
            samples["destination"][rows[-1:]].clip(max=road.length),
            road.offset(road.num_lanes),
            np.zeros(1),
        )
        held = np.isfinite(samples["destination"][rows[-1]])
        rows = rows[seen[rows]]
        if rows.size < MIN_TRACK_S * run.rate_hz:
            continue
        s, l, slope = (samples[key][rows] for key in ("s", "l", "slope"))
        x, y, heading = to_world(road, s, l, slope)
        shift = file.position_noise_m * rng.standard_normal((2, rows.size))
        track = Track(
            id=f"v{number:04d}",
            kind=Kind.VEHICLE,
            length=float(samples["car_length_m"][rows[0]]),
            width=float(samples["car_width_m"][rows[0]]),
            t=samples["t"][rows],
            x=x + shift[0],
            y=y + shift[1],
            heading=heading,
            speed=samples["v"][rows],
            destination=(float(place[0][0]), float(place[1][0])) if held else None,
        )
        tracks.append(track)
    signals = []
    for index, offset in enumerate(offsets.tolist()):
        start, state = schedule(offset, run.duration_s)
        signals.append(Signal(id=f"signal-{index}", start=start, state=state))
    return Recording(
        name=name,
        source=file.source,
        licence=file.licence,
        rate_hz=run.rate_hz,
        tracks=tuple(tracks),
        lanes=lanes(road),
        signals=tuple(signals),
        group=name,
        default_speed_limit=float(road.limit[0]),
        notes=(f"simulated: {run.road}, seed {run.seed}",),
    )
