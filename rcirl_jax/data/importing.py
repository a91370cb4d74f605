"""Import: log files -> a dataset on disk; resumable; all or nothing on bad input.

Recordings are cut into scenes wherever the executor runs them, and arrive here in
their order. Consecutive ones fill a shard. A shard's lineage holds what later
recordings need to continue as if nothing had happened (names and quality sums),
so an interrupted import resumes to the same bytes, and a parallel one writes the
bytes of a local one.
"""

import collections
import dataclasses
import functools
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import jax
import numpy as np
import tqdm

from rcirl_jax.data.cut import Cut, cut, cut_item, whole_of
from rcirl_jax.data.parts import Part, items, leaving_out
from rcirl_jax.data.quality import QualityReport, remedies
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.data.store.files import Files
from rcirl_jax.data.store.manifest import Manifest
from rcirl_jax.data.store.rows import check_finite
from rcirl_jax.data.store.splits import split_wholes, time_blocks
from rcirl_jax.data.store.writer import DatasetWriter
from rcirl_jax.errors import InputError, LostWorkError
from rcirl_jax.runtime.executors import Executor, Serial
from rcirl_jax.types import Demonstration, Recording

SHARD_SCENES = 4096  # scenes after which a shard is closed


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImportConfig:
    """What the manifest records of how a dataset was made."""

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
        """Whether any recording may be refused and left out."""
        return self.leave_out > 0 or self.leave_out_share > 0.0


def _numbers(table: dict[str, int], names: Iterable[str]) -> np.ndarray:
    """Numbers of names, in order of first appearance."""
    return np.array([table.setdefault(name, len(table)) for name in names], np.int32)


class Progress:
    """A bar of the share read: scenes, scenes/s, drop reasons, time left.

    All parts count alike. Inside a part the bar moves as its recordings say how
    much of it is read.

    Args:
      total: parts; None: unknown, recordings are counted then.
    """

    NUM_REASONS = 2  # drop reasons shown, the most frequent ones
    EVERY_S = 0.5  # s between two drawings
    FORMAT = "{desc}: {percentage:.0f}% [{elapsed}<{remaining}{postfix}]"

    def __init__(self, total: int | None) -> None:
        self._bar = tqdm.tqdm(
            total=total,
            desc="import",
            unit=" recordings",
            mininterval=self.EVERY_S,
            miniters=0,  # drawn by time alone
            bar_format=self.FORMAT if total else None,
        )
        self._start, self._part = time.monotonic(), None
        self._finished = 0  # parts
        self._known = 0  # scenes taken over from an interrupted import

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, failure: type[BaseException] | None, *_: object) -> None:
        if failure is None and self._bar.total:
            self._move(self._bar.total)
        self._bar.close()

    def _move(self, position: float) -> None:
        self._bar.update(max(position - self._bar.n, 0.0))

    def show(self, made: Cut, quality: QualityReport) -> None:
        """After a recording: its part and all scenes so far."""
        part = made.part or made.name
        if self._part is not None and part != self._part:
            self._finished += 1
        self._part = part
        if made.known:
            self._known = quality.scenes
        seconds = max(time.monotonic() - self._start, 1e-9)
        rate = (quality.scenes - self._known) / seconds
        reasons = quality.dropped.most_common(self.NUM_REASONS)
        dropped = " ".join(f"{name} {count:,}" for name, count in reasons)
        self._bar.set_postfix_str(
            f"{quality.scenes:,} scenes, {rate:.0f}/s"
            + (f", dropped: {dropped}" if dropped else ""),
            refresh=False,
        )
        share = (made.progress or 0.0) if self._bar.total else 1.0
        self._move(self._finished + share)


