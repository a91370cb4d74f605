"""One recording cut into scenes: the piece of work of an import.

`cut` is a pure function of the recording and the settings; where it runs does not
matter. Numbers inside the dataset (of vehicles, groups, recordings) are given
later, by the one process that sees all cuts in order.
"""

import dataclasses
import hashlib
import itertools
from collections.abc import Iterator, Mapping

import jax
import numpy as np

from rcirl_jax.data.parts import Item, recordings_in
from rcirl_jax.data.quality import QualityReport
from rcirl_jax.data.scenes.assemble import CHUNK, assemble
from rcirl_jax.data.scenes.collect import Collector
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.errors import InputError, as_input_error
from rcirl_jax.types import Demonstration, Recording, Track

GROUP_BLOCK_S = 60.0  # s; vehicles first seen in one block share a group
MINUTE = "/minute-"  # between a recording's name and the number of a block


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Cut:
    """The scenes of one recording."""

    name: str
    source: str
    licence: str
    rate_hz: float
    sha256: str  # of the recording and of how it is cut
    # numbers of vehicle, group and recording are 0; None: no scene, or known
    scenes: Demonstration | None
    vehicles: list[str]  # name per scene
    groups: list[str]  # vehicle-disjoint group per scene
    quality: dict  # `QualityReport.state()`
    # s, per scene, when the log first saw its vehicle
    first_seen: list[float] = dataclasses.field(default_factory=list)
    log: str = ""  # of which the recording is a piece, or its own name
    known: bool = False  # a committed shard holds it already
    refused: str = ""  # why nothing of it was read, where it is left out
    part: str = ""  # the input it was read from
    progress: float | None = None  # share of the part read after it, if known


def digest(recording: Recording) -> str:
    """sha256 over every compared field; equal inputs give equal datasets."""
    total = hashlib.sha256()
    _hash(total, recording)
    return total.hexdigest()


def _hash(total: "hashlib._Hash", value: object) -> None:
    """Type, length and content, so that no two values run into each other."""
    if dataclasses.is_dataclass(value):
        for field in filter(lambda field: field.compare, dataclasses.fields(value)):
            found = getattr(value, field.name)
            if "in_digest" in field.metadata and found == field.default:
                continue  # a field that came later: digests of before stay
            total.update(f"{field.name}:".encode())
            _hash(total, found)
    elif isinstance(value, np.ndarray):
        total.update(f"{value.dtype}{value.shape}".encode())
        total.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, tuple | list):
        total.update(f"({len(value)}".encode())
        for item in value:
            _hash(total, item)
    else:
        total.update(f"{type(value).__name__}={value!r};".encode())


def group_name(recording: Recording, first_seen_s: float) -> str:
    """Vehicle-disjoint group: the recording's own, or a block of a minute."""
    if recording.group is not None:
        return recording.group
    block = int(first_seen_s // GROUP_BLOCK_S)
    return f"{recording.piece_of or recording.name}{MINUTE}{block:04d}"


def whole_of(group: str) -> str:
    """The recording of which a group is a minute; the group itself if it is none."""
    return group.rpartition(MINUTE)[0] or group


def cut(
    recording: Recording, config: CollectConfig, done: Mapping[str, str] | None = None
) -> Cut:
    """All scenes of a recording.

    Args:
      recording: validated.
      config: what is collected.
      done: sha256 by name of recordings that committed shards hold.

    Raises:
      InputError: `done` has a recording of this name cut from another input or
        with other settings.
    """
    sha256 = hashlib.sha256((digest(recording) + repr(config)).encode()).hexdigest()
    about = {
        "name": recording.name,
        "source": recording.source,
        "licence": recording.licence,
        "rate_hz": recording.rate_hz,
        "sha256": sha256,
        "progress": recording.progress,
        "log": recording.piece_of or recording.name,
    }
    lists = {"vehicles": [], "groups": [], "first_seen": []}
    nothing = {"scenes": None, "quality": {}, **lists}
    if recording.name in (done or {}):
        if done and done[recording.name] != sha256:
            raise InputError(
                f"{recording.name}: input or settings changed since the interrupted "
                "import: expected the same; use another output folder"
            )
        return Cut(**about, **nothing, known=True)
    if recording.refused:
        report = QualityReport()
        report.add_refusal(recording)
        refused = {"quality": report.state(), "refused": recording.refused}
        return Cut(**about, **{**nothing, **refused})
    if not recording.tracks:
        report = QualityReport()
        report.add_empty(recording)
        return Cut(**about, **{**nothing, "quality": report.state()})
    with as_input_error(recording.name, "a sound recording"):
        collector = Collector(recording, config)
        parts, tracks = _assembled(collector)
    report = QualityReport()
    report.add_recording(collector)
    if not tracks:
        return Cut(**about, **{**nothing, "quality": report.state()})
    scenes = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    report.add_scenes(scenes)
    groups = [group_name(recording, track.first_seen_s) for track in tracks]
    return Cut(
        **about,
        scenes=scenes,
        vehicles=[f"{g}:{t.id}" for g, t in zip(groups, tracks, strict=True)],
        groups=groups,
        first_seen=[track.first_seen_s for track in tracks],
        quality=report.state(),
    )


def _assembled(
    collector: Collector,
) -> tuple[list[Demonstration], list[Track]]:
    """Scenes as they are stored, a few at a time, and the track of each.

    A row before it is assembled takes more than twice the memory.
    """
    parts, tracks, rows = [], [], collector.scenes()
    while some := list(itertools.islice(rows, CHUNK)):
        none = [0] * len(some)
        parts.append(assemble(some, vehicles=none, groups=none, recording=0))
        tracks += [collector.recording.tracks[row["track"]] for row in some]
    return parts, tracks


def cut_item(
    item: Item, config: CollectConfig, done: Mapping[str, str] | None = None
) -> Iterator[Cut]:
    """A part, read here, or one recording of it; other arguments as `cut`."""
    for part, recording in recordings_in(item):
        made = cut(recording, config, done)
        yield dataclasses.replace(made, part=str(part.input))
