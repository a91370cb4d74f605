"""Import: log files -> a dataset on disk; resumable; all or nothing on bad input.

    input files --recordings_in--> Recording --scenes_of--> RecordingScenes --> shards

Recordings are cut into scenes wherever the executor runs them, and arrive here in
their order; numbers of vehicles, groups and recordings are given here, where all are
seen. Consecutive recordings fill a shard. A shard's lineage holds what later ones need
to continue as if nothing had happened (names and quality sums), so an interrupted
import resumes to the same bytes, and a parallel one writes the bytes of a local one.
"""

import collections
import dataclasses
import functools
import hashlib
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import cast

import jax
import numpy as np
import tqdm

from rcirl_jax.data.inputs import (
    InputFile,
    WorkUnit,
    leaving_out,
    recordings_in,
    work_units,
)
from rcirl_jax.data.plans import MAX_PLANS, plan_of
from rcirl_jax.data.quality import QualityReport, remedies
from rcirl_jax.data.readers.long_logs import AFTER_S, BEFORE_S
from rcirl_jax.data.readers.tables.rows import DAY_S
from rcirl_jax.data.scenes.collect import CHUNK, Collector, assemble
from rcirl_jax.data.scenes.config import CollectConfig, SignalChecks
from rcirl_jax.data.scenes.lanes import LaneGraph
from rcirl_jax.data.store.dataset import Dataset, Manifest
from rcirl_jax.data.store.files import Files
from rcirl_jax.data.store.rows import check_finite
from rcirl_jax.data.store.splits import split_wholes, time_blocks
from rcirl_jax.data.store.writer import DatasetWriter
from rcirl_jax.errors import InputError, LostWorkError, counted
from rcirl_jax.runtime.executors import Executor, Serial
from rcirl_jax.types import Demonstration, Kind, Recording, Track