class _Import:
    """State of one import: names, quality, the open shard."""

    def __init__(self, writer: DatasetWriter, config: ImportConfig) -> None:
        self.writer, self.config = writer, config
        # names to their numbers
        self.recordings: dict[str, int] = {}
        self.groups: dict[str, int] = {}
        self.vehicles: dict[str, int] = {}
        self.quality = QualityReport()
        self.first_refused = ""  # in words
        self.sizes: dict[str, int] = {}
        # of the scenes in `pending`: name and first sight of each one's vehicle
        self.pending: list[Demonstration] = []
        self.drivers: list[tuple[str, float]] = []
        self.logs: set[str] = set()  # that scenes come from
        self.split_by = ""  # in words, what is kept on one side
        self.lineage: list[dict] = []
        self.sources: dict[str, str] = {}
        self.rates: set[float] = set()
        self.next_shard = 0
        self.done: collections.deque[dict] = collections.deque()
        for self.next_shard, info in enumerate(writer.committed(), 1):
            self.done += info.lineage

    @property
    def known(self) -> dict[str, str]:
        """sha256 by name of the recordings that committed shards hold."""
        return {entry["name"]: entry["sha256"] for entry in self.done}

    def add(self, made: Cut) -> None:
        """Take over one recording's scenes."""
        if made.name in self.recordings:
            raise InputError(f"{made.name}: name: met twice: expected once")
        self.first_refused = self.first_refused or made.refused or ""
        if made.rate_hz > 0.0:  # neither refused nor a file without rows
            self.sources[made.source] = made.licence
            self.rates.add(made.rate_hz)
        number = self.recordings.setdefault(made.name, len(self.recordings))
        if self.done:
            self._replay(self.done.popleft(), made)
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
        if sum(block.vehicle.shape[0] for block in self.pending) >= SHARD_SCENES:
            self._close_shard()

    def _count(self, entry: dict) -> None:
        self.quality.merge(entry["quality"])
        for name, scenes in entry["groups"].items():
            self.sizes[name] = self.sizes.get(name, 0) + scenes

    def _replay(self, entry: dict, made: Cut) -> None:
        """Take over what a committed shard already holds of this recording."""
        if entry["name"] != made.name:
            raise InputError(
                f"{made.name}: input or settings changed since the interrupted "
                "import: expected the same; use another output folder"
            )
        _numbers(self.vehicles, entry["vehicles"])
        _numbers(self.groups, entry["groups"])
        self._count(entry)

    def _close_shard(self) -> None:
        if not self.pending:
            return
        joined = jax.tree.map(lambda *x: np.concatenate(x), *self.pending)
        self.writer.write_shard(self.next_shard, joined, self.lineage)
        self.next_shard += 1
        self.pending, self.drivers, self.lineage = [], [], []

    def _split_one_group(self) -> None:
        """Make groups of one that would leave the test split empty.

        Raises:
          LostWorkError: it cannot be cut; finished shards stay for another share.
        """
        if len(self.sizes) != 1 or not self.config.test_fraction:
            return
        (group,) = self.sizes
        vehicles = [name for name, _ in self.drivers]
        first_seen = np.array([time for _, time in self.drivers])
        whole = len(vehicles) == self.quality.scenes and len(self.logs) == 1
        if not whole or len(set(vehicles)) == 1:
            self._close_shard()
            raise LostWorkError(
                f"splits: groups: 1 ({group}): expected at least two vehicle-disjoint "
                f"groups for test_fraction={self.config.test_fraction:g}; give more "
                "recordings, or import with test_fraction=0 for training scenes only"
            )
        blocks, self.split_by = time_blocks(
            first_seen, vehicles, self.config.test_fraction
        )
        names = [f"{group}/{block}" for block in blocks]
        self.groups, start = {}, 0
        numbers = _numbers(self.groups, names)
        joined = jax.tree.map(lambda *x: np.concatenate(x), *self.pending)
        self.pending = [joined.replace(group=numbers)]
        self.sizes = dict(collections.Counter(names))
        for entry in self.lineage:
            end = start + sum(entry["groups"].values())
            entry["groups"] = dict(collections.Counter(names[start:end]))
            start = end

    def finish(self, before_commit: Callable[[Dataset], object]) -> Manifest:
        """Close the last shard and commit the dataset."""
        if self.done:
            raise InputError(
                f"{self.done[0]['name']}: missing: expected all recordings of the "
                "interrupted import; use another output folder"
            )
        self._check_share_left_out()
        if self.quality.scenes == 0:
            if self.quality.empty and not self.quality.recordings:
                raise InputError(
                    f"import: {self.quality.empty} recordings, none with traffic: "
                    "expected at least one road user"
                )
            why = remedies(self.quality.dropped) or "none was long enough"
            raise InputError(
                f"import: 0 scenes kept of {self.quality.tracks} tracks: {why}"
            )
        self._split_one_group()
        self._close_shard()
        wholes = {group: whole_of(group) for group in self.sizes}
        splits, kept = split_wholes(
            self.sizes,
            wholes,
            test_fraction=self.config.test_fraction,
            seed=self.config.split_seed,
        )
        self.split_by = self.split_by or kept
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
                "quality": self.quality.as_dict(),
                "import": self._flags(),
            },
            before_commit,
        )

    def _check_share_left_out(self) -> None:
        refused, share = self.quality.refused, self.config.leave_out_share
        recordings = len(self.recordings)
        if share and refused > share * recordings:
            raise InputError(
                f"import: {refused} of {recordings} recordings refused, the first: "
                f"{self.first_refused}: expected up to {100.0 * share:g} % "
                "(leave_out)"
            )

    def _flags(self) -> dict:
        """What the manifest says of the settings; what is left out only where it is."""
        found = dataclasses.asdict(self.config)
        unused = {name for name in ("leave_out", "leave_out_share") if not found[name]}
        kept = {name: value for name, value in found.items() if name not in unused}
        return kept | {"split_by": self.split_by}


