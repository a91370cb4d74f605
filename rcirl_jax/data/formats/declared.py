"""Formats of tables, declared: field -> kind of cells (`tables.table.LIMITS`)."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.data.formats.options import section
from rcirl_jax.data.formats.perception import speed_of
from rcirl_jax.data.formats.tracks import travel_heading
from rcirl_jax.data.readers.tables.rows import (
    Rows,
    RowStats,
    allowed_share,
    drop_duplicates,
)
from rcirl_jax.data.readers.tables.table import Table, fields_of, open_table, read
from rcirl_jax.types import Kind, Track

KINDS = {
    **dict.fromkeys(("pedestrian", "person", "animal"), Kind.PEDESTRIAN),
    # a trailer is in the way of others like any body that moves, but nobody drives it:
    # only vehicles are experts (Argoverse 2's "unknown" and Waymo's "other" likewise)
    **dict.fromkeys(("bicycle", "bicyclist", "cyclist", "trailer"), Kind.CYCLIST),
    **dict.fromkeys(("car", "van", "truck", "bus", "truck_bus"), Kind.VEHICLE),
    **dict.fromkeys(("motorcycle", "vehicle"), Kind.VEHICLE),
}  # class of a road user, in small letters -> what it is; others are vehicles


def over_packaged(spec: dict, packaged: Mapping, free: Collection[str]) -> dict:
    """Returns a user's source TOML, laid over the packaged one of its format.

    Numbers, texts and names of files that it does not say are the packaged ones, also
    those in tables, but for `free` tables, whose names are the user's.
    """
    made = dict(spec)
    for key, value in packaged.items():
        if isinstance(value, dict) and key not in free:
            made[key] = {**value, **spec.get(key, {})}
        elif isinstance(value, bool | int | float | str) or key == "pattern":
            made.setdefault(key, value)
    return made


def open_log(
    path: Path, spec: Mapping, known: Collection[str] = ()
) -> tuple[Table, RowStats]:
    """Opens a table as its source TOML says, and counts of its rows.

    Args:
      path: file.
      spec: source TOML.
      known: names that the table should hold, which may tell its encoding.
    """
    table = open_table(path, section(spec, "table"), known)
    return table, RowStats(path=path, unit=table.unit, allowed=allowed_share(spec))


def read_log(
    table: Table,
    stats: RowStats,
    needed: Mapping[str, str],
    optional: Mapping[str, str] | None = None,
    columns: Mapping[str, str] | None = None,
    **options: Any,  # noqa: ANN401
) -> Rows:
    """Returns the rows of a table, each road user once in a frame.

    Columns are given as to `fields_of`, other options as to `drop_duplicates`.
    """
    fields = fields_of(table, needed, optional, columns=columns)
    return drop_duplicates(read(table, fields, stats), stats, **options)


def size_of(rows: Rows, usual: Sequence[float]) -> tuple[float, float, bool]:
    """Returns medians [m] of the known lengths and widths, and whether one is assumed.

    Args:
      rows: perhaps length and width [n] m; NaN, and 0, is unknown.
      usual: m, length and width where no row says them.
    """
    known = [rows.get(field, np.zeros(0)) for field in ("length", "width")]
    known = [sizes[sizes > 0.0] for sizes in known]  # NaN is not
    length, width = (
        float(np.median(sizes)) if sizes.size else float(default)
        for sizes, default in zip(known, usual, strict=True)
    )
    return length, width, not all(sizes.size for sizes in known)


def track_of(
    name: str,
    rows: Rows,
    kind: Kind,
    usual: Sequence[float],
    *,
    standing: float = 0.0,
    **more: Any,  # noqa: ANN401
) -> Track:
    """Returns a track of its rows; unknown cells are filled.

    Headings and speeds by the positions, sizes as of `size_of`.

    Args:
      name: of the track.
      rows: t [s], x, y [m], perhaps heading [rad], speed [m/s], length, width [m].
      kind: of the road user.
      usual: m, its length and width where no row says them.
      standing: rad, heading of one that never moves, and has no other.
      **more: other fields of Track.
    """
    t, x, y = (rows[field] for field in ("t", "x", "y"))
    length, width, is_assumed = size_of(rows, usual)
    return Track(
        id=name,
        kind=kind,
        length=length,
        width=width,
        size_assumed=is_assumed,
        t=t,
        x=x,
        y=y,
        heading=_filled(rows, "heading", lambda: travel_heading(t, x, y, standing)),
        speed=_filled(rows, "speed", lambda: speed_of(t, x, y)),
        **more,
    )


def _filled(rows: Rows, field: str, other: Callable[[], np.ndarray]) -> np.ndarray:
    """Values [n] where they are known, else others."""
    if field not in rows:
        return other()
    unknown = np.isnan(rows[field])
    return np.where(unknown, other(), rows[field]) if unknown.any() else rows[field]


def unknown_kinds(what: str, found: Iterable[str]) -> list[str]:
    """Returns the note on classes that nobody knows."""
    unknown = sorted(set(found) - {*KINDS})
    return [f"{what} taken for vehicles: {', '.join(unknown)}"] if unknown else []
