"""Automatic labels against simulated drivers, whose own state is the truth.

The drivers of `data.synthetic` follow, change lanes and stop by their own models. What
they did is read from their lanes, stations and speeds without noise; nothing
here reads `data/labels.py`, whose rules were made before; one error in them was found
and corrected by it (a lead that drives out of view).
With E and O the lanes of the labelled driver and of another car over the window,
and "ahead" of box before box:

    E steady, O the same lane all the time, ahead            follow; behind: ignore
    E steady, O leaves that lane after FOLLOWED_S, ahead     follow; behind: ignore
    E steady, O comes into it, ahead                         yield (and a cut-in)
    E steady, O comes into it, behind                        overtake
    E changes lane, O stays in the old one, is passed        overtake
    E changes lane, O was ahead in the new one, is passed    overtake
    never a common lane, passed slowly and near              nudge; else ignore

All else is left unscored, as is what lies near the edge of a definition.
"""

import collections
import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import tqdm

from rcirl_jax.data.collect import Collector
from rcirl_jax.data.config import CollectConfig
from rcirl_jax.data.importers.synthetic import (
    SEEN_FROM_M,
    SEEN_UNTIL_M,
    driver_config,
    to_recording,
)
from rcirl_jax.data.synthetic import RunConfig, simulate
from rcirl_jax.data.synthetic.roads import GRID_M
from rcirl_jax.data.synthetic.stops import schedule
from rcirl_jax.data.synthetic.traffic import Log
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.label_cases import NOISES, clear, position_errors
from rcirl_jax.evaluation.label_scores import LabelReport, Verdict, report
from rcirl_jax.executor import Executor, Here
from rcirl_jax.specs import load_toml, spec_root
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
CLEAR_M = 1.0  # m between bumpers beyond doubt
FOLLOWED_S = 2.5  # s in the way beyond doubt for a followed car (rule: 2 s)
COMES_M = 55.0  # m, who comes into the lane farther away is not scored
ENTERS_S = 1.0  # s after the frame from which coming into the lane counts
NUDGE_M = (2.7, 3.3)  # m beside: surely near, surely not (rule: 3 m)
SLOWER_MPS = (2.4, 1.6)  # m/s: surely passed, surely not (rule: 2 m/s)
PASSING_S = 0.7  # s of it, so that one of the times of the scene sees it
BEND = 0.003  # 1/m, in sharper bends speeds along parallel lanes differ
STANDS_MPS = 0.05  # m/s, beyond doubt
ROLLS_MPS = 1.0  # m/s, surely not standing
STANDS_S = 1.0  # s
AT_LINE_M = (-0.5, 8.0)  # m from front to line: surely waiting at it
OFF_LINE_M = 15.0  # m: surely not
LINE_SEEN_M = (60.0, 160.0)  # m to a red light: surely in the scene, surely not
AMBER_S = 0.5  # s around a light's change without a word on the tag


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Drive:
    """One car at all samples of a window; arrays [m]."""

    s: np.ndarray  # m
    l: np.ndarray  # m
    v: np.ndarray  # m/s
    lanes: np.ndarray  # bit masks
    length: float  # m
    width: float  # m

    @property
    def is_steady(self) -> bool:
        """In one lane all the time."""
        return _is_single(self.lanes[0]) and bool(np.all(self.lanes == self.lanes[0]))

    @property
    def changes(self) -> bool:
        """Begins and ends one change of lane inside the window."""
        first, last = self.lanes[0], self.lanes[-1]
        between = np.isin(self.lanes, (first, first | last, last)).all()
        return (
            bool(between) and _is_single(first) and _is_single(last) and last != first
        )


def _is_single(mask: int) -> bool:
    return mask > 0 and mask & (mask - 1) == 0


def _drive(log: Log, number: int, window: slice) -> _Drive | None:
    """A vehicle over a window, or None if it is not there all the time."""
    slots = np.flatnonzero(log.vehicle[window.start] == number)
    if slots.size == 0 or np.any(log.vehicle[window, slots[0]] != number):
        return None
    s, l, v, lanes = (x[window, slots[0]] for x in (log.s, log.l, log.v, log.lanes))
    driver = log.drivers[number]
    length, width = float(driver["length"]), float(driver["width"])
    return _Drive(s=s, l=l, v=v, lanes=lanes, length=length, width=width)


# ----------------------------------------------------------------- decisions


def decision(ego: _Drive, other: _Drive, rate_hz: float) -> Decision | None:
    """What the driver decided about the other (module docstring); None: unscored."""
    apart = other.s - ego.s
    half = 0.5 * (ego.length + other.length)
    common = (ego.lanes & other.lanes) != 0
    if not common.any():
        return _beside(ego, other, rate_hz)
    if ego.is_steady:
        return _in_lane(common, apart, half, other, rate_hz)
    if ego.changes and other.is_steady:
        was_old = other.lanes[0] == ego.lanes[0]
        behind = apart < -half - CLEAR_M
        if apart[0] > half + CLEAR_M and behind[-1]:
            return Decision.OVERTAKE
        return Decision.IGNORE if was_old and behind.all() else None
    return None