def import_logs(
    recordings: Iterable[Recording],
    output: str | Path,
    config: ImportConfig,
    *,
    before_commit: Callable[[Dataset], object] = lambda dataset: None,
) -> Manifest:
    """Import recordings into a dataset, one after the other; shows scenes/s.

    Args:
      recordings: from `importers.read_recordings`.
      output: dataset folder or tensorstore URL.
      config: collection and split settings.
      before_commit: as `DatasetWriter.finish`.

    Returns:
      The manifest of the finished dataset.

    Raises:
      InputError: bad input. Nothing of this import stays on disk then; an
        interrupt, and the loss of workers or nodes (LostWorkError), keeps finished
        shards, and the next run resumes from them.
    """

    def cuts(known: dict[str, str]) -> Iterable[Cut]:
        return (cut(recording, config.collect, known) for recording in recordings)

    return _import(cuts, None, output, config, False, before_commit)


def import_parts(
    parts: Sequence[Part],
    output: str | Path,
    config: ImportConfig,
    *,
    executor: Executor | None = None,
    overwrite: bool = False,
    before_commit: Callable[[Dataset], object] = lambda dataset: None,
) -> Manifest:
    """Import parts wherever the executor runs them; bytes do not depend on it.

    Args:
      parts: of `importers.parts`, in order.
      output: dataset folder or tensorstore URL.
      config: collection and split settings.
      executor: default: this process.
      overwrite: replace a finished dataset.
      before_commit: as `DatasetWriter.finish`.

    Returns:
      The manifest of the finished dataset.

    Raises:
      InputError: as `import_logs`.
    """
    places = executor or Serial()
    if config.leaves_out:
        parts = leaving_out(parts)

    def cuts(known: dict[str, str]) -> Iterable[Cut]:
        work = functools.partial(cut_item, config=config.collect, done=known)
        return places.stream(work, items(parts, places.workers))

    return _import(cuts, len(parts), output, config, overwrite, before_commit)


def _import(
    cuts: Callable[[dict[str, str]], Iterable[Cut]],
    total: int | None,
    output: str | Path,
    config: ImportConfig,
    overwrite: bool,
    before_commit: Callable[[Dataset], object] = lambda dataset: None,
) -> Manifest:
    """Write the cuts in their order; `total` recordings or parts are expected."""
    with Files(str(output)).alone():
        writer = DatasetWriter(str(output), overwrite=overwrite)
        try:
            work = _Import(writer, config)
            with Progress(total) as progress:
                for made in cuts(work.known):
                    work.add(made)
                    progress.show(made, work.quality)
            return work.finish(before_commit)
        except LostWorkError:
            raise  # as after an interrupt, the next run goes on from the shards
        except InputError:
            writer.abort()
            raise
