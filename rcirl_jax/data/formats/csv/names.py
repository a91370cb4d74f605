"""What columns of tables are called, in several languages; for suggestions only."""

import re
from collections.abc import Mapping, Sequence

from rcirl_jax.data.formats.csv.mapping import WORD, words_of

# field -> words of a name, the likelier first
WORDS: Mapping[str, tuple[str, ...]] = {
    "t": (
        *("timestamp", "time", "t", "datetime", "zeitstempel", "zeit", "epoch", "utc"),
        *("timestep", "clock", "temps", "tiempo", "tempo", "seconds", "sec", "frame"),
    ),
    "lat": ("lat", "latitude", "breitengrad"),
    "lon": ("lon", "lng", "long", "longitude", "längengrad", "laengengrad"),
    "x": (
        *("x", "xcenter", "xcentre", "xloc", "xpos", "posx", "east", "easting"),
        *("ost", "ostwert", "rechtswert", "utmx", "e"),
    ),
    "y": (
        *("y", "ycenter", "ycentre", "yloc", "ypos", "posy", "north", "northing"),
        *("nord", "nordwert", "hochwert", "utmy", "n"),
    ),
    "vx": ("vx", "xvelocity", "velx", "velocityx", "speedx", "veast", "ve"),
    "vy": ("vy", "yvelocity", "vely", "velocityy", "speedy", "vnorth", "vn"),
    "heading": (
        *("heading", "yaw", "psi", "course", "orientation", "angle", "azimuth", "hdg"),
        *("bearing", "cap", "kurs", "richtung", "theta"),
    ),
    "speed": (
        *("speed", "velocity", "v", "vel", "geschwindigkeit", "vitesse", "velocidad"),
    ),
    "length": ("length", "len", "laenge", "länge", "longueur"),
    "width": ("width", "breite", "largeur", "ancho"),
    "kind": (
        *("class", "type", "kind", "category", "klasse", "typ", "classe", "clase"),
        "art",
    ),
    "lane": ("lane", "spur", "fahrstreifen", "voie", "carril"),
    "recording": (
        *("recording", "run", "video", "drive", "flight", "scene", "session", "trip"),
        *("fahrt", "aufnahme", "location"),
    ),
    "automated": ("automated", "automation", "autonomous", "av", "autopilot", "adas"),
    "id": (
        *("id", "track", "trackid", "vehicleid", "objectid", "vehicle", "object"),
        *("veh", "agent", "uuid", "objekt", "fahrzeug", "car", "kennung", "nr", "name"),
        "nummer",
    ),
}
# what names glue in front of the word that counts: Fahrzeugklasse, VehicleType
OWNERS = ("fahrzeug", "objekt", "vehicle", "object")
# words that make a name another thing
OTHER = {
    *("acc", "accel", "acceleration", "beschleunigung", "jerk", "headway", "gap"),
    *("preceding", "following", "leader", "follower", "lead", "neighbor", "neighbour"),
    *("std", "sigma", "var", "cov", "covariance", "error", "confidence", "total"),
    *("count", "avg", "mean", "traveled", "travelled", "limit"),
    *("ttc", "thw", "dhw", "angular", "rate", "offset", "size"),
}
MOTION = {"velocity", "vel", "speed", "v", "dot", "d"}
KINDS = {
    "vehicle": (
        *("car", "auto", "pkw", "lkw", "truck", "bus", "van", "taxi", "vehicle", "suv"),
        *("motorcycle", "motorrad", "motorbike", "moto", "trailer", "kfz", "large"),
        *("medium", "heavy", "small", "passenger", "transporter", "voiture", "camion"),
        *("coche", "lorry", "powered", "coach", "tram", "sedan"),
    ),
    "cyclist": ("bike", "bicycle", "bicyclist", "cyclist", "fahrrad", "rad", "velo"),
    "pedestrian": ("person", "pedestrian", "ped", "walker", "people", "fussgänger"),
    "static": ("static", "barrier", "cone", "obstacle", "parked"),
}
# unit -> how names of columns write it, in small letters
UNITS: Mapping[str, tuple[str, ...]] = {
    "km/h": ("km/h", "kmh", "kph", "kmph"),
    "mph": ("mph",),
    "kn": ("kn", "kt", "kts", "knots"),
    "ft/s": ("ft/s", "fps", "ftps"),
    "m/s": ("m/s", "mps", "ms-1"),
    "deg": ("deg", "degree", "degrees", "°", "grad"),
    "rad": ("rad", "radian", "radians"),
    "ft": ("ft", "feet", "foot"),
    "cm": ("cm",),
    "mm": ("mm",),
    "km": ("km",),
    "m": ("m", "meter", "meters", "metre", "metres"),
    "ms": ("ms", "msec", "millis"),
    "us": ("us", "usec", "µs", "micros"),
    "ns": ("ns", "nsec", "nanos"),
    "s": ("s", "sec", "seconds"),
}


