"""The tuned driver model as a JSON file: one number for every field of `Idm`.

    {"headway": 1.1, "standstill_gap": 2.3, "acceleration": 1.7, ...}

`experiments.autotune` writes RUN/tuned_idm.json from its training scenes.
"""

import dataclasses
import math
from pathlib import Path

from rcirl_jax.errors import InputError
from rcirl_jax.planner.baselines import TUNED_IDM_ROW, Idm
from rcirl_jax.runtime.atomic_files import read_json, write_json

FIELDS = tuple(field.name for field in dataclasses.fields(Idm))


def write_tuned_idm(path: Path, idm: Idm) -> None:
    """Write the file, whole or not at all."""
    write_json(path, {name: float(getattr(idm, name)) for name in FIELDS})


def read_tuned_idm(path: Path) -> Idm:
    """The driver model of a file.

    Raises:
      InputError: unreadable, or a field that is missing, unknown, or not a finite
        number above 0; one line naming it.
    """
    body = read_json(path, "JSON, a tuned IDM")
    given = set(body) if isinstance(body, dict) else set()
    if given != set(FIELDS):
        wrong = ", ".join(sorted(map(str, given ^ set(FIELDS))))
        raise InputError(f"{path}: {wrong}: expected the fields {', '.join(FIELDS)}")
    for name, value in body.items():
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not 0.0 < value < 1e6 or not math.isfinite(value):
            raise InputError(f"{path}: {name}: {value}: expected a number above 0")
    return Idm(**{name: float(value) for name, value in body.items()})


def idm_fields(path: str | None) -> tuple[tuple[str, float], ...]:
    """A file's fields in order, as `SuiteJob` keeps them; none without a file."""
    if path is None:
        return ()
    return tuple(dataclasses.asdict(read_tuned_idm(Path(path))).items())


def idm_left_out(path: str | None) -> str:
    """What a command says where --tuned_idm names no file; "" where it names one."""
    return "" if path else f"left out: {TUNED_IDM_ROW}: --tuned_idm is not given"
