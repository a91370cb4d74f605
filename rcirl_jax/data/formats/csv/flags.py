"""Yes and no, as tables write them: whether an automation drives in a row."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from rcirl_jax.data.readers.tables.text import NUMBER
from rcirl_jax.errors import InputError

YES = (
    *("yes", "y", "true", "t", "on", "x", "ja", "j", "oui", "si", "sí", "sim", "sì"),
    *("wahr", "w", "vrai", "verdadero", "vero", "waar", "an", "ein", "aktiv", "active"),
    *("enabled", "activated"),
    *("auto", "automated", "automatic", "autonomous", "av", "acc", "cacc", "engaged"),
)
NO = (
    *("no", "n", "false", "f", "off", "nein", "non", "não", "nao", "nee", "falsch"),
    *("faux", "falso", "onwaar", "aus", "inaktiv", "inactive", "disabled"),
    *("manual", "human", "driver", "hv", "disengaged"),
)
OPTION = "automated_values"


def flags_of(path: Path, texts: Iterable[str], spec: Mapping) -> dict[str, bool]:
    """Text -> whether an automation drives, or nobody knows who does.

    An empty cell is unknown, which counts as automated. If all other cells say yes, an
    empty one means no.

    Args:
      path: named in errors.
      texts: all that the column holds.
      spec: source TOML; its `automated_values` are those that mean yes.

    Raises:
      InputError: a text that is neither yes nor no.
    """
    given = spec.get(OPTION, [])
    if not isinstance(given, list) or not all(isinstance(item, str) for item in given):
        raise InputError(f"source TOML: {OPTION}: {given}: expected a list of texts")
    own = {item.lower() for item in given}
    found = {
        text: text.lower() in own if own else _flag(path, text)
        for text in texts
        if text
    }
    return {**found, "": not all(found.values())}


def _flag(path: Path, text: str) -> bool:
    plain = text.lower()
    if NUMBER.fullmatch(plain.replace(",", ".")):
        return float(plain.replace(",", ".")) != 0.0
    if plain in YES or plain in NO:
        return plain in YES
    raise InputError(
        f"{path}: automated: '{text[:40]}': expected yes or no; {OPTION} of the source "
        "TOML lists those that mean yes"
    )
