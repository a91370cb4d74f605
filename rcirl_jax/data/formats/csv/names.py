"""The meaning of names of columns, by data_specs/column_names.toml."""

import functools
import re
import unicodedata
from collections.abc import Sequence

from rcirl_jax.runtime.specs import load_toml, spec_root

WORD = r"[A-Z]+(?![^\W\d_A-Z])|[A-Z]?[^\W\d_A-Z]+"  # of a name in camel case too
PIXELS = {"px", "pix", "pixel", "pixels"}  # words of a name, of no use as metres
PICTURE = {"img", "image", "bild"}  # likewise, of a place
LISTS = ("other", "not_middle", "motion")  # of words, beside the sections
SECTIONS = ("fields", "compass", "kinds")
ENDINGS = "aeiouys"  # of cases and numbers, without accents, that words differ by


def words_of(name: str) -> set[str]:
    """Returns words of a column's name: gpsLon and GPS_Lon hold lon."""
    return {word.lower() for word in re.findall(WORD, name)}


@functools.cache
def every_word() -> dict:
    """Returns the names of columns, of data_specs/column_names.toml."""
    return load_toml(spec_root() / "column_names.toml")


def foreign_words() -> list[str]:
    """Returns the words of fields and kinds that are not of ASCII alone."""
    lists = [words for part in SECTIONS for words in every_word()[part].values()]
    return [word for words in lists for word in words if not word.isascii()]


def _bare(word: str) -> str:
    """A word without its accents."""
    letters = unicodedata.normalize("NFKD", word)
    return "".join(letter for letter in letters if not unicodedata.combining(letter))


@functools.cache
def _known_words() -> tuple[set[str], dict[str, str]]:
    """The words that are known as they are, and those by their letters."""
    every = every_word()
    lists = [words for part in SECTIONS for words in every[part].values()]
    lists += [every[name] for name in LISTS]
    known = [word for words in lists for word in words]
    return {*known}, {_bare(word): word for word in reversed(known)}


def base_of(word: str) -> str:
    """Returns the known word of which a word is a case or number, else the word.

    So "času", "délky", "prędkości" and "tracks" are čas, délka, prędkość and track.
    """
    known, by_letters = _known_words()
    bare = _bare(word)
    if word in known or len(bare) < 4:
        return word
    ends = ("", "a", "o") if bare[-1] in ENDINGS else ()
    forms = (bare, *(bare[:-1] + end for end in ends))
    return next((by_letters[form] for form in forms if form in by_letters), word)


def plain_words(name: str) -> list[str]:
    """Returns words of a column's name without those of a unit; owners stand apart.

    What is a case or number of a known word is that word.
    """
    bare = re.sub(r"[\[(].*?[\])]", " ", with_unit_apart(name))
    every = every_word()
    written = [text for texts in every["units"].values() for text in texts]
    units = {text for text in written if len(text) > 1}
    words, owners = [], every["owners"]
    for word in (found.lower() for found in re.findall(rf"{WORD}|\d+", bare)):
        glued = (o for o in owners if word.startswith(o) and len(word) > len(o) + 1)
        owner = next(glued, "")  # plurals stay whole
        words += [owner, word.removeprefix(owner)] if owner else [word]
    left_out = {*units, "kf", "smoothed", "raw"}
    return [base_of(word) for word in words if word not in left_out]


def with_unit_apart(name: str) -> str:
    """Returns "headX [ft]" of "headXft": a unit that is glued to a coordinate."""
    return re.sub(r"([XY])(ft|m|cm|px|pix|pixels?)$", r"\1 [\2]", name)


def compass_axis(name: str) -> str:
    """Returns x for a name that says east, y: north, heading: a compass's, else ""."""
    words = set(plain_words(name))
    said = [axis for axis, own in every_word()["compass"].items() if words & {*own}]
    return said[0] if len(said) == 1 else ""


def is_no_place(name: str, header: Sequence[str]) -> bool:
    """True for a coordinate of another point than the middle, or perhaps in pixels.

    A column without a unit is one of pixels where another is called alike, with a unit.
    """
    if not set(every_word()["not_middle"]).isdisjoint(plain_words(name)):
        return True
    twin = re.compile(rf"{re.escape(name)}[ _]?[\[(]?(ft|feet|m|met(er|re)s?|cm)[\])]?")
    return any(twin.fullmatch(other) for other in header)


def is_in_pixels(name: str) -> bool:
    """True for a place or size in a picture, by its name."""
    words = words_of(with_unit_apart(name))
    if re.match(r"px(?![^\W\d_])", name, re.IGNORECASE):
        words.discard("px")  # position along x, as py is along y
    return bool(words & PIXELS or (words & PICTURE and words & {"x", "y"}))


def unit_of(name: str, allowed: Sequence[str]) -> str:
    """Returns the unit that a column's name says, "" without one."""
    name = with_unit_apart(name)
    said = re.findall(r"[\[(]\s*(.+?)\s*[\])]", name)
    said += [name.rsplit("_", 1)[-1]] if "_" in name else []
    for text in said:
        for unit in allowed:
            if text.lower() in every_word()["units"].get(unit, ()):
                return unit
    return ""


def fields_by_name(header: Sequence[str]) -> dict[str, str]:
    """Returns field -> column, as far as names tell; each column once."""
    words = {name: plain_words(name) for name in header if name}
    met = [word for own in words.values() for word in set(own)]
    common = {w for w in met if len(words) > 3 and met.count(w) > len(words) / 2}
    words = {name: own for name, own in words.items() if not is_in_pixels(name)}
    found: dict[str, str] = {}
    axes = {name: compass_axis(name) for name in words}
    if not {"x", "y"} <= {*axes.values()}:  # one alone may be another word: x_est
        axes = {}
    for field, letters in every_word()["fields"].items():
        known = [*letters, *every_word()["compass"].get(field, ())]
        scores = {}  # how badly a name fits: words too many, and how unlikely it is
        for name, every in words.items():
            own = [word for word in every if word not in common] or every
            hits = [known.index(word) for word in own if word in known]
            is_other = not set(every_word()["other"]).isdisjoint(own) or (
                field in ("x", "y", "lat", "lon")
                and not set(every_word()["motion"]).isdisjoint(own)
            )
            if name in found.values() or axes.get(name, "") not in ("", field):
                continue
            last = field in ("x", "y") and is_no_place(name, header)
            if (joined := "".join(own)) in known:
                scores[name] = last, 0, known.index(joined)
            elif hits and not is_other:
                scores[name] = last, len(set(own)) - 1, min(hits)
        if scores:
            found[field] = min(scores, key=lambda name: scores[name])
        if field == "lon" and not {"lat", "lon"} <= found.keys():
            found = {k: v for k, v in found.items() if k not in ("lat", "lon")}
    others = ("x", "y") if {"lat", "lon"} <= found.keys() else ("lat", "lon")
    return {field: name for field, name in found.items() if field not in others}


def kind_by_name(text: str) -> str:
    """Returns the kind of a road user by a word of a name; "" unknown."""
    words = {*map(base_of, words_of(text)), text.lower()}
    for kind in ("cyclist", "pedestrian", "static", "vehicle"):
        if any(word in every_word()["kinds"][kind] for word in words):
            return kind
    return ""
