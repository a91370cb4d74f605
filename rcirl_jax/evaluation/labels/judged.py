"""Labels against verdicts of a person on recorded scenes.

The verdicts (data_specs/labels/judged_scenes.json) name a scene and one obstacle and
say what happened. The recordings are read and cut anew, as an import does it, and
the labels of those obstacles compared.
"""

import json
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np

from rcirl_jax.data.importers import read_recordings
from rcirl_jax.data.scenes import manoeuvres
from rcirl_jax.data.scenes.collect import Collector
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.labels.scores import ClassScore, class_scores
from rcirl_jax.runtime.specs import spec_root
from rcirl_jax.types import Decision, Recording

# what a label should be where a person says so
TRUTH = {
    "none": "ignore",
    "pass": "ignore",
    "follow": "follow",
    "yield": "yield",
    "overtake": "overtake",
    "nudge": "nudge",
}
CUT_IN = "cut_in"  # beside the decision, yes or no
NUDGES = (Decision.NUDGE_LEFT, Decision.NUDGE_RIGHT)
SAME_TIME_S = 1e-3  # s


class Judged(msgspec.Struct, frozen=True, array_like=True):
    """One verdict: the columns of the file."""

    batch: str
    site: str
    recording: str
    track: str
    time_s: float
    obstacle: str
    verdict: str
    cut_in: bool


class Site(msgspec.Struct, frozen=True):
    """Where recordings lie below the folder of all data."""

    format: str
    folder: str


class Verdicts(msgspec.Struct, frozen=True):
    """The file; its other keys are for readers."""

    sites: dict[str, Site]
    scenes: list[Judged]


Pair = tuple[str, str, str]  # batch, truth, label


def read_verdicts(path: Path | None = None) -> Verdicts:
    """The verdicts of a file, by default the packaged ones.

    Raises:
      InputError: the file is none of verdicts.
    """
    path = path or spec_root() / "labels" / "judged_scenes.json"
    try:
        found = msgspec.convert(json.loads(path.read_text()), Verdicts)
    except (OSError, ValueError, msgspec.ValidationError) as error:
        raise InputError(f"{path}: {error}: expected judged scenes") from error
    for one in found.scenes:
        if one.verdict not in TRUTH or one.site not in found.sites:
            raise InputError(
                f"{path}: {one.recording} {one.track}: {one.site}, {one.verdict}: "
                f"expected a known site, and one of {', '.join(TRUTH)}"
            )
    return found


def measure_judged(verdicts: Verdicts, data: Path) -> dict[str, tuple[ClassScore, ...]]:
    """Scores of each batch, and of "all" of them.

    Args:
      verdicts: what a person said.
      data: folder of the sites' recordings.

    Raises:
      InputError: no recordings there, or a scene that the import does not keep.
    """
    pairs: list[Pair] = []
    for name, site in verdicts.sites.items():
        wanted = [one for one in verdicts.scenes if one.site == name]
        for made in read_recordings(site.format, data / site.folder):
            pairs += compare(
                made, [one for one in wanted if one.recording == made.name]
            )
    if len(pairs) != 2 * len(verdicts.scenes):
        raise InputError(
            f"{data}: {len(pairs) // 2} of {len(verdicts.scenes)} judged scenes: "
            "expected all of them; verdicts hold for the recordings they were made of"
        )
    batches = sorted({one.batch for one in verdicts.scenes})
    return {
        batch: class_scores(
            (*dict.fromkeys(TRUTH.values()), CUT_IN),
            [pair[1:] for pair in pairs if batch in (pair[0], "all")],
        )
        for batch in (*batches, "all")
    }


def compare(recording: Recording, judged: list[Judged]) -> Iterator[Pair]:
    """(batch, truth, label) of each verdict on a recording, and of its cut-in."""
    if not judged:
        return
    collector = Collector(recording, CollectConfig())
    by_scene: dict[tuple[str, int], list[Judged]] = {}
    for one in judged:
        frame = round(one.time_s * recording.rate_hz)
        by_scene.setdefault((one.track, frame), []).append(one)
    ids = [track.id for track in collector.recording.tracks]
    for row in collector.scenes():
        for one in by_scene.get((ids[row["track"]], int(row["frame"])), ()):
            slots = [i for i, t in enumerate(row["obstacles.track"]) if t >= 0]
            named = [i for i in slots if ids[row["obstacles.track"][i]] == one.obstacle]
            yield from _pairs(row, named[0] if named else None, one)


def _pairs(row: dict, slot: int | None, one: Judged) -> Iterator[Pair]:
    """The pairs of one verdict; an obstacle without a slot is ignored."""
    decision = Decision.IGNORE if slot is None else Decision(row["decisions"][slot])
    label = "nudge" if decision in NUDGES else decision.name.lower()
    yield one.batch, TRUTH[one.verdict], label
    cuts = False
    if slot is not None:
        scene = {name: np.asarray(row[name]) for name in manoeuvres.FIELDS}
        cuts = bool(manoeuvres.cuts_in(manoeuvres.meetings(scene))[slot])
    yield one.batch, CUT_IN if one.cut_in else "", CUT_IN if cuts else ""