def _in_lane(
    common: np.ndarray, apart: np.ndarray, half: float, other: _Drive, rate_hz: float
) -> Decision | None:
    """About somebody who is in a steady driver's lane, or comes or goes."""
    ahead, behind = apart > half + CLEAR_M, apart < -half - CLEAR_M
    stays = other.is_steady
    goes = other.changes and bool(common[0])
    enters = int(np.argmax(common))
    comes = other.changes and bool(common[-1]) and enters >= ENTERS_S * rate_hz
    near = abs(apart[enters]) < COMES_M and abs(apart[0]) < COMES_M
    if behind[common].all():
        if stays or goes:
            return Decision.IGNORE
        return Decision.OVERTAKE if comes and near else None
    if not ahead[common].all():
        return None
    alone = np.count_nonzero(other.lanes == other.lanes[0])
    if stays or (goes and alone >= FOLLOWED_S * rate_hz):
        return Decision.FOLLOW
    return Decision.YIELD if comes and near else None


def _beside(ego: _Drive, other: _Drive, rate_hz: float) -> Decision | None:
    """About somebody in other lanes all the time."""
    half = 0.5 * (ego.length + other.length)
    abreast = np.abs(other.s - ego.s) < half
    gap = np.abs(other.l - ego.l) - 0.5 * (ego.width + other.width)
    slower = ego.v - other.v
    surely = abreast & (gap < NUDGE_M[0]) & (slower > SLOWER_MPS[0])
    maybe = np.abs(other.s - ego.s) < half + CLEAR_M
    maybe &= (gap < NUDGE_M[1]) & (slower > SLOWER_MPS[1])
    if not maybe.any():
        return Decision.IGNORE
    if np.count_nonzero(surely) < PASSING_S * rate_hz:
        return None
    at = np.argmax(surely)
    is_left = ego.l[at] > other.l[at]
    return Decision.NUDGE_LEFT if is_left else Decision.NUDGE_RIGHT


def line_decision(log: Log, ego: _Drive) -> Decision | None:
    """STOP where the driver waits at the next line, IGNORE where he does not."""
    lines = np.array([stop.station for stop in log.road.stops])
    lines = lines[lines > ego.s[0] + 0.5 * ego.length]
    if lines.size == 0 or lines[0] - ego.s[0] > LINE_SEEN_M[0]:
        return None
    gap = lines[0] - ego.s - 0.5 * ego.length
    waits = (ego.v < STANDS_MPS) & (gap > AT_LINE_M[0]) & (gap < AT_LINE_M[1])
    if np.count_nonzero(waits) >= STANDS_S * 10.0:
        return Decision.STOP
    near = (gap > -2.0) & (gap < OFF_LINE_M)
    return None if np.any(near & (ego.v < ROLLS_MPS)) else Decision.IGNORE


# ---------------------------------------------------------------------- tags


def motion_tags(log: Log, ego: _Drive) -> dict[Tag, bool | None]:
    """Tags of the driver's own motion; None: too close to say."""
    first, last, top, low = ego.v[0], ego.v[-1], ego.v.max(), ego.v.min()
    grid = np.arange(log.road.heading.size) * GRID_M
    turned = np.diff(np.interp(ego.s[[0, -1]], grid, log.road.heading))[0]
    change = True if ego.changes else None
    return {
        Tag.STOPPING: clear(first - 2.0, 0.6, 0.5 - last, 0.2),
        Tag.STARTING: clear(0.5 - first, 0.2, last - 2.0, 0.6),
        Tag.CRUISING: clear(1.5 - (top - low), 0.5, low - 5.0, 0.5),
        Tag.STANDING: clear(0.5 - top, 0.2),
        Tag.TURNING: clear(abs(np.rad2deg(turned)) - 30.0, 6.0),
        Tag.LANE_CHANGE: False if ego.is_steady else change,
    }


def decision_tags(
    found: dict[int, Decision | None], cut_ins: dict[int, bool | None]
) -> dict[Tag, bool | None]:
    """Tags that some decision makes true; false only where every one is known."""
    known = set(found.values())
    groups = {
        Tag.FOLLOWING: {Decision.FOLLOW},
        Tag.YIELDING: {Decision.YIELD},
        Tag.OVERTAKING: {Decision.OVERTAKE},
        Tag.NUDGING: {Decision.NUDGE_LEFT, Decision.NUDGE_RIGHT},
    }
    rest = None if None in known else False
    tags: dict[Tag, bool | None] = {
        tag: True if known & members else rest for tag, members in groups.items()
    }
    some = set(cut_ins.values())
    tags[Tag.CUT_IN] = True if True in some else None if None in some else False
    return tags


def cuts_in(ego: _Drive, other: _Drive | None, rate_hz: float) -> bool | None:
    """Whether the other comes into a steady driver's lane, ahead."""
    if other is None or not ego.is_steady:
        return None
    common = (ego.lanes & other.lanes) != 0
    if not common.any() or (common.all() and other.is_steady):
        return False
    made = decision(ego, other, rate_hz)
    if made == Decision.YIELD:
        return True
    return None if made is None else False


