"""Human preferences beyond driving logs: in a scene, A is better than B.

JSON Lines. The first line names the dataset, every other one a preference:

    {"schema": "rcirl-jax/preferences", "schema_version": 1, "dataset_sha256": "..."}
    {"scene": 17, "better": "human", "worse": {"s": [0.0, 6.1, ...]}, "weight": 1.0}

`scene` is a row of the dataset (the number under the pictures of inspect_data).
A trajectory is "human", the recorded one, or stations `s` [T] m since the planning
frame and, for rewards of mode path_speed, offsets `l` [T] m from the reference line,
at `units.TIMES_S`. `weight` (1 if not given) scales a preference's loss.
"""

import dataclasses
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import parse_json
from rcirl_jax.units import NUM_TIMES

SCHEMA = "rcirl-jax/preferences"
SCHEMA_VERSION = 1
HUMAN = "human"
MAX_BYTES = 256 << 20  # of a file
STATION_M = 1000.0  # m, stations and offsets beyond are a mistake in units


@dataclasses.dataclass(frozen=True, kw_only=True)
class Preferences:
    """N preferences of one dataset."""

    row: np.ndarray  # [N] int64, row of the dataset
    s: np.ndarray  # [N, 2, T] m, better first
    l: np.ndarray  # [N, 2, T] m
    weight: np.ndarray  # [N] float32
    sha256: str  # of the file


def read_preferences(path: Path, dataset: Demonstrations) -> Preferences:
    """The preferences of a file, checked against the dataset.

    Args:
      path: JSON Lines as above.
      dataset: the one that is trained on; preferences may name training rows only.

    Raises:
      InputError: no such file, not this format, another dataset, or a line that
        cannot be meant (names file, line and field).
    """
    if not path.is_file():
        raise InputError(f"--preferences: {path}: missing: expected a file")
    if path.stat().st_size > MAX_BYTES:
        raise InputError(f"{path}: size: expected at most {MAX_BYTES >> 20} MiB")
    raw = path.read_bytes()
    try:
        numbered = enumerate(raw.decode().splitlines(), start=1)
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: bytes: expected UTF-8 text") from error
    lines = [(number, line) for number, line in numbered if line.strip()]
    if len(lines) < 2:
        raise InputError(f"{path}: {len(lines)} lines: expected a head and preferences")
    _check_head(path, _object(path, *lines[0]), dataset.hash)
    training = set(dataset.indices("train").tolist())
    found = [
        _preference(f"{path}: line {number}", _object(path, number, line), training)
        for number, line in lines[1:]
    ]
    rows = np.array([one[0] for one in found], np.int64)
    s, l = (np.array([one[i] for one in found], np.float32) for i in (1, 2))
    _fill_humans(rows, s, l, dataset)
    return Preferences(
        row=rows,
        s=s,
        l=l,
        weight=np.array([one[3] for one in found], np.float32),
        sha256=hashlib.sha256(raw).hexdigest(),
    )


def _object(path: Path, number: int, line: str) -> dict[str, Any]:
    try:
        found = parse_json(line)
    except ValueError as error:
        raise InputError(f"{path}: line {number}: expected JSON") from error
    if not isinstance(found, dict):
        raise InputError(f"{path}: line {number}: expected an object")
    return found


def _check_head(path: Path, head: Mapping[str, Any], dataset_hash: str) -> None:
    wanted = {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "dataset_sha256": dataset_hash,
    }
    for name, value in wanted.items():
        if head.get(name) != value:
            raise InputError(
                f"{path}: line 1: {name}: {str(head.get(name))[:80]}: expected {value}"
            )


def _preference(
    where: str, found: Mapping[str, Any], training: set[int]
) -> tuple[int, list, list, float]:
    """(row, s [2][T], l [2][T], weight); NaN where the human is meant."""
    extra = sorted(set(found) - {"scene", "better", "worse", "weight"})
    if extra:
        raise InputError(f"{where}: {extra[0]}: expected scene, better, worse, weight")
    scene, weight = found.get("scene"), found.get("weight", 1.0)
    if isinstance(scene, bool) or not isinstance(scene, int):
        raise InputError(f"{where}: scene: {scene}: expected a row number")
    if scene not in training:
        raise InputError(f"{where}: scene: {scene}: expected a row of the train split")
    if isinstance(weight, bool) or not isinstance(weight, int | float):
        raise InputError(f"{where}: weight: {weight}: expected a number")
    if not 0.0 < weight <= 1e6:
        raise InputError(f"{where}: weight: {weight}: expected above 0, at most 1e6")
    if found.get("better") == found.get("worse"):
        raise InputError(f"{where}: better, worse: the same: expected two trajectories")
    better, worse = (
        _trajectory(f"{where}: {name}", found.get(name)) for name in ("better", "worse")
    )
    return scene, [better[0], worse[0]], [better[1], worse[1]], float(weight)


def _trajectory(where: str, found: Any) -> tuple[list, list]:  # noqa: ANN401
    if found == HUMAN:
        return [np.nan] * NUM_TIMES, [np.nan] * NUM_TIMES
    if not isinstance(found, dict) or not set(found) <= {"s", "l"} or "s" not in found:
        raise InputError(f'{where}: expected "human", or an object with s and maybe l')
    s = _numbers(f"{where}: s", found["s"])
    l = _numbers(f"{where}: l", found["l"]) if "l" in found else [0.0] * NUM_TIMES
    if abs(s[0]) > 1.0 or min(np.diff(s)) < -0.5:
        raise InputError(
            f"{where}: s: {s[0]:g} to {s[-1]:g}: expected to start at 0 and not fall"
        )
    return s, l


def _numbers(where: str, found: Any) -> list[float]:  # noqa: ANN401
    if not isinstance(found, list) or len(found) != NUM_TIMES:
        raise InputError(f"{where}: expected {NUM_TIMES} numbers")
    for value in found:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"{where}: {str(value)[:40]}: expected a number")
        if not abs(value) <= STATION_M:
            raise InputError(f"{where}: {value}: expected within {STATION_M:g} m")
    return [float(value) for value in found]


def _fill_humans(
    rows: np.ndarray, s: np.ndarray, l: np.ndarray, dataset: Demonstrations
) -> None:
    """Put the recorded motion where the human is meant."""
    meant = np.isnan(s[:, :, 0])
    some = np.flatnonzero(meant.any(axis=1))
    if some.size:
        human = dataset.read(rows[some]).human
        for side in (0, 1):
            mine = meant[some, side]
            s[some[mine], side] = np.asarray(human.s)[mine]
            l[some[mine], side] = np.asarray(human.l)[mine]
