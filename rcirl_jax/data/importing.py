"""Import: log files -> a dataset on disk; resumable; all or nothing on bad input.

The unit of work is a recording: parsed, cut into scenes, labelled. Consecutive
recordings fill a shard. A shard's lineage holds what later recordings need to
continue as if nothing had happened (names and quality sums), so an interrupted
import resumes to the same bytes.
"""

import dataclasses
import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tqdm

from rcirl_jax.data.assemble import assemble
from rcirl_jax.data.collect import Collector
from rcirl_jax.data.config import CollectConfig
from rcirl_jax.data.quality import QualityReport
from rcirl_jax.data.splits import assign_groups
from rcirl_jax.data.store import DatasetWriter, Manifest
from rcirl_jax.errors import InputError
from rcirl_jax.types import Demonstration, Recording

GROUP_BLOCK_S = 60.0  # s; vehicles first seen in one block share a group
SHARD_SCENES = 4096  # scenes after which a shard is closed


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImportConfig:
    """What the manifest records of how a dataset was made."""

    format: str  # importer, for provenance
    collect: CollectConfig = dataclasses.field(default_factory=CollectConfig)
    # share of scenes held out, by vehicle-disjoint group
    test_fraction: float = 0.25
    split_seed: int = 0


class _Numbers:
    """Numbers for names, in order of first appearance."""

    def __init__(self) -> None:
        self.table: dict[str, int] = {}

    def of(self, name: str) -> int:
        return self.table.setdefault(name, len(self.table))

    def names(self) -> list[str]:
        return list(self.table)


def digest(recording: Recording) -> str:
    """sha256 over what a recording holds; equal inputs give equal datasets."""
    total = hashlib.sha256(f"{recording.name} {recording.rate_hz}".encode())
    for track in recording.tracks:
        total.update(f"{track.id} {track.kind} {track.length} {track.width}".encode())
        for values in (track.t, track.x, track.y, track.heading, track.speed):
            total.update(np.ascontiguousarray(values, np.float64).tobytes())
    for lane in recording.lanes:
        total.update(lane.id.encode())
        total.update(np.ascontiguousarray(lane.centre, np.float64).tobytes())
    return total.hexdigest()


