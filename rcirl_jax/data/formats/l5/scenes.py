"""Which scenes L5 datasets hold, and which of them show the same drive."""

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.options import one_pattern
from rcirl_jax.data.readers.zarr2 import StructuredArray
from rcirl_jax.errors import InputError

SCENES = {"frame_index_interval": ("iu", (2,)), "host": ("U", ())}
SCENES |= dict.fromkeys(("start_time", "end_time"), ("iu", ()))
SAME_DRIVE_S = 60.0  # s, a host's scenes closer than this may show the same cars
MAX_SCENES = 1_000_000


def parts(path: Path, spec: dict) -> list[Path]:
    """The dataset itself, or those in a folder or its scenes/."""
    if (path / "scenes" / ".zarray").is_file():
        return [path]
    found = _datasets(path, spec)
    if not found:
        raise InputError(
            f"{path}: no scenes/.zarray and no folder {_pattern(spec)}: "
            "expected L5 data"
        )
    _check_met_once(tables_of(found))
    return found


def _pattern(spec: dict) -> str:
    return one_pattern(spec, "*.zarr")


def _datasets(path: Path, spec: dict) -> list[Path]:
    """Datasets in a folder or its scenes/."""
    pattern = _pattern(spec)
    return sorted({*path.glob(pattern), *path.glob(f"scenes/{pattern}")})


def beside(folder: Path, spec: dict) -> list[Path]:
    """The datasets that lie beside one."""
    above = folder.absolute().parent
    found = _datasets(above.parent if above.name == "scenes" else above, spec)
    return [other for other in found if other != folder.absolute()]


def tables_of(folders: Sequence[Path]) -> dict[Path, np.ndarray]:
    """The scenes of each dataset; those of no use are named when they are opened."""
    tables = {}
    for folder in folders:
        with contextlib.suppress(InputError):
            tables[folder] = scenes_of(folder)
    return tables


def _check_met_once(tables: Mapping[Path, np.ndarray]) -> None:
    """No scene is in two datasets."""
    met: dict[tuple[str, ...], Path] = {}
    for folder, table in tables.items():
        for index, scene in enumerate(table):
            key = tuple(str(scene[name]) for name in ("host", "start_time", "end_time"))
            if met.setdefault(key, folder) != folder:
                raise InputError(
                    f"{folder}: scene {index}: host {key[0]}, start {key[1]}: met "
                    f"twice, also in {met[key].name}: expected once; name one dataset"
                )


def scenes_of(folder: Path) -> np.ndarray:
    """All scenes of a dataset."""
    scenes = StructuredArray(folder / "scenes", SCENES)
    if not 0 < scenes.size <= MAX_SCENES:
        raise InputError(
            f"{scenes.path}: shape: {scenes.size} scenes: expected 1 to {MAX_SCENES}"
        )
    return scenes.read(0, scenes.size)


def groups_of(scenes: np.ndarray, others: Sequence[np.ndarray]) -> list[str]:
    """Vehicle-disjoint group of each scene: a host's drive without a long pause.

    Named by the host and the drive's start, so that it is the same in every dataset.

    Args:
      scenes: of one dataset.
      others: of those beside it, which may hold earlier scenes of its drives.
    """
    tables = [scenes, *others]
    hosts = np.concatenate([table["host"] for table in tables])
    start, end = (
        np.concatenate([table[name].astype(np.int64) for table in tables])
        for name in ("start_time", "end_time")
    )
    _, host = np.unique(hosts, return_inverse=True)
    order = np.lexsort((start, host))
    pause = start[order][1:] - end[order][:-1]  # ns
    new = np.ones(order.size, bool)
    new[1:] = (np.diff(host[order]) != 0) | (pause > SAME_DRIVE_S * 1e9)
    first = np.empty(order.size, np.int64)
    first[order] = order[np.flatnonzero(new)][np.cumsum(new) - 1]
    return [
        f"{hosts[drive]}-from-{start[drive] // 10**9}"
        for drive in first[: len(scenes)].tolist()
    ]
