"""Synthetic human traffic as an importer: TOML of recordings -> Recordings.

See data_specs/sources/synthetic.toml for every key. Each recording has its own
random streams, made of its entry's seed and its number in the entry; it is a
vehicle-disjoint group of its own.
"""

import dataclasses
import itertools
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from rcirl_jax.data.formats.options import USER_KEYS
from rcirl_jax.data.formats.synthetic.roads import ROADS, lanes, to_world
from rcirl_jax.data.formats.synthetic.traffic import (
    DriverConfig,
    Log,
    RunConfig,
    schedule,
    simulate,
)
from rcirl_jax.data.recording import LEAVE_OUT, validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.checked import check_names, checked
from rcirl_jax.runtime.specs import load_toml
from rcirl_jax.types import Kind, Recording, Signal, Track

# driver settings that may be zero; all others are above it
MAY_BE_ZERO = (
    "delay_s",
    "noise_mps2",
    "politeness",
    "threshold_mps2",
    "change_pause_s",
    "drift_m",
    "sign_wait_s",
    "destination_share",
)
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
    drivers: dict
    recordings: Annotated[list[dict], msgspec.Meta(min_length=1)]


class _Entry(msgspec.Struct, forbid_unknown_fields=True):
    """One of [[recordings]]."""

    road: str
    count: Annotated[int, msgspec.Meta(ge=1, le=10_000)]
    duration_s: Annotated[float, msgspec.Meta(ge=1.0, le=3600.0)]
    density_veh_per_km: Annotated[float, msgspec.Meta(ge=1.0, le=60.0)]
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """Yield all recordings that a TOML file declares.

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
    settings["drivers"] = {**_table(spec, "drivers"), **_table(own, "drivers")}
    checked(settings, _File, path)
    drivers = driver_config(path, settings["drivers"])
    jobs = []  # (name, run) of every recording
    for number, row in enumerate(settings["recordings"], start=1):
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
                rate_hz=float(settings["rate_hz"]),
                warmup_s=float(settings["warmup_s"]),
            )
            jobs.append((f"{entry.road}-{number:02d}-{index:03d}", run))
    return (
        dataclasses.replace(validate_recording(made), progress=number / len(jobs))
        for number, made in enumerate(_simulated(jobs, drivers, settings), start=1)
    )


def _table(spec: dict, key: str) -> dict:
    value = spec.get(key, {})
    return value if isinstance(value, dict) else {key: value}


def driver_config(path: Path, found: dict) -> DriverConfig:
    """The drivers that a TOML's `drivers` table describes; InputError names a key."""
    fields = [field.name for field in dataclasses.fields(DriverConfig)]
    check_names(f"{path}: drivers: ", found, fields)
    made = checked(found, DriverConfig, f"{path}: drivers")
    for key, value in vars(made).items():
        # a number, [low, high] or [mean, sd, low, high]; the sd may be zero
        numbers = value if isinstance(value, tuple) else (value,)
        bounds = numbers[-2:]
        least = 0.0 if key in MAY_BE_ZERO else sys.float_info.min
        most = 1.0 if key == "destination_share" else sys.float_info.max
        good = least <= bounds[0] <= bounds[-1] <= most
        if not good or not all(0.0 <= x <= most for x in numbers):
            sign = ">= 0" if key in MAY_BE_ZERO else "> 0"
            raise InputError(
                f"{path}: drivers: {key}: {value}: expected {sign}, low <= high"
                + (", at most 1" if most == 1.0 else "")
            )
    return made


def _simulated(
    jobs: list[tuple[str, RunConfig]], drivers: DriverConfig, settings: dict
) -> Iterator[Recording]:
    """Simulate neighbours of equal duration together, in the declared order."""
    for _, alike in itertools.groupby(jobs, key=lambda job: job[1].duration_s):
        while batch := list(itertools.islice(alike, BATCH)):
            logs = simulate([run for _, run in batch], drivers)
            for (name, run), log in zip(batch, logs, strict=True):
                yield _recording(name, run, log, settings)


def _recording(name: str, run: RunConfig, log: Log, settings: dict) -> Recording:
    """Return a simulated log as a Recording; `name` is also its group."""
    road, noise = log.road, float(settings["position_noise_m"])
    rng = np.random.default_rng((*run.seed[:-1], POSITION_STREAM))
    seen = log.vehicle >= 0
    seen &= (log.s > SEEN_FROM_M) & (log.s < road.length - SEEN_UNTIL_M)
    tracks = []
    for number in np.unique(log.vehicle[seen]).tolist():
        times, slots = np.nonzero(seen & (log.vehicle == number))
        if times.size < MIN_TRACK_S * run.rate_hz:
            continue
        driver = log.drivers[number]
        s, l, slope, v = (x[times, slots] for x in (log.s, log.l, log.slope, log.v))
        x, y, heading = to_world(road, s, l, slope)
        shift = noise * rng.standard_normal((2, times.size))
        # where the car stands, or wants to stand, on the strip
        station, destination = float(driver["destination"]), None
        if math.isfinite(station):
            strip = road.offset(road.num_lanes)
            place = to_world(road, np.array(station), strip, np.array(0.0))
            destination = float(place[0]), float(place[1])
        track = Track(
            id=f"v{number:04d}",
            kind=Kind.VEHICLE,
            length=float(driver["length"]),
            width=float(driver["width"]),
            t=times / run.rate_hz,
            x=x + shift[0],
            y=y + shift[1],
            heading=heading,
            speed=v,
            destination=destination,
        )
        tracks.append(track)
    signals = []
    for index, stop in enumerate(road.stops):
        if not stop.is_sign:
            offset = float(log.signal_offset[index])
            start, state = schedule(road.cycle, offset, run.duration_s)
            signals.append(Signal(id=f"signal-{index}", start=start, state=state))
    return Recording(
        name=name,
        source=settings["source"],
        licence=settings["licence"],
        rate_hz=run.rate_hz,
        tracks=tuple(tracks),
        lanes=lanes(road),
        signals=tuple(signals),
        group=name,
        default_speed_limit=float(road.limit[0]),
        notes=(f"simulated: {run.road}, seed {run.seed}",),
    )
