"""What columns are called (data_specs/column_names.toml); for suggestions only."""

import functools
import re
from collections.abc import Sequence

from rcirl_jax.data.formats.csv.columns import WORD, words_of
from rcirl_jax.runtime.specs import load_toml, spec_root


@functools.cache
def _words() -> dict:
    """The words of data_specs/column_names.toml."""
    return load_toml(spec_root() / "column_names.toml")


def plain_words(name: str) -> list[str]:
    """Returns words of a column's name without those of a unit; owners stand apart."""
    bare = re.sub(r"[\[(].*?[\])]", " ", name)
    units = {
        text for texts in _words()["units"].values() for text in texts if len(text) > 1
    }
    words, owners = [], _words()["owners"]
    for word in (found.lower() for found in re.findall(rf"{WORD}|\d+", bare)):
        glued = (o for o in owners if word.startswith(o) and len(word) > len(o) + 1)
        owner = next(glued, "")  # plurals stay whole
        words += [owner, word.removeprefix(owner)] if owner else [word]
    return [w for w in words if w not in units and w not in ("kf", "smoothed", "raw")]


def unit_of(name: str, allowed: Sequence[str]) -> str:
    """Returns the unit that a column's name says, "" without one."""
    said = re.findall(r"[\[(]\s*(.+?)\s*[\])]", name)
    said += [name.rsplit("_", 1)[-1]] if "_" in name else []
    for text in said:
        for unit in allowed:
            if text.lower() in _words()["units"].get(unit, ()):
                return unit
    return ""


def fields_by_name(header: Sequence[str]) -> dict[str, str]:
    """Returns field -> column, as far as names tell; each column once."""
    words = {name: plain_words(name) for name in header if name}
    met = [word for own in words.values() for word in set(own)]
    common = {w for w in met if len(words) > 3 and met.count(w) > len(words) / 2}
    found: dict[str, str] = {}
    every_word = _words()
    for field, known in every_word["fields"].items():
        scores = {}  # how badly a name fits: words too many, and how unlikely it is
        for name, every in words.items():
            own = [word for word in every if word not in common] or every
            hits = [known.index(word) for word in own if word in known]
            is_other = not set(every_word["other"]).isdisjoint(own) or (
                field in ("x", "y", "lat", "lon")
                and not set(every_word["motion"]).isdisjoint(own)
            )
            if name in found.values():
                continue
            if (joined := "".join(own)) in known:
                scores[name] = 0, known.index(joined)
            elif hits and not is_other:
                scores[name] = len(set(own)) - 1, min(hits)
        if scores:
            found[field] = min(scores, key=lambda name: scores[name])
    others = ("x", "y") if {"lat", "lon"} <= found.keys() else ("lat", "lon")
    return {field: name for field, name in found.items() if field not in others}


def kind_by_name(text: str) -> str:
    """Returns the kind of a road user by a word of a name; "" unknown."""
    words = words_of(text) | {text.lower()}
    for kind in ("cyclist", "pedestrian", "static", "vehicle"):
        if any(word in _words()["kinds"][kind] for word in words):
            return kind
    return ""
