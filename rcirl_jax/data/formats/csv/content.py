"""Fields of a table by the content of its columns, where names say nothing.

The time rises in even steps within one road user, whose name repeats; the other columns
change smoothly with it. Places are the columns in metres whose change fits a speed, or
the only two that move; sizes stay the same within one road user. A unit that the
table states rules out what it cannot be. What fits two columns alike is no guess.
"""

import dataclasses
import itertools
import re
from collections.abc import Mapping, Sequence

import numpy as np

from rcirl_jax.data.formats.csv.columns import (
    ANGLES,
    CONVENTIONS,
    FITS_WELL,
    ISO_TIMES,
    LENGTHS,
    SPEEDS,
    HeadingForm,
    date_pattern,
    known_cells,
)
from rcirl_jax.data.formats.csv.names import is_in_pixels, kind_by_name, unit_of
from rcirl_jax.data.formats.options import UNITS
from rcirl_jax.data.readers.tables.rows import RowStats
from rcirl_jax.data.readers.tables.table import Field, Table, batches
from rcirl_jax.data.readers.tables.text import NUMBER

TIMES = ("s", "ms", "us", "ns")
EVERY_UNIT = (*SPEEDS, *ANGLES, *LENGTHS, *TIMES)
MAX_ROWS = 20_000  # of the head, from which is guessed
MIN_STEPS = 20  # from one row of a road user to the next
EVEN, MOSTLY = 0.3, 0.7  # steps of time this near to the median, this share of them
EXACT = 0.01  # likewise in the median, of times that road users do not share
SHARED = 0.7  # share of rows with another time at most, where road users share times
ONCE = 0.02  # share of rows at most that repeat the time of their road user
USER_ROWS = 5.0  # rows of one road user at least, in the mean
SMOOTH = 0.25  # change over a step at most, as a share of the column's spread
LAG = 5  # rows over which a motion is taken
SPEED_FITS = 0.15  # spread of recorded speed over that of the positions
AMBIGUOUS = 0.03  # so near two guesses are the same
STEADY = 0.1  # spread of a size within one road user, of its median
SIZES_M = {"length": (2.5, 25.0), "width": (1.2, 2.8)}  # m, of the median
KNOWN_KINDS = 0.5  # share of the texts of a column of kinds that are known


@dataclasses.dataclass(frozen=True, kw_only=True)
class Guessed:
    """A column that its content tells, and by what."""

    column: str
    why: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class Head:
    """The first rows of all columns of a table."""

    units: Mapping[str, str]  # column -> the unit that is stated, "" none
    codes: Mapping[str, np.ndarray]  # [n] equal where the texts are
    texts: Mapping[str, Sequence[str]]  # text of each code
    numbers: Mapping[str, np.ndarray]  # [n] of the columns of numbers; NaN: unknown
    clocks: frozenset[str]  # columns of dates or times of day; numbers are their order

    def may_be_time(self, column: str) -> bool:
        """True for a date or time of day, and where the unit stated is none or fits."""
        unit = self.units[column].strip("-")
        return column in self.clocks or not unit or unit in TIMES

    def is_whole(self, column: str) -> bool:
        """True for numbers without decimals."""
        return all(re.fullmatch(r"-?\d*", text) for text in self.texts[column])


def head_of_table(table: Table) -> Head:
    """Reads the first rows of all columns whose names are met once."""
    names = [n for n in table.header if n and table.header.count(n) == 1]
    fields = [Field(name=n, column=n, needed=False, text=True) for n in names]
    batch = next(batches(table, fields, RowStats(table.path, allowed=1.0)), {})
    codes, texts, numbers, clocks = {}, {}, {}, set()
    for name in names if batch else ():
        own, every = batch[name]
        texts[name], codes[name] = _compact(own[:MAX_ROWS], every)
        cells = known_cells(table, name)
        if re.match(ISO_TIMES, cells[0] if cells else "") or date_pattern(cells):
            clocks.add(name)
            numbers[name] = codes[name].astype(float)  # texts are sorted
            continue
        values = _numbers(texts[name], *table.marks(name))
        known = np.isfinite(values[codes[name]])
        is_known = np.array([bool(text) for text in texts[name]])[codes[name]]
        if known.sum() >= max(MOSTLY * is_known.sum(), 1):
            numbers[name] = values[codes[name]]
    units = {n: table.unit_of(n) if table.layout else "" for n in names}
    stated = {
        n: unit_of(n, EVERY_UNIT) or unit_of(f"[{u}]", EVERY_UNIT) or u
        for n, u in units.items()
    }
    stated.update((n, "px") for n in names if is_in_pixels(n))
    return Head(
        units=stated,
        codes=codes,
        texts=texts,
        numbers=numbers,
        clocks=frozenset(clocks),
    )