def plain_words(name: str) -> list[str]:
    """Words of a column's name without those of a unit."""
    bare = re.sub(r"[\[(].*?[\])]", " ", name)
    units = {text for texts in UNITS.values() for text in texts if len(text) > 1}
    found = (word.lower() for word in re.findall(rf"{WORD}|\d+", bare))
    words = [word for glued in found for word in _apart(glued)]
    return [w for w in words if w not in units and w not in ("kf", "smoothed", "raw")]


def _apart(word: str) -> list[str]:
    """A word without its owner, and the owner; plurals stay whole."""
    for owner in OWNERS:
        if word.startswith(owner) and len(word) > len(owner) + 1:
            return [owner, word.removeprefix(owner)]
    return [word]


def unit_of(name: str, allowed: Sequence[str]) -> str:
    """The unit that a column's name says, "" without one."""
    said = re.findall(r"[\[(]\s*(.+?)\s*[\])]", name)
    said += [name.rsplit("_", 1)[-1]] if "_" in name else []
    for text in said:
        for unit in allowed:
            if text.lower() in UNITS.get(unit, ()):
                return unit
    return ""


def fields_by_name(header: Sequence[str]) -> dict[str, str]:
    """Field -> column, as far as names tell; each column once."""
    words = {name: plain_words(name) for name in header if name}
    met = [word for own in words.values() for word in set(own)]
    common = {w for w in met if len(words) > 3 and met.count(w) > len(words) / 2}
    found: dict[str, str] = {}
    for field, known in WORDS.items():
        scores = {}
        for name, own in words.items():
            rest = [word for word in own if word not in common] or own
            score = _score(field, rest, known)
            if score is not None and name not in found.values():
                scores[name] = score
        if scores:
            found[field] = min(scores, key=lambda name: scores[name])
    if {"lat", "lon"} <= found.keys():
        found = {k: v for k, v in found.items() if k not in ("x", "y")}
    else:
        found = {k: v for k, v in found.items() if k not in ("lat", "lon")}
    return found


def _score(
    field: str, words: Sequence[str], known: Sequence[str]
) -> tuple[int, int] | None:
    """How badly a name fits a field: words too many, and how unlikely it is."""
    joined = "".join(words)
    if joined in known:
        return 0, known.index(joined)
    own = set(words)
    hits = [known.index(word) for word in words if word in known]
    if not hits or own & OTHER:
        return None
    if field in ("x", "y", "lat", "lon") and own & MOTION:
        return None
    return len(own) - 1, min(hits)


def kind_by_name(text: str) -> str:
    """vehicle, cyclist, pedestrian or static by a word of a name; "" unknown."""
    words = words_of(text) | {text.lower()}
    for kind in ("cyclist", "pedestrian", "static", "vehicle"):
        if any(word in KINDS[kind] for word in words):
            return kind
    return ""
