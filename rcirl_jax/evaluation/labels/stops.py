"""Labels of recorded scenes against what the recording itself shows.

No truth is written down for recorded drives, but some of it can be seen: a car
that stands first before a stop line has stopped at it, and the speeds that the
file states (not differentiated positions) say who stops, starts or stands. What
lies near a threshold is left unscored.
"""

import collections
import dataclasses
from collections.abc import Iterable

import numpy as np

from rcirl_jax.data.scenes.collect import Collector
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.scenes.labels import labels_of
from rcirl_jax.data.scenes.signal_checks import SignalChecks
from rcirl_jax.evaluation.labels.made_traffic import clear
from rcirl_jax.evaluation.labels.scores import ClassScore, format_scores
from rcirl_jax.evaluation.labels.signals import (
    STANDING_MPS,
    crossing_time,
    first_stands,
    stands_in_reach,
)
from rcirl_jax.types import Decision, Demonstration, Kind, Recording, Tag, Track
from rcirl_jax.units import HORIZON_S

MOVING_MPS = 2.0  # m/s, as the definition of the tags
EDGE_S = 0.5  # s at either end over which a speed must hold
AT_ONCE = 4096  # scenes labelled side by side
SOON_S = 2.0  # s; who crosses within them is not held by a red light


@dataclasses.dataclass(frozen=True, kw_only=True)
class StopReport:
    """Agreement over the scenes of recordings."""

    scenes: int
    vehicles: int  # scenes of one vehicle are not independent
    signals: int  # in the recordings
    trusted: int  # of them used for stop lines
    scores: tuple[ClassScore, ...]

    def as_dict(self) -> dict:
        """JSON-ready."""
        return {
            "scenes": self.scenes,
            "vehicles": self.vehicles,
            "signals": self.signals,
            "trusted": self.trusted,
            "scores": [score.as_dict() for score in self.scores],
        }


def check_stops(
    recordings: Iterable[Recording],
    *,
    trust_all: bool = False,
    checks: SignalChecks | None = None,
) -> StopReport:
    """Compare every collected scene's labels with what was observed.

    Args:
      recordings: any.
      trust_all: use every written signal, also those that the importer's own
        check turns down; shows what the labels would be if they were right.
      checks: what many files say of the signals, as in an import with --signals.
    """
    how = {"trust_all": trust_all, "checks": checks}
    return joined(recording_stops(recording, **how) for recording in recordings)


def recording_stops(
    recording: Recording,
    *,
    trust_all: bool = False,
    checks: SignalChecks | None = None,
) -> StopReport:
    """`check_stops` of one recording."""
    counts: collections.Counter[tuple[str, bool, bool]] = collections.Counter()
    scenes, vehicles = 0, set()
    config = CollectConfig(require_speed_change=False, signal_checks=checks)
    collector = Collector(recording, config)
    if trust_all:
        collector.signals = {s.id: s for s in recording.signals}
    seen = _Observed(recording)
    for row in collector.scenes():
        scenes += 1
        vehicles.add(row["track"])
        for name, (truth, label) in _compare(row, seen).items():
            if truth is not None:
                counts[name, truth, label] += 1
    names = dict.fromkeys(name for name, _, _ in counts)
    return StopReport(
        scenes=scenes,
        vehicles=len(vehicles),
        signals=len(recording.signals),
        trusted=len(collector.signals),
        scores=tuple(
            ClassScore(
                name=name,
                right=counts[name, True, True],
                wrong=counts[name, False, True],
                missed=counts[name, True, False],
            )
            for name in names
        ),
    )


def joined(reports: Iterable[StopReport]) -> StopReport:
    """One report of several recordings."""
    total: collections.Counter[str] = collections.Counter()
    scores: dict[str, collections.Counter[str]] = {}
    for report in reports:
        for field in ("scenes", "vehicles", "signals", "trusted"):
            total[field] += getattr(report, field)
        for score in report.scores:
            counts = scores.setdefault(score.name, collections.Counter())
            for field in ("right", "wrong", "missed"):
                counts[field] += getattr(score, field)
    return StopReport(
        scenes=total["scenes"],
        vehicles=total["vehicles"],
        signals=total["signals"],
        trusted=total["trusted"],
        scores=tuple(
            ClassScore(
                name=name,
                right=counts["right"],
                wrong=counts["wrong"],
                missed=counts["missed"],
            )
            for name, counts in scores.items()
        ),
    )


