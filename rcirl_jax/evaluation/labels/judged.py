"""Labels compared with a person's verdicts on recorded scenes.

The verdicts (data_specs/labels/judged_scenes.json) name a scene and one obstacle and
say what happened. The recordings are read and cut anew, as an import does it, and
the labels of those obstacles compared.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
import numpy as np

from rcirl_jax.data.formats import read_recordings
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
MAX_LOST = 0.05  # of the scenes, which an import may drop by now


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


Found = tuple[Judged, dict, int | None]  # verdict, row of its scene, obstacle's slot


def measure_judged(found: Sequence[Found]) -> dict[str, tuple[ClassScore, ...]]:
    """Scores of each batch, and of "all" of them."""
    pairs = [
        (one.batch, *pair)
        for one, row, slot in found
        for pair in _pairs(one, row, slot)
    ]
    batches = sorted({one.batch for one, _, _ in found})
    return {
        batch: class_scores(
            (*dict.fromkeys(TRUTH.values()), CUT_IN),
            [pair[1:] for pair in pairs if batch in (pair[0], "all")],
        )
        for batch in (*batches, "all")
    }


def judged_scenes(verdicts: Verdicts, data: Path) -> list[Found]:
    """Every verdict with its scene, cut anew.

    Args:
      verdicts: what a person said.
      data: folder of the sites' recordings.

    Raises:
      InputError: no recordings there, or a scene that the import does not keep.
    """
    found: list[Found] = []
    for name, site in verdicts.sites.items():
        wanted = [one for one in verdicts.scenes if one.site == name]
        for made in read_recordings(site.format, data / site.folder):
            here = [one for one in wanted if one.recording == made.name]
            found += scenes_of(made, here)
    lost = len(verdicts.scenes) - len(found)
    if lost > MAX_LOST * len(verdicts.scenes):
        raise InputError(
            f"{data}: {lost} of {len(verdicts.scenes)} judged scenes are not there: "
            "expected the recordings that the verdicts were made of"
        )
    return found


def scenes_of(recording: Recording, judged: Sequence[Judged]) -> Iterator[Found]:
    """The verdicts on a recording, each with its scene."""
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
            yield one, row, named[0] if named else None


def _pairs(one: Judged, row: dict, slot: int | None) -> list[tuple[str, str]]:
    """(truth, label) of a decision and of a cut-in; without a slot it is ignored."""
    decision = Decision.IGNORE if slot is None else Decision(row["decisions"][slot])
    label = "nudge" if decision in NUDGES else decision.name.lower()
    cuts = False
    if slot is not None:
        scene = {name: np.asarray(row[name]) for name in manoeuvres.FIELDS}
        cuts = bool(manoeuvres.cuts_in(manoeuvres.meetings(scene))[slot])
    said = (CUT_IN if one.cut_in else "", CUT_IN if cuts else "")
    return [(TRUTH[one.verdict], label), said]
