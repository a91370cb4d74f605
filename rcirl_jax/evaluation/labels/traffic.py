"""Automatic labels against simulated drivers, whose own state is the truth.

`made_traffic` says what the drivers did, `reactions` what they wanted.
"""

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.synthetic.reader import (
    SEEN_FROM_M,
    SEEN_UNTIL_M,
    driver_config,
    to_recording,
)
from rcirl_jax.data.scenes.collect import Collector
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.synthetic import RunConfig, simulate
from rcirl_jax.data.synthetic.roads import GRID_M
from rcirl_jax.data.synthetic.traffic import Log
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.labels.made_traffic import (
    Drive,
    cuts_in,
    decision,
    drive_of,
    is_single,
    line_decision,
    motion_tags,
    red_light,
    tags_of_decisions,
)
from rcirl_jax.evaluation.labels.noise import NOISES, check_noise, position_errors
from rcirl_jax.evaluation.labels.reactions import arrival
from rcirl_jax.evaluation.labels.scores import LabelReport, Verdict, count_verdicts
from rcirl_jax.runtime.executors import Executor, Here
from rcirl_jax.runtime.specs import load_toml, spec_root
from rcirl_jax.types import Decision, Recording, Tag
from rcirl_jax.units import HORIZON_S, TIMES_S

COLLECT = CollectConfig(
    stride_s=HORIZON_S,  # windows of one driver do not overlap
    require_obstacles=False,
    require_speed_change=False,
)
STREAM = 2  # last part of a seed: these recordings are nobody's training data
NEAR_M = 60.0  # m along the road within which others are surely in the scene
FAR_M = 300.0  # m, farther ones have no say in a tag
BEND = 0.003  # 1/m, in sharper bends speeds along parallel lanes differ

# --------------------------------------------------------------------- scenes


def judge(recording: Recording, log: Log) -> Iterator[list[Verdict] | str]:
    """Verdicts of every scene of a recording, or why a frame was dropped."""
    collector = Collector(recording, COLLECT)
    numbers = [int(track.id[1:]) for track in collector.recording.tracks]
    for row in collector.scenes():
        first = int(row["frame"])
        seconds = TIMES_S[row["time_valid"]][-1]
        window = slice(first, first + int(round(seconds * recording.rate_hz)) + 1)
        ego = drive_of(log, numbers[row["track"]], window)
        if ego is not None and is_single(ego.lanes[0]):
            yield _verdicts(recording, log, row, ego, window, numbers)
    for reason, count in collector.dropped.items():
        yield from [reason] * count


def _verdicts(
    recording: Recording,
    log: Log,
    row: dict,
    ego: Drive,
    window: slice,
    numbers: list[int],
) -> list[Verdict]:
    place, rate = recording.name.rsplit("-", 1)[0], recording.rate_hz
    slots = {numbers[t]: i for i, t in enumerate(row["obstacles.track"]) if t >= 0}
    truth: dict[int, Decision | None] = {}
    cut_ins: dict[int, bool | None] = {}
    found: list[Verdict] = []
    own = numbers[row["track"]]
    settled = _stays(log, own, window, ego)
    present = np.unique(log.vehicle[window])
    for number in present[present >= 0].tolist():
        if number == own or not _is_near(log, number, window, ego, FAR_M):
            continue
        other = drive_of(log, number, window)
        known = settled and other is not None and _is_known(log, ego, other)
        came = arrival(log, own, number, window, rate) if other else None
        what = decision(ego, other, rate, came) if other and known else None
        truth[number], cut_ins[number] = what, cuts_in(ego, other, rate, came)
        is_near = other is not None and abs(other.s[0] - ego.s[0]) < NEAR_M
        if what is not None and (number in slots or is_near):
            label = _label(row, slots, number)
            found.append(("decision", place, what.name, label.name))
    through = _is_through(log, row, numbers, ego)
    line = line_decision(log, ego, rate) if through else None
    if line is not None:
        found.append(("decision", place, line.name, _line_label(row).name))
    made = set(truth.values())
    tags = motion_tags(log, ego) | tags_of_decisions(made, complete=None not in made)
    entered = set(cut_ins.values())
    tags[Tag.CUT_IN] = True if True in entered else None if None in entered else False
    tags[Tag.RED_LIGHT] = red_light(log, ego, window.start / rate)
    for tag, value in tags.items():
        if value is not None:
            names = [tag.name if is_so else "" for is_so in (value, row["tags"][tag])]
            found.append(("tag", place, names[0], names[1]))
    return found


def _is_near(log: Log, number: int, window: slice, ego: Drive, reach: float) -> bool:
    rows, slots = np.nonzero(log.vehicle[window] == number)
    return bool(np.any(np.abs(log.s[window][rows, slots] - ego.s[rows]) < reach))


