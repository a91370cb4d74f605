"""Weights of a hand-set cost as a JSON file that people can read and edit.

    {"schema": "rcirl-jax/hand-weights", "schema_version": 1,
     "weights": {every field of `LatticeCost`: number}, ...}

What else is in the file (history of a search, provenance) is for people.
"""

import dataclasses
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import msgspec

from rcirl_jax.errors import InputError
from rcirl_jax.reward import TUNED_ROW, LatticeCost
from rcirl_jax.runtime.atomic_files import read_json, write_json
from rcirl_jax.runtime.checked import checked

SCHEMA = "rcirl-jax/hand-weights"
SCHEMA_VERSION = 1
# divisors and shares; all other fields may be 0
_POSITIVE = ("speed_share", "jerk_bound", "collision_sigma", "offset_scale")
_MOST = sys.float_info.max  # finite
_ABOVE_0 = Annotated[float, msgspec.Meta(gt=0.0, le=_MOST)]
_FROM_0 = Annotated[float, msgspec.Meta(ge=0.0, le=_MOST)]
_WEIGHTS = msgspec.defstruct(
    "_WEIGHTS",
    [
        (field.name, _ABOVE_0 if field.name in _POSITIVE else _FROM_0)
        for field in dataclasses.fields(LatticeCost)
    ],
    forbid_unknown_fields=True,
)


def write_hand_weights(
    path: str | os.PathLike[str], cost: LatticeCost, facts: Mapping[str, object]
) -> None:
    """Write the file, whole or not at all; its folder is made.

    Args:
      path: of the file.
      cost: its fields are written as float32 numbers.
      facts: further JSON-ready entries.
    """
    body = {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "weights": {name: float(x) for name, x in cost.fields().items()},
        **facts,
    }
    write_json(Path(path), body)


def tuned_rows(
    paths: Sequence[str], data_hash: str | None = None
) -> dict[str, list[LatticeCost]]:
    """Tuned costs, one of each search, as the runs of a row; none without files.

    Args:
      paths: files of searches that differ in their seed.
      data_hash: of the scenes and their split; a file that was tuned on others may
        know the held-out ones.

    Raises:
      InputError: as `load_hand_weights`, or a file tuned on other scenes.
    """
    costs = [load_hand_weights(path) for path in paths]
    for path in paths:
        found = read_json(Path(path), "hand weights").get("data_hash")
        if data_hash and found and found != data_hash:
            raise InputError(
                f"{path}: data_hash: {str(found)[:12]}: expected {data_hash[:12]}, "
                "weights tuned with the same --data and --holdout"
            )
    return {TUNED_ROW: costs} if costs else {}


def load_hand_weights(path: str | os.PathLike[str]) -> LatticeCost:
    """The cost of a file.

    Raises:
      InputError: unreadable, of another schema, or a weight that is missing,
        unknown, not a number, not finite, or negative; one line naming it.
    """
    body = read_json(Path(path), "JSON, hand weights")
    found = body if isinstance(body, dict) else {}
    for name, expected in {"schema": SCHEMA, "schema_version": SCHEMA_VERSION}.items():
        if found.get(name) != expected:
            raise InputError(f"{path}: {name}: {found.get(name)}: expected {expected}")
    weights = checked(found.get("weights"), _WEIGHTS, f"{path}: weights")
    return LatticeCost(**msgspec.structs.asdict(weights))