SHARD_SCENES = 4096  # scenes after which a shard is closed
GROUP_BLOCK_S = 60.0  # s; vehicles first seen in one block share a group
ENDS_S = 1.0  # s, a vehicle seen so near to a recording's end may drive on in another
AWAY_M = 3.0  # m, besides what its speed explains
MINUTE = "/minute-"  # between a recording's name and the number of a block
CHANGED = (
    "input or settings changed since the interrupted import: expected the same; use "
    "another output folder"
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImportConfig:
    """The settings of an import, as the manifest records them."""

    format: str  # importer, for provenance
    collect: CollectConfig = dataclasses.field(default_factory=CollectConfig)
    # share of scenes held out, by vehicle-disjoint group
    test_fraction: float = 0.25
    split_seed: int = 0
    # recordings that may be refused and are left out; the next one ends the import
    leave_out: int = 0
    # share of all recordings that may be refused, in place of a count
    leave_out_share: float = 0.0

    @property
    def leaves_out(self) -> bool:
        """True if any recording may be refused and left out."""
        return self.leave_out > 0 or self.leave_out_share > 0.0

    def as_dict(self) -> dict:
        """Return the settings for the manifest; what is left out only if set."""
        found = dataclasses.asdict(self)
        unused = {name for name in ("leave_out", "leave_out_share") if not found[name]}
        return {name: value for name, value in found.items() if name not in unused}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Logs:
    """Recordings that are still to be imported, as `rcirl import` takes them."""

    format: str
    input: Path | None
    source: Path | None
    config: ImportConfig
    # which written lights are used: what was asked for, and who finds it out
    signals: str = ""
    checked: Callable[[Sequence[InputFile], Executor], SignalChecks | None] | None = (
        None
    )

    def import_config(
        self, files: Sequence[InputFile], places: Executor
    ) -> ImportConfig:
        """Return the settings with the verdicts on the lights, which reads all logs."""
        if self.checked is None:
            return self.config
        checks = self.checked(files, places)
        collect = dataclasses.replace(self.config.collect, signal_checks=checks)
        return dataclasses.replace(self.config, collect=collect)


# --------------------------------------------------------- one recording's scenes


@dataclasses.dataclass(frozen=True, kw_only=True)
class End:
    """A vehicle at the begin or end of its recording, where it may drive on."""

    id: str  # in the log
    is_begin: bool
    t: float  # s, on the log's clock
    x: float  # m, in the log's frame
    y: float
    speed: float  # m/s
    vehicle: str
    group: str

    def goes_on(self, other: "End") -> bool:
        """True if the other is the same vehicle a step later or earlier.

        Times of a day that nobody names go on at midnight.
        """
        first, second = (other, self) if self.is_begin else (self, other)
        apart = second.t - first.t
        if max(self.t, other.t) < 2.0 * DAY_S:
            apart %= DAY_S
        near = np.hypot(other.x - self.x, other.y - self.y)
        reach = AWAY_M + 1.5 * max(self.speed, other.speed) * apart
        return (
            self.id == other.id
            and self.is_begin != other.is_begin
            and 0.0 < apart <= ENDS_S
            and bool(near <= reach)
        )

    def keys(self, around: Sequence[int] = (0,)) -> list[tuple[str, int]]:
        """Returns id and second of the day, or those of other seconds beside it."""
        second = int(self.t // ENDS_S)
        return [(self.id, (second + k) % round(DAY_S / ENDS_S)) for k in around]


def ends_of(recording: Recording, log: str) -> Iterator[End]:
    """Yields the vehicles that may drive on in a recording before or after.

    Of a piece of a log only where the log itself begins or ends, which is where the
    rows around its scenes are cut short.
    """
    vehicles = [x for x in recording.tracks if x.kind == Kind.VEHICLE]
    if recording.start_s is None or not vehicles:
        return
    low, high = recording.scenes_within or (-np.inf, np.inf)
    begin, end = min(x.t[0] for x in vehicles), max(x.t[-1] for x in vehicles)
    sides = []
    if begin > low - BEFORE_S + ENDS_S:
        sides.append((0, begin))
    if end < high + AFTER_S - ENDS_S:
        sides.append((-1, end))
    for track in vehicles:
        group = _group(recording, track, log)
        for row, edge in sides:
            if abs(track.t[row] - edge) <= ENDS_S:
                yield End(
                    id=track.id.partition("#")[0],
                    is_begin=row == 0,
                    t=recording.start_s + float(track.t[row]),
                    x=recording.origin[0] + float(track.x[row]),
                    y=recording.origin[1] + float(track.y[row]),
                    speed=float(track.speed[row]),
                    vehicle=f"{group}:{track.id}",
                    group=group,
                )


def _group(recording: Recording, track: Track, log: str) -> str:
    """Vehicle-disjoint group of a track."""
    minute = int(track.first_seen_s // GROUP_BLOCK_S)
    return recording.group or f"{log}{MINUTE}{minute:04d}"


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RecordingScenes:
    """The scenes of one recording, numbered in no dataset yet."""

    name: str
    source: str
    licence: str
    rate_hz: float
    sha256: str  # of the recording and of how it is cut
    quality: dict = dataclasses.field(default_factory=dict)  # `QualityReport.state()`
    # numbers of vehicle, group and recording are 0; None: no scene, or known
    scenes: Demonstration | None = None
    vehicles: Sequence[str] = ()  # name per scene
    groups: Sequence[str] = ()  # vehicle-disjoint group per scene
    first_seen: Sequence[float] = ()  # s, when the log first saw each scene's vehicle
    log: str = ""  # of which the recording is a slice, or its own name
    known: bool = False  # a committed shard holds it already
    refused: str = ""  # why nothing of it was read, where it is left out
    input: str = ""  # the file it was read from
    plan: dict | None = None  # of the site, of the first recordings
    ends: Sequence[End] = ()
    # whether vehicles that drive on in another recording cannot be told
    has_no_clock: bool = False
    progress: float | None = None  # share of that file read after it, if known


def digest(recording: Recording) -> str:
    """Return the sha256 of every compared field; equal inputs give equal datasets."""
    total = hashlib.sha256()
    _hash(total, recording)
    return total.hexdigest()


def _hash(total: "hashlib._Hash", value: object) -> None:
    """Add type, length and content, so that no two values run into each other."""
    if dataclasses.is_dataclass(value):
        for field in filter(lambda field: field.compare, dataclasses.fields(value)):
            total.update(f"{field.name}:".encode())
            _hash(total, getattr(value, field.name))
    elif isinstance(value, np.ndarray):
        total.update(f"{value.dtype}{value.shape}".encode())
        total.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, tuple | list):
        total.update(f"({len(value)}".encode())
        for item in value:
            _hash(total, item)
    else:
        total.update(f"{type(value).__name__}={value!r};".encode())


def scenes_of(
    recording: Recording, config: CollectConfig, done: Mapping[str, str] | None = None
) -> RecordingScenes:
    """Cut a recording into scenes: a pure function, wherever it runs.

    Args:
      recording: validated.
      config: what is collected.
      done: sha256 by name of recordings that committed shards hold.

    Raises:
      InputError: `done` has a recording of this name cut from another input or
        with other settings.
    """
    log = recording.piece_of or recording.name
    made = RecordingScenes(
        name=recording.name,
        source=recording.source,
        licence=recording.licence,
        rate_hz=recording.rate_hz,
        sha256=hashlib.sha256((digest(recording) + repr(config)).encode()).hexdigest(),
        log=log,
        ends=tuple(ends_of(recording, log)),
        has_no_clock=recording.start_s is None and recording.group is None,
        refused=recording.refused,
        progress=recording.progress,
    )
    if done and recording.name in done:
        if done[recording.name] != made.sha256:
            raise InputError(f"{recording.name}: {CHANGED}")
        return dataclasses.replace(made, known=True)
    report = QualityReport()
    if recording.refused or not recording.tracks:
        report.add_nothing(recording)
        return dataclasses.replace(made, quality=report.state())
    collector = Collector(recording, config)
    # a few at a time: a row before it is assembled takes more than twice the memory
    blocks, tracks, rows = [], [], collector.scenes()
    while some := list(itertools.islice(rows, CHUNK)):
        none = [0] * len(some)
        blocks.append(assemble(some, vehicles=none, groups=none, recording=0))
        tracks += [collector.recording.tracks[row["track"]] for row in some]
    report.add_recording(collector)
    if not tracks:
        return dataclasses.replace(made, quality=report.state())
    scenes = jax.tree.map(lambda *leaves: np.concatenate(leaves), *blocks)
    report.add_scenes(scenes)
    groups = [_group(recording, track, log) for track in tracks]
    return dataclasses.replace(
        made,
        scenes=scenes,
        vehicles=[f"{g}:{x.id}" for g, x in zip(groups, tracks, strict=True)],
        groups=groups,
        first_seen=[x.first_seen_s for x in tracks],
        quality=report.state(),
    )


def scenes_in(
    numbered: tuple[WorkUnit, int],
    config: CollectConfig,
    done: Mapping[str, str] | None = None,
) -> Iterator[RecordingScenes]:
    """Yield the scenes of each recording of a unit of work; see `scenes_of`.

    The first recordings of the first units come with the plans of their sites.
    """
    unit, number = numbered
    for place, (file, recording) in enumerate(recordings_in(unit)):
        made = scenes_of(recording, config, done)
        if number + place < MAX_PLANS and not recording.refused:
            plan = plan_of(recording, LaneGraph(recording))
            made = dataclasses.replace(made, plan=plan)
        yield dataclasses.replace(made, input=str(file.input)) if file else made


# ------------------------------------------------------------------ the import


class Progress:
    """A bar of the share read: scenes, scenes/s, drop reasons, time left.

    All input files count alike. Inside one the bar moves as its recordings say how
    much of it is read.

    Args:
      total: files; None: unknown, recordings are counted then.
    """

    FORMAT = "{desc}: {percentage:.0f}% [{elapsed}<{remaining}{postfix}]"

    def __init__(self, total: int | None) -> None:
        self._bar = tqdm.tqdm(
            total=total,
            desc="import",
            unit=" recordings",
            mininterval=0.5,
            miniters=0,  # drawn by time alone
            bar_format=self.FORMAT if total else None,
        )
        self._start, self._input = time.monotonic(), None
        self._finished = 0  # files
        self._known = 0  # scenes taken over from an interrupted import

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, failure: type[BaseException] | None, *_: object) -> None:
        if failure is None and self._bar.total:
            self._move(self._bar.total)
        self._bar.close()

    def _move(self, position: float) -> None:
        self._bar.update(max(position - self._bar.n, 0.0))

    def show(self, made: RecordingScenes, quality: QualityReport) -> None:
        """Draw after a recording: its file and all scenes so far."""
        file = made.input or made.name
        self._finished += self._input not in (None, file)
        self._input = file
        if made.known:
            self._known = quality.scenes
        seconds = max(time.monotonic() - self._start, 1e-9)
        rate = (quality.scenes - self._known) / seconds
        reasons = quality.dropped.most_common(2)
        dropped = " ".join(f"{name} {count:,}" for name, count in reasons)
        self._bar.set_postfix_str(
            f"{quality.scenes:,} scenes, {rate:.0f}/s"
            + (f", dropped: {dropped}" if dropped else ""),
            refresh=False,
        )
        share = (made.progress or 0.0) if self._bar.total else 1.0
        self._move(self._finished + share)


def _numbers(table: dict[str, int], names: Iterable[str]) -> np.ndarray:
    """Return numbers [n] of names, in order of first appearance."""
    return np.array([table.setdefault(name, len(table)) for name in names], np.int32)


class Unions:
    """Names that belong together, each union known by one of them."""

    def __init__(self) -> None:
        self._first: dict[str, str] = {}

    def of(self, name: str) -> str:
        """Returns the name of the union that a name is in."""
        while (first := self._first.get(name, name)) != name:
            name = first
        return name

    def join(self, one: str, other: str) -> None:
        """Makes one of two unions, called as the first."""
        one, other = self.of(one), self.of(other)
        if one != other:
            self._first[other] = one


class _Import:
    """State of one import: names, quality, the open shard."""

    def __init__(self, writer: DatasetWriter, config: ImportConfig) -> None:
        self.writer, self.config = writer, config
        # names to their numbers
        self.recordings: dict[str, int] = {}
        self.groups: dict[str, int] = {}
        self.vehicles: dict[str, int] = {}
        self.sizes: collections.Counter[str] = collections.Counter()  # by group
        self.quality = QualityReport()
        self.sources: dict[str, str] = {}  # licence by source
        self.rates: set[float] = set()
        self.first_refused = ""  # in words
        # of the open shard: scenes, name and first sight of each one's vehicle, lineage
        self.pending: list[Demonstration] = []
        self.drivers: list[tuple[str, float]] = []
        self.lineage: list[dict] = []
        self.logs: set[str] = set()  # that scenes come from
        self.plans: list[dict] = []
        # of vehicles that may drive on in another recording, by `End.keys`
        self.ends: dict[tuple[str, int], list[End]] = collections.defaultdict(list)
        self.one_side = Unions()  # of groups with vehicles in common
        # vehicle that does -> (vehicle, group) of an earlier recording
        self.renamed: dict[str, tuple[str, str]] = {}
        self.met: set[str] = set()  # vehicles, by the names that they came with
        self.driven_on: set[str] = set()  # likewise, those with an earlier recording
        self.without_clock: set[str] = set()  # logs
        committed = writer.committed()
        self.next_shard = len(committed)
        self.done = collections.deque(x for shard in committed for x in shard.lineage)

    def add(self, made: RecordingScenes) -> None:
        """Take over one recording's scenes, or what a committed shard holds of it."""
        if made.name in self.recordings:
            raise InputError(f"{made.name}: name: met twice: expected once")
        number = self.recordings.setdefault(made.name, len(self.recordings))
        made = self._driving_on(made)
        self.first_refused = self.first_refused or made.refused
        if made.plan is not None and len(self.plans) < MAX_PLANS:
            self.plans.append(made.plan)
        if made.rate_hz > 0.0:  # neither refused nor a file without rows
            self.sources[made.source] = made.licence
            self.rates.add(made.rate_hz)
        if self.done:
            entry = self.done.popleft()
            if entry["name"] != made.name:
                raise InputError(f"{made.name}: {CHANGED}")
            _numbers(self.vehicles, entry["vehicles"])
            _numbers(self.groups, entry["groups"])
            self._count(entry)
            return
        entry = {
            "name": made.name,
            "sha256": made.sha256,
            "vehicles": list(dict.fromkeys(made.vehicles)),
            "groups": dict(collections.Counter(made.groups)),
            "quality": made.quality,
        }
        if made.scenes is not None:
            scenes = made.scenes.replace(
                vehicle=_numbers(self.vehicles, made.vehicles),
                group=_numbers(self.groups, made.groups),
                recording=np.full_like(made.scenes.recording, number),
            )
            check_finite(made.name, scenes, np.arange(len(made.vehicles)))
            self.pending.append(scenes)
            self.drivers += zip(made.vehicles, made.first_seen, strict=True)
            self.logs.add(made.log)
        self._count(entry)
        too_many = self.quality.refused > self.config.leave_out
        if too_many and not self.config.leave_out_share:
            raise InputError(
                f"{made.refused}; recordings left out before: {self.config.leave_out}"
            )
        self.lineage.append(entry)
        if len(self.drivers) >= SHARD_SCENES:
            self._close_shard()

    def _driving_on(self, made: RecordingScenes) -> RecordingScenes:
        """Gives vehicles of a stream cut into files one name and group in all."""
        for end in made.ends:
            vehicle, group = self._now_called(end.vehicle, end.group)
            for key in end.keys((-1, 0, 1)):
                for known in self.ends.get(key, ()):
                    if known.vehicle == vehicle or not known.goes_on(end):
                        continue
                    self.driven_on.add(end.vehicle)
                    if end.vehicle not in self.met:
                        vehicle, group = known.vehicle, known.group
                        self.renamed[end.vehicle] = vehicle, group
                        self.met.add(end.vehicle)
                    else:  # out of order: it has two names already
                        self.one_side.join(group, known.group)
        for end in made.ends:
            vehicle, group = self._now_called(end.vehicle, end.group)
            kept = dataclasses.replace(end, vehicle=vehicle, group=group)
            self.ends[end.keys()[0]].append(kept)
        self.met.update(made.vehicles, (end.vehicle for end in made.ends))
        if made.has_no_clock:
            self.without_clock.add(made.log)
        pairs = [
            self._now_called(vehicle, group)
            for vehicle, group in zip(made.vehicles, made.groups, strict=True)
        ]
        return dataclasses.replace(
            made, vehicles=[x for x, _ in pairs], groups=[x for _, x in pairs]
        )

    def _now_called(self, vehicle: str, group: str) -> tuple[str, str]:
        """Returns a vehicle's name and group in the recording that met it first."""
        return self.renamed.get(vehicle, (vehicle, group))

    def _count(self, entry: dict) -> None:
        self.quality.merge(entry["quality"])
        self.sizes.update(entry["groups"])

    def _said_of_streams(self) -> str:
        """Returns the end of a line on vehicles in several recordings."""
        said = ""
        if self.driven_on:
            again = counted(len(self.driven_on), "vehicle")
            said = f"; {again} met again in the next recording: each is in one split"
        if len(self.without_clock) > 1:
            said += "; the logs say no time of day: files of one stream cannot be told"
        return said

    def _close_shard(self) -> None:
        if self.pending:
            joined = jax.tree.map(lambda *x: np.concatenate(x), *self.pending)
            self.writer.write_shard(self.next_shard, joined, self.lineage)
            self.next_shard += 1
            self.pending, self.drivers, self.lineage = [], [], []

    def _split_one_group(self) -> str:
        """Make groups of one that would leave the test split empty.

        Returns:
          What is kept on one side then, in words; "" where there are more groups.

        Raises:
          LostWorkError: it cannot be cut; finished shards stay for another share.
        """
        if len(self.sizes) != 1 or not self.config.test_fraction:
            return ""
        (group,) = self.sizes
        vehicles = [name for name, _ in self.drivers]
        whole = len(vehicles) == self.quality.scenes and len(self.logs) == 1
        if not whole or len(set(vehicles)) == 1:
            self._close_shard()
            raise LostWorkError(
                f"splits: groups: 1 ({group}): expected at least two vehicle-disjoint "
                f"groups for test_fraction={self.config.test_fraction:g}; give more "
                "recordings, or import with test_fraction=0 for training scenes only"
            )
        blocks, words = time_blocks(
            np.array([seen for _, seen in self.drivers]),
            vehicles,
            self.config.test_fraction,
        )
        names = [f"{group}/{block}" for block in blocks]
        self.groups = {}
        joined = jax.tree.map(lambda *x: np.concatenate(x), *self.pending)
        self.pending = [joined.replace(group=_numbers(self.groups, names))]
        self.sizes, rest = collections.Counter(names), iter(names)
        for entry in self.lineage:
            own = itertools.islice(rest, sum(entry["groups"].values()))
            entry["groups"] = dict(collections.Counter(own))
        return words

    def finish(self, before_commit: Callable[[Dataset], object]) -> Manifest:
        """Close the last shard and commit the dataset."""
        quality, share = self.quality, self.config.leave_out_share
        if self.done:
            raise InputError(
                f"{self.done[0]['name']}: missing: expected all recordings of the "
                "interrupted import; use another output folder"
            )
        if share and quality.refused > share * len(self.recordings):
            raise InputError(
                f"import: {quality.refused} of {len(self.recordings)} recordings "
                f"refused, the first: {self.first_refused}: expected up to "
                f"{100.0 * share:g} % (leave_out)"
            )
        if quality.scenes == 0:
            if quality.empty and not quality.recordings:
                empty = counted(quality.empty, "recording")
                raise InputError(
                    f"import: {empty}, none with traffic: expected at least one road "
                    "user"
                )
            why = remedies(quality.dropped) or "none was long enough"
            raise InputError(f"import: 0 scenes kept of {quality.tracks} tracks: {why}")
        cut_by = self._split_one_group()
        self._close_shard()
        sides = {group: self.one_side.of(group) for group in self.sizes}
        for group in self.sizes:
            self.one_side.join(group.rpartition(MINUTE)[0] or group, group)
        wholes = {group: self.one_side.of(group) for group in self.sizes}
        splits, kept = split_wholes(
            self.sizes,
            (wholes, sides),
            test_fraction=self.config.test_fraction,
            seed=self.config.split_seed,
        )

        def planned(dataset: Dataset) -> None:
            dataset.write_plans(self.plans)
            before_commit(dataset)

        return self.writer.finish(
            {
                "rate_hz": sorted(self.rates),
                "sources": [
                    {"source": source, "licence": licence}
                    for source, licence in sorted(self.sources.items())
                ],
                "recordings": list(self.recordings),
                "groups": list(self.groups),
                "vehicles": list(self.vehicles),
                "splits": splits,
                "quality": quality.as_dict(),
                "import": {
                    **self.config.as_dict(),
                    "split_by": (cut_by or kept) + self._said_of_streams(),
                },
            },
            planned,
        )


def import_logs(
    logs: Sequence[InputFile] | Iterable[Recording],
    output: str | Path,
    config: ImportConfig,
    *,
    executor: Executor | None = None,
    overwrite: bool = False,
    before_commit: Callable[[Dataset], object] = lambda dataset: None,
) -> Manifest:
    """Import input files or recordings into a dataset; shows scenes/s.

    Args:
      logs: of `inputs.input_files`, read wherever the executor runs them (the bytes do
        not depend on it); or recordings, read already.
      output: dataset folder or tensorstore URL.
      config: collection and split settings.
      executor: default: this process.
      overwrite: replace a finished dataset.
      before_commit: as `DatasetWriter.finish`.

    Returns:
      The manifest of the finished dataset.

    Raises:
      InputError: bad input. Nothing of this import stays on disk then; an
        interrupt, and the loss of workers or nodes (LostWorkError), keeps finished
        shards, and the next run resumes from them.
    """
    places = executor or Serial()
    given = logs if isinstance(logs, list) else []
    files = [file for file in given if isinstance(file, InputFile)]
    if config.leaves_out:
        files = leaving_out(files)
    recordings = () if files else cast(Iterable[Recording], logs)
    units: Iterable[WorkUnit] = itertools.chain(
        work_units(files, places.workers), ((None, one) for one in recordings)
    )
    with Files(str(output)).alone():
        writer = DatasetWriter(str(output), overwrite=overwrite)
        try:
            state = _Import(writer, config)
            known = {entry["name"]: entry["sha256"] for entry in state.done}
            work = functools.partial(scenes_in, config=config.collect, done=known)
            with Progress(len(files) or None) as progress:
                for made in places.stream(work, zip(units, itertools.count())):
                    state.add(made)
                    progress.show(made, state.quality)
            return state.finish(before_commit)
        except LostWorkError:
            raise  # as after an interrupt, the next run goes on from the shards
        except InputError:
            writer.abort()
            raise