def _compact(codes: np.ndarray, texts: Sequence[str]) -> tuple[list[str], np.ndarray]:
    """(sorted texts that are met, code [n] of each row)."""
    met, own = np.unique(codes, return_inverse=True)
    found, places = np.unique([texts[k] for k in met.tolist()], return_inverse=True)
    return found.tolist(), places[own]


def _numbers(texts: Sequence[str], decimal: str, thousands: str) -> np.ndarray:
    """Numbers [n] of texts; NaN where they are none."""
    plain = [t.replace(thousands, "") if thousands else t for t in texts]
    plain = [t.replace(decimal, ".") for t in plain]
    return np.array([float(t) if NUMBER.fullmatch(t) else np.nan for t in plain])


def fields_by_content(table: Table, found: Mapping[str, str]) -> dict[str, Guessed]:
    """Returns fields that content tells and that `found` lacks, where it is clear."""
    head = head_of_table(table)
    known = {f: c for f, c in found.items() if c in head.codes}
    made: dict[str, Guessed] = {}

    def take(more: Mapping[str, Guessed]) -> None:
        made.update(more)
        known.update({field: one.column for field, one in more.items()})

    take(_clock_and_user(head, known))
    if not {"t", "id"} <= known.keys() or known["t"] not in head.numbers:
        return made
    users = Users.of(head, known)
    if users.same.sum() < MIN_STEPS:
        return made
    if "lat" not in found:
        take(_places(head, users, known))
    if {"x", "y"} <= known.keys() and not {"vx", "vy"} & known.keys():
        take(_motion(head, users, known))
    take(_sizes(head, users, known))
    take(_kind(head, users, known))
    return made


def unclear(table: Table, field: str, used: Sequence[str]) -> list[str]:
    """Returns the columns that a needed field may be, by what they hold."""
    head = head_of_table(table)
    rest = [name for name in head.codes if name not in used]
    if field == "id":
        return [n for n in rest if n not in head.numbers or head.is_whole(n)] or rest
    expected = TIMES if field == "t" else (*LENGTHS, *ANGLES)
    numbers = [n for n in rest if n in head.numbers]
    dates = head.clocks if field == "t" else ()
    stated = [n for n in numbers if n in dates or head.units[n] in expected]
    return stated or [n for n in numbers if not head.units[n]] or rest


