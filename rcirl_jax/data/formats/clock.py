"""Rows at irregular times, put onto the uniform clock of a recording."""

import dataclasses
import math

import numpy as np

from rcirl_jax.data.formats.perception import Boxes

FIELDS = ("x", "y", "heading", "speed", "length", "width")


def on_clock(boxes: Boxes, rate_hz: float, max_gap_s: float) -> Boxes:
    """Boxes on the clock k / rate_hz, between the rows of each gapless piece.

    Linear interpolation; headings are unwrapped first, values of which some are not
    known are those of the row at or after the tick. A piece between two ticks of
    the clock gives nothing. Of several rows of one road user and time the first counts.

    Args:
      boxes: in any order.
      rate_hz: of the clock.
      max_gap_s: s between two rows of one piece.
    """
    ids, t = boxes.ids, boxes.t
    order = np.lexsort((t, ids))
    step, same = np.diff(t[order]), np.diff(ids[order]) == 0
    order = order[np.concatenate([[True], ~same | (step > 0.0)])[: order.size]]
    step, same = np.diff(t[order]), np.diff(ids[order]) == 0
    breaks = np.flatnonzero(~same | (step > max_gap_s)) + 1
    parts = [_nothing()]
    for rows in np.split(order, breaks) if order.size else []:
        first = math.ceil(float(t[rows[0]]) * rate_hz - 1e-6)
        last = math.floor(float(t[rows[-1]]) * rate_hz + 1e-6)
        clock = np.arange(first, last + 1) / rate_hz
        at = np.minimum(np.searchsorted(t[rows], clock), rows.size - 1)
        part = {"ids": np.full(clock.size, ids[rows[0]]), "t": clock}
        for field in FIELDS:
            values = getattr(boxes, field)[rows]
            values = np.unwrap(values) if field == "heading" else values
            known = not np.isnan(values).any()
            part[field] = np.interp(clock, t[rows], values) if known else values[at]
        parts.append({**part, "kind": boxes.kind[rows][at]})
    merged = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    return dataclasses.replace(boxes, **merged)


def _nothing() -> dict[str, np.ndarray]:
    whole = dict.fromkeys(("ids", "kind"), np.zeros(0, np.int64))
    return {**whole, **dict.fromkeys(("t", *FIELDS), np.zeros(0))}
