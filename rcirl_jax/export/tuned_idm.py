"""The tuned driver model as a JSON file: one number for every field of `Idm`.

    {"headway": 1.1, "standstill_gap": 2.3, "acceleration": 1.7, ...}

`rcirl autotune` writes RUN/tuned_idm.json from its training scenes.
"""

import dataclasses
from pathlib import Path
from typing import Annotated

import msgspec

from rcirl_jax.planner.baselines import TUNED_IDM_ROW, Idm
from rcirl_jax.runtime.atomic_files import read_json, write_json
from rcirl_jax.runtime.checked import checked

FIELDS = tuple(field.name for field in dataclasses.fields(Idm))
_POSITIVE = Annotated[float, msgspec.Meta(gt=0.0, lt=1e6)]
_IDM = msgspec.defstruct(
    "_IDM", [(name, _POSITIVE) for name in FIELDS], forbid_unknown_fields=True
)


def write_tuned_idm(path: Path, idm: Idm) -> None:
    """Write the file, whole or not at all."""
    write_json(path, {name: float(getattr(idm, name)) for name in FIELDS})


def read_tuned_idm(path: Path) -> Idm:
    """The driver model of a file.

    Raises:
      InputError: unreadable, or a field that is missing, unknown, or not a finite
        number above 0; one line naming it.
    """
    found = checked(read_json(path, "JSON, a tuned IDM"), _IDM, path)
    return Idm(**msgspec.structs.asdict(found))


def idm_left_out(path: str | None) -> str:
    """What a command says where --tuned_idm names no file; "" where it names one."""
    return "" if path else f"left out: {TUNED_IDM_ROW}: --tuned_idm is not given"