def group_name(recording: Recording, first_seen_s: float) -> str:
    """Vehicle-disjoint group: the recording's own, or a block of a minute."""
    if recording.group is not None:
        return recording.group
    block = int(first_seen_s // GROUP_BLOCK_S)
    return f"{recording.name}/minute-{block:04d}"


class _Import:
    """State of one import: names, quality, the open shard."""

    def __init__(self, writer: DatasetWriter, config: ImportConfig) -> None:
        self.writer, self.config = writer, config
        self.recordings, self.groups = _Numbers(), _Numbers()
        self.vehicles = _Numbers()
        self.quality = QualityReport()
        self.sizes: dict[str, int] = {}
        self.pending: list[Demonstration] = []
        self.lineage: list[dict] = []
        self.sources: dict[str, str] = {}
        self.rates: list[float] = []
        self.next_shard = 0
        self.done: list[dict] = []
        for info in writer.committed():
            self.done += info.lineage
            self.next_shard += 1

    def add(self, recording: Recording) -> int:
        """Process one recording; returns the number of scenes kept."""
        if recording.name in self.recordings.table:
            raise InputError(f"{recording.name}: name: met twice: expected once")
        self.sources[recording.source] = recording.licence
        self.rates.append(recording.rate_hz)
        number = self.recordings.of(recording.name)
        if self.done:
            return self._replay(self.done.pop(0), recording)
        collector = Collector(recording, self.config.collect)
        rows = list(collector.scenes())
        report = QualityReport()
        report.add_recording(collector)
        entry: dict[str, Any] = {
            "name": recording.name,
            "sha256": self._digest(recording),
        }
        entry["vehicles"], entry["groups"] = self._names(recording, rows)
        if rows:
            block = assemble(
                rows,
                vehicles=[self.vehicles.of(name) for name in entry["vehicles"]],
                groups=[self.groups.of(name) for name in entry["groups"]],
                recording=number,
            )
            report.add_scenes(block)
            self.pending.append(block)
        entry["quality"] = report.state()
        self._count(entry)
        self.lineage.append(entry)
        if sum(block.vehicle.shape[0] for block in self.pending) >= SHARD_SCENES:
            self._close_shard()
        return len(rows)

    def _digest(self, recording: Recording) -> str:
        """Of the recording and of how it is cut, so that no import mixes both."""
        return hashlib.sha256(
            (digest(recording) + repr(self.config.collect)).encode()
        ).hexdigest()

    def _names(self, recording: Recording, rows: list[dict]) -> tuple[list, list]:
        tracks = [recording.tracks[row["track"]] for row in rows]
        vehicles = [f"{group_name(recording, t.t[0])}:{t.id}" for t in tracks]
        groups = [group_name(recording, t.t[0]) for t in tracks]
        return vehicles, groups

    def _count(self, entry: dict) -> None:
        self.quality.merge(entry["quality"])
        for name in entry["groups"]:
            self.sizes[name] = self.sizes.get(name, 0) + 1

    def _replay(self, entry: dict, recording: Recording) -> int:
        """Take over what a committed shard already holds of this recording."""
        expected = (recording.name, self._digest(recording))
        if (entry["name"], entry["sha256"]) != expected:
            raise InputError(
                f"{recording.name}: input or settings changed since the interrupted "
                "import: expected the same; use another --output"
            )
        for vehicle, group in zip(entry["vehicles"], entry["groups"], strict=True):
            self.vehicles.of(vehicle)
            self.groups.of(group)
        self._count(entry)
        return len(entry["vehicles"])

    def _close_shard(self) -> None:
        if not self.pending:
            return
        joined = jax.tree.map(lambda *x: np.concatenate(x), *self.pending)
        self.writer.write_shard(self.next_shard, joined, self.lineage)
        self.next_shard += 1
        self.pending, self.lineage = [], []

    def finish(self) -> Manifest:
        """Close the last shard and commit the dataset."""
        self._close_shard()
        if self.quality.scenes == 0:
            drops = {k: v for k, v in self.quality.dropped.items() if v}
            raise InputError(
                f"import: 0 scenes kept of {self.quality.tracks} tracks: "
                f"dropped because {drops}: expected at least one scene"
            )
        fraction = self.config.test_fraction if len(self.sizes) > 1 else 0.0
        splits = assign_groups(
            self.sizes, test_fraction=fraction, seed=self.config.split_seed
        )
        return self.writer.finish(
            {
                "rate_hz": sorted(set(self.rates)),
                "sources": [
                    {"source": source, "licence": licence}
                    for source, licence in sorted(self.sources.items())
                ],
                "recordings": self.recordings.names(),
                "groups": self.groups.names(),
                "vehicles": self.vehicles.names(),
                "splits": splits,
                "quality": self.quality.as_dict(),
                "import": dataclasses.asdict(self.config),
            }
        )


def import_logs(
    recordings: Iterable[Recording],
    output: str | Path,
    config: ImportConfig,
    *,
    overwrite: bool = False,
) -> Manifest:
    """Import recordings into a dataset; shows scenes/s.

    Args:
      recordings: from `importers.read_recordings`.
      output: dataset folder or tensorstore URL.
      config: collection and split settings.
      overwrite: replace a finished dataset.

    Returns:
      The manifest of the finished dataset.

    Raises:
      InputError: bad input. Nothing of this import stays on disk then; an
        interrupt keeps finished shards, and the next run resumes from them.
    """
    writer = DatasetWriter(str(output), overwrite=overwrite)
    try:
        work = _Import(writer, config)
        with tqdm.tqdm(desc="import", unit="scene", mininterval=0.5) as bar:
            for recording in recordings:
                bar.update(work.add(recording))
                dropped = sum(work.quality.dropped.values())
                bar.set_postfix(
                    recording=recording.name, dropped=dropped, refresh=False
                )
        return work.finish()
    except InputError:
        writer.abort()
        raise