def _stays(log: Log, number: int, window: slice, ego: Drive) -> bool:
    """The driver keeps after the window to the lane in which it ends.

    The labels know the way that the driver took later, and so who was in it.
    """
    slot = np.flatnonzero(log.vehicle[window.start] == number)[0]
    rest = slice(window.stop, None)
    later = (log.vehicle[rest, slot] == number) & (log.s[rest, slot] < ego.s[0] + FAR_M)
    return bool(np.all(log.lanes[rest, slot][later] == ego.lanes[-1]))


def _is_known(log: Log, ego: Drive, other: Drive) -> bool:
    """The other is recorded from the frame on, or never in the driver's lanes.

    Not where parallel lanes differ in length, in bends.
    """
    if not np.any(ego.lanes & other.lanes):
        index = np.clip((ego.s / GRID_M).astype(int), 0, log.road.kappa.size - 1)
        return not np.any(np.abs(log.road.kappa[index]) > BEND)
    return SEEN_FROM_M < other.s[0] < log.road.length - SEEN_UNTIL_M


def _is_through(log: Log, row: dict, numbers: list[int], ego: Drive) -> bool:
    """The driver has no place to stop at within the scene's reach."""
    goal = float(log.drivers[numbers[row["track"]]]["destination"])
    return not ego.s[0] - 10.0 < goal < ego.s[0] + FAR_M


def _label(row: dict, slots: dict[int, int], number: int) -> Decision:
    if number not in slots:
        return Decision.IGNORE
    return Decision(row["decisions"][slots[number]])


def _line_label(row: dict) -> Decision:
    """STOP if any line is labelled so."""
    stops = row["decisions"] == Decision.STOP
    return Decision.STOP if stops.any() else Decision.IGNORE


# -------------------------------------------------------------------- measure


def measure_traffic(
    recordings: int,
    noise: str = "ngsim",
    seed: int = 0,
    roads: Sequence[str] = (),
    executor: Executor | None = None,
) -> LabelReport:
    """Simulate, label as an import would, compare with what the drivers did.

    Args:
      recordings: of each entry of data_specs/sources/synthetic.toml, at least 1.
      noise: key of `NOISES`, of the positions.
      seed: of the traffic and the noise.
      roads: those of the entries that are used; empty: all.
      executor: where it is done; default: this process.

    Raises:
      InputError: no recordings, an unknown noise or road.
    """
    if recordings < 1:
        raise InputError(f"--traffic: {recordings}: expected at least 1")
    check_noise(noise)
    known = [entry["road"] for entry in load_toml(_spec_path())["recordings"]]
    if unknown := [road for road in roads if road not in known]:
        raise InputError(f"roads: {unknown[0]}: expected of {', '.join(set(known))}")
    entries = [i for i, road in enumerate(known) if road in (roads or known)]
    items = [(entry, i) for entry in entries for i in range(recordings)]
    work = functools.partial(_judged, noise=noise, seed=seed)
    judged = (executor or Here()).stream(work, items)
    return count_verdicts(judged, noise)


def _spec_path() -> Path:
    return spec_root() / "sources" / "synthetic.toml"


def _judged(
    item: tuple[int, int], noise: str, seed: int
) -> Iterator[list[Verdict] | str]:
    """`judge` of one simulated recording; independent of the others."""
    number, index = item
    spec = load_toml(_spec_path())
    entry = spec["recordings"][number]
    run = RunConfig(
        road=entry["road"],
        duration_s=float(entry["duration_s"]),
        density_veh_per_km=float(entry["density_veh_per_km"]),
        seed=(seed, number, index, STREAM),
        rate_hz=float(spec["rate_hz"]),
        warmup_s=float(spec["warmup_s"]),
    )
    log = simulate([run], driver_config(_spec_path(), spec["drivers"]))[0]
    settings = {**spec, "position_noise_m": 0.0}
    made = to_recording(f"{run.road}-{index}", run, log, settings)
    rng = np.random.default_rng((*run.seed, 1))
    return judge(_noisy(made, NOISES[noise], rng), log)


def _noisy(
    recording: Recording, noise: tuple[float, float], rng: np.random.Generator
) -> Recording:
    """The recording with errors of its positions."""
    tracks = []
    for track in recording.tracks:
        driven = np.cumsum(track.speed > 0.3) / recording.rate_hz
        dx, dy = position_errors(driven, noise, rng)
        tracks.append(dataclasses.replace(track, x=track.x + dx, y=track.y + dy))
    return dataclasses.replace(recording, tracks=tuple(tracks))
