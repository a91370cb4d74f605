"""Automatic labels beside the verdicts of a person, scene by scene.

judged_scenes.json names a scene, one obstacle and what happened;

    precision = right / predicted,   recall = right / true

are counted of each decision and of cut-ins, with exact binomial intervals.
"""

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import msgspec
import numpy as np

from rcirl_jax.data.formats import read_recordings
from rcirl_jax.data.scenes import manoeuvres
from rcirl_jax.data.scenes.collect import Collector
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.statistics import clopper_pearson
from rcirl_jax.types import Decision, Recording

VERDICTS = Path(__file__).parent / "judged_scenes.json"
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
    """A place of recordings below the folder of all data."""

    format: str
    folder: str


class Verdicts(msgspec.Struct, frozen=True):
    """The file; its other keys are for readers."""

    sites: dict[str, Site]
    scenes: list[Judged]


# a verdict, (true decision, labelled one), (truly cuts in, labelled so)
Compared = tuple[Judged, tuple[str, str], tuple[bool, bool]]


def read_verdicts(path: Path = VERDICTS) -> Verdicts:
    """Returns the verdicts of a file."""
    return msgspec.convert(json.loads(path.read_text()), Verdicts)


def compare(verdicts: Verdicts, data: Path) -> list[Compared]:
    """Labels every judged scene anew.

    Args:
      verdicts: what a person said.
      data: folder of the sites' recordings.

    Raises:
      InputError: more than `MAX_LOST` of the scenes are not found.
    """
    found: list[Compared] = []
    for name, site in verdicts.sites.items():
        wanted = [one for one in verdicts.scenes if one.site == name]
        for made in read_recordings(site.format, data / site.folder):
            found += compare_in(made, [x for x in wanted if x.recording == made.name])
    lost = len(verdicts.scenes) - len(found)
    if lost > MAX_LOST * len(verdicts.scenes):
        raise InputError(
            f"{data}: {lost} of {len(verdicts.scenes)} judged scenes are not there: "
            "expected the recordings that the verdicts were made of"
        )
    return found


def compare_in(recording: Recording, judged: Sequence[Judged]) -> Iterator[Compared]:
    """Yields the verdicts on one recording beside its labels."""
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
            slots = [ids[t] if t >= 0 else "" for t in row["obstacles.track"]]
            label, cuts = "ignore", False  # of one without a slot
            if one.obstacle in slots:
                slot = slots.index(one.obstacle)
                decision = Decision(row["decisions"][slot])
                label = "nudge" if decision in NUDGES else decision.name.lower()
                scene = {name: np.asarray(row[name]) for name in manoeuvres.FIELDS}
                cuts = bool(manoeuvres.cuts_in(manoeuvres.meetings(scene))[slot])
            yield one, (TRUTH[one.verdict], label), (one.cut_in, cuts)


def scores(found: Sequence[Compared]) -> dict[str, list[dict]]:
    """Returns a row of numbers per class, of each batch and of "all"."""
    table = {}
    for batch in (*sorted({one.batch for one, *_ in found}), "all"):
        some = [x[1:] for x in found if batch in (x[0].batch, "all")]
        rows = [
            _score(name, [(a == name, b == name) for (a, b), _ in some])
            for name in dict.fromkeys(TRUTH.values())
        ]
        table[batch] = [*rows, _score(CUT_IN, [cuts for _, cuts in some])]
    return table


def _score(name: str, pairs: Iterable[tuple[bool, bool]]) -> dict:
    pairs = list(pairs)
    right = sum(truth and label for truth, label in pairs)
    wrong = sum(label and not truth for truth, label in pairs)
    missed = sum(truth and not label for truth, label in pairs)

    def rate(n: int) -> list[float] | None:
        return [right / n, *clopper_pearson(right, n)] if n else None

    return {
        "name": name, "true": right + missed, "right": right, "wrong": wrong,
        "missed": missed, "precision": rate(right + wrong),
        "recall": rate(right + missed),
    }  # fmt: skip