class _Observed:
    """Per track number: times [s] of stands and crossings at signals' lines."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.first: dict[int, list[float]] = collections.defaultdict(list)
        self.reach: dict[int, list[float]] = collections.defaultdict(list)
        self.crosses: dict[int, list[float]] = collections.defaultdict(list)
        for lane in recording.lanes:
            if lane.stop_line is None:
                continue
            for number, times in first_stands(recording, lane).items():
                self.first[number] += times.tolist()
            for number, track in enumerate(recording.tracks):
                self.reach[number] += stands_in_reach(track, lane).tolist()
                time = crossing_time(track, lane)
                self.crosses[number] += [] if time is None else [time]


def _compare(row: dict, seen: _Observed) -> dict[str, tuple[bool | None, bool]]:
    """(observed or None, labelled) of one scene by name."""
    number, tags = row["track"], row["tags"]
    start = row["frame"] / seen.recording.rate_hz
    end = start + min(float(row["future_s"]), HORIZON_S)

    def within(times: list[float], until: float) -> bool:
        return any(start - 0.05 <= time <= until + 1e-6 for time in times)

    stop = (row["decisions"] == Decision.STOP) & (row["obstacles.kind"] == Kind.STOP)
    first, reach = (within(times[number], end) for times in (seen.first, seen.reach))
    held = within(seen.first[number], start + 0.05)
    goes = within(seen.crosses[number], start + SOON_S)
    # a second car in reach stands because of the first one: unscored
    stops = True if first else None if reach else False
    return {
        "stop (line)": (stops, bool(stop.any())),
        "red_light": (
            True if held and not goes else False if goes and not held else None,
            bool(tags[Tag.RED_LIGHT]),
        ),
        **_speeds(seen.recording.tracks[number], start, end, tags),
    }


def _speeds(
    track: Track, start: float, end: float, tags: np.ndarray
) -> dict[str, tuple[bool | None, bool]]:
    """(observed or None, labelled) of the tags that are speed alone."""
    v = track.speed[(track.t >= start - 1e-6) & (track.t <= end + 1e-6)]
    half = max(int(EDGE_S / np.median(np.diff(track.t))), 1)
    early, late, top = v[:half], v[-half:], v.max()
    found = {
        Tag.STOPPING: clear(
            early.min() - MOVING_MPS, 0.6, STANDING_MPS - late.max(), 0.2
        ),
        Tag.STARTING: clear(
            STANDING_MPS - early.max(), 0.2, late.min() - MOVING_MPS, 0.6
        ),
        Tag.STANDING: clear(STANDING_MPS - top, 0.2),
    }
    return {tag.name.lower(): (truth, bool(tags[tag])) for tag, truth in found.items()}


def format_stops(report: StopReport) -> str:
    """The agreement as a terminal table."""
    head = (
        f"{report.scenes} scenes of {report.vehicles} vehicles;"
        f" {report.trusted} of {report.signals} written signals used"
    )
    return "\n".join([head, *format_scores("observed", report.scores)])


def compare_stored(stored: Demonstration) -> tuple[ClassScore, ...]:
    """A dataset's stored labels against today's rules, which count as the truth.

    Args:
      stored: demonstrations [S]; their scenes are labelled again.
    """
    leaves = {
        f"{part}.{name}": np.asarray(values)
        for part in ("ego", "path", "obstacles")
        for name, values in vars(getattr(stored.scene, part)).items()
    }
    leaves["human.s"] = np.asarray(stored.human.s)
    leaves["human.l"] = np.asarray(stored.human.l)
    leaves["time_valid"] = np.asarray(stored.scene.time_valid)
    before, kind = np.asarray(stored.decisions), leaves["obstacles.kind"]
    pieces = [
        labels_of({name: values[i : i + AT_ONCE] for name, values in leaves.items()})
        for i in range(0, len(before), AT_ONCE)
    ]
    decisions, tags = map(np.concatenate, zip(*pieces, strict=True))
    known = kind != Kind.NONE
    pairs = [(d.name, decisions[known] == d, before[known] == d) for d in Decision]
    old = np.asarray(stored.scene.tags)
    pairs += [
        (f"tag {t.name}", tags[:, t], old[:, t]) for t in Tag if t != Tag.REHEARSED
    ]
    return tuple(
        ClassScore(
            name=name.lower(),
            right=int(np.sum(now & then)),
            wrong=int(np.sum(then & ~now)),
            missed=int(np.sum(now & ~then)),
        )
        for name, now, then in pairs
    )