def red_light(log: Log, ego: _Drive, now: float) -> bool | None:
    """Whether a light ahead is red at the frame, `now` [s]."""
    front = ego.s[0] + 0.5 * ego.length
    answer: bool | None = False
    for stop, offset in zip(log.road.stops, log.signal_offset, strict=True):
        gap = stop.station - front
        if stop.is_sign or not -2.0 < gap < LINE_SEEN_M[1]:
            continue
        starts, colours = schedule(log.road.cycle, float(offset), now + 1.0)
        index = int(np.searchsorted(starts, now, side="right")) - 1
        near_change = np.any(np.abs(starts - now) < AMBER_S)
        if near_change or not 0.5 < gap < LINE_SEEN_M[0]:
            answer = None if colours[index] == "red" or near_change else answer
        elif colours[index] == "red":
            return True
    return answer


# --------------------------------------------------------------------- scenes


def judge(recording: Recording, log: Log) -> Iterator[list[Verdict] | str]:
    """Verdicts of every scene of a recording, or why a frame was dropped."""
    collector = Collector(recording, COLLECT)
    numbers = [int(track.id[1:]) for track in recording.tracks]
    for row in collector.scenes():
        first = int(row["frame"])
        seconds = TIMES_S[row["time_valid"]][-1]
        window = slice(first, first + int(round(seconds * recording.rate_hz)) + 1)
        ego = _drive(log, numbers[row["track"]], window)
        if ego is not None and _is_single(ego.lanes[0]):
            yield _verdicts(recording, log, row, ego, window, numbers)
    for reason, count in collector.dropped.items():
        yield from [reason] * count


def _verdicts(
    recording: Recording,
    log: Log,
    row: dict,
    ego: _Drive,
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
        other = _drive(log, number, window)
        known = settled and other is not None and _is_known(log, ego, other)
        made = decision(ego, other, rate) if other and known else None
        truth[number], cut_ins[number] = made, cuts_in(ego, other, rate)
        is_near = other is not None and abs(other.s[0] - ego.s[0]) < NEAR_M
        if made is not None and (number in slots or is_near):
            label = _label(row, slots, number)
            found.append(("decision", place, made.name, label.name))
    line = line_decision(log, ego) if _is_through(log, row, numbers, ego) else None
    if line is not None:
        found.append(("decision", place, line.name, _line_label(row).name))
    tags = motion_tags(log, ego) | decision_tags(truth, cut_ins)
    tags[Tag.RED_LIGHT] = red_light(log, ego, window.start / rate)
    for tag, value in tags.items():
        if value is not None:
            names = [tag.name if is_so else "" for is_so in (value, row["tags"][tag])]
            found.append(("tag", place, names[0], names[1]))
    return found


def _is_near(log: Log, number: int, window: slice, ego: _Drive, reach: float) -> bool:
    rows, slots = np.nonzero(log.vehicle[window] == number)
    return bool(np.any(np.abs(log.s[window][rows, slots] - ego.s[rows]) < reach))


def _stays(log: Log, number: int, window: slice, ego: _Drive) -> bool:
    """The driver keeps after the window to the lane in which it ends.

    The labels know the way that the driver took later, and so who was in it.
    """
    slot = np.flatnonzero(log.vehicle[window.start] == number)[0]
    rest = slice(window.stop, None)
    later = (log.vehicle[rest, slot] == number) & (log.s[rest, slot] < ego.s[0] + FAR_M)
    return bool(np.all(log.lanes[rest, slot][later] == ego.lanes[-1]))


def _is_known(log: Log, ego: _Drive, other: _Drive) -> bool:
    """The other is recorded from the frame on, or never in the driver's lanes.

    Not where parallel lanes differ in length, in bends.
    """
    if not np.any(ego.lanes & other.lanes):
        index = np.clip((ego.s / GRID_M).astype(int), 0, log.road.kappa.size - 1)
        return not np.any(np.abs(log.road.kappa[index]) > BEND)
    return SEEN_FROM_M < other.s[0] < log.road.length - SEEN_UNTIL_M


def _is_through(log: Log, row: dict, numbers: list[int], ego: _Drive) -> bool:
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
    if noise not in NOISES:
        raise InputError(f"--noise: {noise}: expected one of {', '.join(NOISES)}")
    known = [entry["road"] for entry in load_toml(_spec_path())["recordings"]]
    if unknown := [road for road in roads if road not in known]:
        raise InputError(f"roads: {unknown[0]}: expected of {', '.join(set(known))}")
    entries = [i for i, road in enumerate(known) if road in (roads or known)]
    items = [(entry, i) for entry in entries for i in range(recordings)]
    work = functools.partial(_judged, noise=noise, seed=seed)
    verdicts: list[Verdict] = []
    dropped: collections.Counter[str] = collections.Counter()
    scenes = 0
    judged = (executor or Here()).stream(work, items)
    for found in tqdm.tqdm(judged, desc=f"traffic {noise}", unit=" scenes"):
        if isinstance(found, str):
            dropped[found] += 1
        else:
            verdicts += found
            scenes += 1
    return report(noise, scenes + dropped.total(), dict(dropped), verdicts)


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