def _clock_and_user(head: Head, known: Mapping[str, str]) -> dict[str, Guessed]:
    """The time and the road user: those in which all else changes most smoothly."""
    if {"t", "id"} <= known.keys():
        return {}
    taken = set(known.values())
    times = [known["t"]] if "t" in known else [
        n for n in head.numbers
        if n not in taken and head.may_be_time(n)
    ]  # fmt: skip
    users = [known["id"]] if "id" in known else [
        n for n in head.codes
        if n not in taken and head.units[n].strip("-") == ""
        and n not in head.clocks and (n not in head.numbers or head.is_whole(n))
    ]  # fmt: skip
    scores = {}
    for t, user in itertools.product(times, users):
        if t == user or t not in head.numbers:
            continue
        one = Users.of(head, {"t": t, "id": user})
        steps = one.steps[one.same]
        count = np.unique(head.codes[user]).size
        is_enough = steps.size >= MIN_STEPS and count > 1
        if not is_enough or one.order.size < USER_ROWS * count:
            continue
        usual = float(np.median(steps))
        apart = np.abs(steps / usual - 1.0) if usual > 0.0 else np.full(1, np.inf)
        is_even = np.mean(apart < EVEN) >= MOSTLY or t in head.clocks
        if np.mean(steps <= 0.0) > ONCE or not is_even:
            continue
        rough, spread = _rough(head, one, {t, user}), float(np.median(apart))
        is_stated = head.units[t] in TIMES or t in head.clocks
        moments = np.unique(head.codes[t]).size
        # a place changes evenly too, but is no other's at once
        is_own = moments > SHARED * one.order.size
        if rough > SMOOTH or (is_own and not is_stated and spread > EXACT):
            continue
        fit = round(spread, 1) + round(rough, 1)
        scores[t, user] = not is_stated, is_own, fit, -moments
    if not scores:
        return {}
    t, user = min(scores, key=lambda pair: scores[pair])
    one = Users.of(head, {"t": t, "id": user})
    step = float(np.median(one.steps[one.same]))
    rises = "rises" if t in head.clocks else f"rises in steps of {step:.4g}"
    count = np.unique(head.codes[user]).size
    guesses = {
        "t": Guessed(column=t, why=f"{rises} within one {user}"),
        "id": Guessed(column=user, why=f"{count} values, each once at one {t}"),
    }
    return {field: one for field, one in guesses.items() if field not in known}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Users:
    """The rows in the order of road users and times."""

    codes: np.ndarray  # [n] of the road users, in that order
    order: np.ndarray  # [n] rows
    steps: np.ndarray  # [n - 1] of time
    same: np.ndarray  # [n - 1] whether both rows are of one road user

    @classmethod
    def of(cls, head: Head, known: Mapping[str, str]) -> "Users":
        """Returns the order by the columns of time and road user."""
        codes, times = head.codes[known["id"]], head.numbers[known["t"]]
        order = np.lexsort((times, codes))
        order = order[np.isfinite(times[order])]
        same = np.diff(codes[order]) == 0
        return cls(
            codes=codes[order], order=order, steps=np.diff(times[order]), same=same
        )

    def change(self, values: np.ndarray, lag: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns (change [m] of values over some rows, row [m] between them)."""
        order = self.order
        same = self.codes[lag:] == self.codes[:-lag]
        change = values[order[lag:]] - values[order[:-lag]]
        return change[same], order[lag // 2 : order.size - lag + lag // 2][same]

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Returns the range of the inner 80 % of each road user's values."""
        starts = np.flatnonzero(np.diff(self.codes)) + 1
        parts = np.split(values[self.order], starts)
        parts = [part[np.isfinite(part)] for part in parts]
        ends = [np.quantile(part, (0.1, 0.9)) for part in parts if part.size]
        return np.array([upper - lower for lower, upper in ends])


def _rough(head: Head, users: Users, but: set[str]) -> float:
    """Median change of the other columns over a step, as a share of their spread."""
    found = []
    for name, values in head.numbers.items():
        spread = np.nanstd(values) if np.isfinite(values).any() else 0.0
        if name in but or spread == 0.0:
            continue
        change = users.change(values, 1)[0]
        change = change[np.isfinite(change)]
        found.append(float(np.median(np.abs(change))) / spread if change.size else 1.0)
    return float(np.median(found)) if found else 1.0


def _free(head: Head, known: Mapping[str, str], units: Sequence[str]) -> list[str]:
    """Columns of numbers that are no field yet, in one of some units or in none."""
    return [
        name
        for name in head.numbers
        if name not in known.values()
        and name not in head.clocks
        and (not head.units[name] or head.units[name] in units)
    ]


def _ratio(head: Head, users: Users, pair: Sequence[str], speed: str) -> float:
    """Spread of recorded speed over that of two columns; inf: nothing moves."""
    (dx, rows), (dy, _) = (users.change(head.numbers[n], LAG) for n in pair)
    dt, far = users.change(_times(head, users), LAG)[0], np.hypot(dx, dy)
    speeds = head.numbers[speed][rows]
    used = (far > 0.2 * np.nanquantile(far, 0.95)) & (dt > 0.0) & np.isfinite(speeds)
    if used.sum() < MIN_STEPS or np.median(speeds[used]) <= 0.0:
        return np.inf
    ratio = speeds[used] * dt[used] / far[used]
    low, middle, high = np.quantile(ratio, (0.25, 0.5, 0.75))
    return float((high - low) / middle)


def _times(head: Head, users: Users) -> np.ndarray:
    """The times [n] of all rows by their steps."""
    times = np.full(max(map(len, head.codes.values())), np.nan)
    times[users.order] = np.concatenate([[0.0], np.cumsum(users.steps)])
    return times


def _is_moving(head: Head, users: Users, name: str) -> bool:
    """True for a column that changes smoothly and far within one road user."""
    values = head.numbers[name]
    spread = float(np.nanstd(values))
    change = users.change(values, 1)[0]
    change = np.abs(change[np.isfinite(change)])
    if spread == 0.0 or change.size < MIN_STEPS:
        return False
    is_smooth = float(np.median(change)) <= SMOOTH * spread
    own = users.spread(values)
    return is_smooth and float(np.median(own)) > STEADY * spread


def _speeds(head: Head, users: Users, known: Mapping[str, str]) -> list[str]:
    """Columns that may be a speed: the field, else those of its unit or of none."""
    if known.get("speed") in head.numbers:
        return [known["speed"]]
    changing = [
        name
        for name in _free(head, known, SPEEDS)
        if np.nanmin(head.numbers[name]) >= 0.0
        and np.median(users.spread(head.numbers[name])) > 0.0
    ]
    return [name for name in changing if head.units[name]] or changing


def _places(head: Head, users: Users, known: Mapping[str, str]) -> dict[str, Guessed]:
    """The columns of places: their motion fits a speed, or no others move."""
    missing = [axis for axis in "xy" if axis not in known]
    free = [n for n in _free(head, known, LENGTHS) if _is_moving(head, users, n)]
    own = [known[axis] for axis in "xy" if axis in known]
    if not missing or not all(name in head.numbers for name in own):
        return {}
    pairs = [(*own, *more) for more in itertools.combinations(free, len(missing))]
    if len(missing) == 1 and missing[0] == "x":
        pairs = [(new, old) for old, new in pairs]
    fits = {}  # (pair, speed) -> spread
    for pair, speed in itertools.product(pairs, _speeds(head, users, known)):
        if speed not in pair:
            fits[pair, speed] = _ratio(head, users, pair, speed)
    fits = {key: spread for key, spread in fits.items() if spread < SPEED_FITS}
    least = min(fits.values(), default=np.inf)
    best = {pair: speed for (pair, speed), s in fits.items() if s < least + AMBIGUOUS}
    if len(best) == 1:
        ((pair, speed),) = best.items()
        why = f"the motion fits {speed}"
    elif not best and len(pairs) == 1 and all(head.units[n] in LENGTHS for n in free):
        (pair,), why = pairs, "no other column in a unit of length moves"
    else:
        return {}
    if len(missing) == 2:
        why += "; which of the two is x is a guess: y must lie left of x"
    places = dict(zip("xy", pair, strict=True))
    return {axis: Guessed(column=places[axis], why=why) for axis in missing}


def _motion(head: Head, users: Users, known: Mapping[str, str]) -> dict[str, Guessed]:
    """Speed and heading, by the motion of the places."""
    pair = known["x"], known["y"]
    if not all(name in head.numbers for name in pair):
        return {}
    made: dict[str, Guessed] = {}
    if "speed" not in known:
        fits = {n: _ratio(head, users, pair, n) for n in _speeds(head, users, known)}
        best = sorted(fits, key=lambda name: fits[name])
        is_clear = len(best) < 2 or fits[best[1]] - fits[best[0]] > AMBIGUOUS
        if best and is_clear and fits[best[0]] < SPEED_FITS:
            stated = head.units[best[0]]
            unit = f"is in {stated} and " if stated else ""
            made["speed"] = Guessed(column=best[0], why=f"{unit}fits the motion")
    if "heading" in known:
        return made
    (dx, rows), (dy, _) = (users.change(head.numbers[n], LAG) for n in pair)
    far, travel = np.hypot(dx, dy), np.arctan2(dy, dx)
    moves = far > 0.2 * np.nanquantile(far, 0.95)
    used = {*known.values(), *(one.column for one in made.values())}
    apart = {}
    for name in (n for n in _free(head, known, ANGLES) if n not in used):
        values = head.numbers[name][rows]
        good = moves & np.isfinite(values)
        if good.sum() < MIN_STEPS or np.nanstd(values) == 0.0:
            continue
        for form, unit in itertools.product(CONVENTIONS, ANGLES):
            angle = HeadingForm(name=form, unit=unit).radians(values[good])
            off = np.abs(np.angle(np.exp(1j * (angle - travel[good]))))
            apart[name] = min(apart.get(name, np.inf), float(np.median(off)))
    apart = {name: off for name, off in apart.items() if off < FITS_WELL}
    if len(apart) == 1:
        (name,) = apart
        why = "fits the direction of the motion"
        made["heading"] = Guessed(column=name, why=why)
    return made


def _sizes(head: Head, users: Users, known: Mapping[str, str]) -> dict[str, Guessed]:
    """Lengths and widths: steady within one road user, and as vehicles have them."""
    made: dict[str, Guessed] = {}
    for field, (least, most) in SIZES_M.items():
        if field in known:
            continue
        fitting = {}
        for name in _free(head, known, LENGTHS):
            values = head.numbers[name] * UNITS.get(head.units[name], 1.0)
            known_values = values[np.isfinite(values)]
            middle = float(np.median(known_values))
            is_size = least <= middle <= most and known_values.min() > 0.0
            is_size &= bool(head.units[name]) or not head.is_whole(name)
            is_steady = np.median(users.spread(values)) <= STEADY * middle
            if is_size and is_steady and np.unique(known_values).size > 1:
                fitting[name] = middle
        if len(fitting) == 1:
            ((name, middle),) = fitting.items()
            why = f"the same within one {known['id']}, {middle:.3g} m in the median"
            made[field] = Guessed(column=name, why=why)
    return made


def _kind(head: Head, users: Users, known: Mapping[str, str]) -> dict[str, Guessed]:
    """The kind: a text that stays the same within one road user, of known kinds."""
    fitting = []
    for name, texts in head.texts.items():
        if "kind" in known or name in known.values() or name in head.numbers:
            continue
        words = [text for text in texts if text]
        is_known = [bool(kind_by_name(text)) for text in words]
        steady = users.change(head.codes[name].astype(float), 1)[0] == 0.0
        if words and np.mean(is_known) >= KNOWN_KINDS and steady.all():
            fitting.append(name)
    if len(fitting) != 1:
        return {}
    why = f"the same within one {known['id']}, and holds kinds of road users"
    return {"kind": Guessed(column=fitting[0], why=why)}
