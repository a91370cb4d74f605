"""Roads of recordings whose log gives none, of all files of an import together.

A reader says that lanes are missing (`Recording.open_roads`). Files of one import that
show one place then have the same lanes, of the tracks of all, and so have the pieces of
a long file.
"""

import dataclasses
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.recording import accepted
from rcirl_jax.data.roads import (
    SURE,
    Numbered,
    Roads,
    roads_from_tracks,
    roads_of_sites,
)
from rcirl_jax.errors import InputError
from rcirl_jax.types import OpenRoads, Recording

BESIDE = "beside"  # in a spec: files of the import whose roads are pooled
MAX_FILES = 12  # of these, evenly
MAX_PLACES = 60  # of these files, those with most driving
THIN_HZ = 5.0  # 1/s, of tracks that roads are estimated from

Read = Callable[[Path, dict], Iterator[Recording]]
_SITES: dict[str, "Sites"] = {}  # of one import at a time


def beside(files: Sequence[Path]) -> list[str]:
    """Returns the files of an import whose roads are pooled."""
    chosen = np.linspace(0, len(files) - 1, min(len(files), MAX_FILES)).round()
    return [str(files[int(n)]) for n in chosen]


def with_roads(name: str, read: Read, path: Path, spec: dict) -> Iterator[Recording]:
    """Yields the recordings of a file, with estimated lanes where it gives none.

    Those of the only file are taken alone, unless they are pieces of a long one.
    """
    files = [Path(file) for file in spec.get(BESIDE, [str(path)])]
    for made in read(path, spec):
        if (wanted := made.open_roads) is None:
            yield made
            continue
        is_alone = len(files) == 1 and made.piece_of is None
        if is_alone:
            roads = roads_from_tracks(
                made.tracks,
                width=wanted.width,
                limit=wanted.limit,
                labels=wanted.labels,
            )
        else:
            key = json.dumps([name, spec], sort_keys=True, default=str)
            if key not in _SITES:
                _SITES.clear()
                _SITES[key] = Sites(read, files, spec)
            roads = _SITES[key].roads_of(made, path).moved(-np.array(made.origin))
        note = f"{wanted.why}; {roads.note}" if wanted.why else roads.note
        made = dataclasses.replace(
            made, lanes=roads.lanes, open_roads=None, notes=(note, *made.notes)
        )
        yield accepted(lambda made=made: made, made.name, path, spec)


class Sites:
    """The sites that files show, and the roads of each."""

    def __init__(self, read: Read, files: Sequence[Path], spec: dict) -> None:
        self._read, self._spec = read, spec
        driven: dict[tuple[Path, str], list[Numbered]] = {}
        wanted = None
        for file in files:
            found, own = self._driven(file)
            driven |= found
            wanted = wanted or own
        most = sorted(driven, key=lambda one: -sum(x.t.size for x, _ in driven[one]))
        known = [one for one in driven if one in set(most[:MAX_PLACES])]
        self._known: dict[tuple[Path, str], Roads] = {}
        if wanted is not None:
            roads = roads_of_sites(
                [driven[one] for one in known], width=wanted.width, limit=wanted.limit
            )
            self._known = dict(zip(known, roads, strict=True))
        self._sites = [*{id(x): x for x in self._known.values()}.values()]

    def roads_of(self, made: Recording, path: Path) -> Roads:
        """Returns the roads of a recording, in the log's frame."""
        wanted = made.open_roads
        assert wanted is not None
        place = path, wanted.place
        if place not in self._known:
            driven = [*_thinned(made, wanted)]
            if made.piece_of is not None:
                driven = self._driven(path)[0].get(place, driven)
            tracks = [track for track, _ in driven]
            fits = (site for site in self._sites if site.explains(tracks) >= SURE)
            self._known[place] = (
                next(fits, None)
                or roads_of_sites([driven], width=wanted.width, limit=wanted.limit)[0]
            )
        return self._known[place]

    def _driven(
        self, file: Path
    ) -> tuple[dict[tuple[Path, str], list[Numbered]], OpenRoads | None]:
        """The tracks of a file by place, as far as their roads are open.

        A file that cannot be read says so when it is imported itself.
        """
        found: dict[tuple[Path, str], list[Numbered]] = {}
        wanted = None
        try:
            for made in self._read(file, self._spec):
                own = made.open_roads
                if own is not None:
                    wanted = own
                    found.setdefault((file, own.place), []).extend(_thinned(made, own))
        except InputError:
            return {}, None
        return found, wanted


def _thinned(made: Recording, wanted: OpenRoads) -> Iterator[Numbered]:
    """Yields a recording's tracks in the log's frame, with fewer samples."""
    step = max(round(made.rate_hz / THIN_HZ), 1)
    labels = wanted.labels or [np.full(x.t.size, "") for x in made.tracks]
    for track, label in zip(made.tracks, labels, strict=True):
        thin = {n: getattr(track, n)[::step] for n in ("t", "heading", "speed")}
        place = {
            name: getattr(track, name)[::step] + made.origin[at]
            for at, name in enumerate(("x", "y"))
        }
        yield dataclasses.replace(track, **thin, **place), label[::step].copy()
